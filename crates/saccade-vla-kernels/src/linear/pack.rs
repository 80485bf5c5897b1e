//! From weights as they are stored to panels, on several threads.

use super::error::KernelError;
use crate::aligned::{AlignedBuffer, elements};
use crate::gemm::{Gemm, PanelMut};
use crate::pool::{Interrupted, is_stopped, parallel_for};
use crate::weights::WeightRef;

/// Packed weights.
pub(super) struct Panels {
    /// One after the other.
    pub words: AlignedBuffer<u32>,
    /// Of each column of the panels, for int8: its scale; otherwise empty.
    pub scales: AlignedBuffer<f32>,
    /// The sum of its weights, likewise.
    pub sums: AlignedBuffer<i32>,
}

/// Packs `parts`, stacked along `out_features`, as panels of `gemm`; with scales if it is one of int8.
pub(super) fn pack_panels(
    threads: usize,
    gemm: &dyn Gemm,
    is_int8: bool,
    parts: &[(WeightRef<'_>, Option<&[f32]>)],
) -> Result<Panels, KernelError> {
    let columns = gemm.shape().columns;
    let in_features = parts[0].0.shape().1;
    let out_features: usize = parts.iter().map(|(weight, _)| weight.shape().0).sum();
    let num_panels = out_features.div_ceil(columns);
    let size = gemm.panel_words(in_features);
    let int8 = if is_int8 { columns } else { 0 };
    let mut words = AlignedBuffer::zeroed(elements(num_panels, size)?)?;
    let mut scales = AlignedBuffer::zeroed(num_panels * int8)?;
    let mut sums = AlignedBuffer::zeroed(num_panels * int8)?;
    let to = To {
        words: words.pointer(),
        scales: scales.as_mut_ptr(),
        sums: sums.as_mut_ptr(),
    };
    parallel_for(threads, num_panels, &|index| {
        let to = &to;
        let (first, end) = (index * columns, (index + 1) * columns);
        let mut part_first = 0;
        for (weight, _) in parts {
            let part_end = part_first + weight.shape().0;
            let (from, until) = (part_first.max(first), part_end.min(end));
            if from < until {
                // SAFETY: the buffers hold `num_panels` panels, and each task has its own; that of the part before is
                // not used any more.
                let panel = unsafe {
                    PanelMut {
                        words: std::slice::from_raw_parts_mut(to.words.add(index * size), size),
                        scales: std::slice::from_raw_parts_mut(to.scales.add(index * int8), int8),
                        sums: std::slice::from_raw_parts_mut(to.sums.add(index * int8), int8),
                    }
                };
                let rows = weight.rows(from - part_first..until - part_first);
                gemm.pack(rows, from - first, panel);
            }
            part_first = part_end;
        }
    });
    if is_stopped() {
        return Err(Interrupted.into());
    }
    Ok(Panels { words, scales, sums })
}

struct To {
    words: *mut u32,
    scales: *mut f32,
    sums: *mut i32,
}

// SAFETY: tasks write different panels.
unsafe impl Sync for To {}
