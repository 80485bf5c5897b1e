//! From weights as they are stored to panels, on several threads.

use super::error::{KernelError, MAX_INT8_INPUTS};
use crate::aligned::{AlignedBuffer, AllocError, elements};
use crate::gemm::{Gemm, MAX_NR, PanelMut};
use crate::pool::{Interrupted, is_stopped, parallel_for};
use crate::rows::{RowsMut, SharedRows};
use crate::weights::{Arithmetic, Element, WeightRef};

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
    let columns = gemm.shape().nr;
    let in_features = parts[0].0.shape().1;
    let out_features: usize = parts.iter().map(|(weight, _)| weight.shape().0).sum();
    let num_panels = out_features.div_ceil(columns);
    let size = gemm.panel_words(in_features);
    let int8 = if is_int8 { columns } else { 0 };
    let mut words = AlignedBuffer::zeroed(elements(num_panels, size)?)?;
    let mut scales = AlignedBuffer::zeroed(num_panels * int8)?;
    let mut sums = AlignedBuffer::zeroed(num_panels * int8)?;
    let to_words = SharedRows::new(RowsMut::strided(&mut words, num_panels, size, size));
    let to_scales = SharedRows::new(RowsMut::strided(&mut scales, num_panels, int8, int8));
    let to_sums = SharedRows::new(RowsMut::strided(&mut sums, num_panels, int8, int8));
    parallel_for(threads, num_panels, &|index| {
        let panel = index..index + 1;
        // SAFETY: tasks have different panels.
        let (mut words, mut scales, mut sums) = unsafe {
            (
                to_words.block(panel.clone(), 0..size),
                to_scales.block(panel.clone(), 0..int8),
                to_sums.block(panel, 0..int8),
            )
        };
        let (first, end) = (index * columns, (index + 1) * columns);
        let mut part_first = 0;
        for (weight, _) in parts {
            let part_end = part_first + weight.shape().0;
            let (from, until) = (part_first.max(first), part_end.min(end));
            if from < until {
                let panel = PanelMut {
                    words: words.row_mut(0),
                    scales: scales.row_mut(0),
                    sums: sums.row_mut(0),
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

/// Checks that memory can have a panel, and a converted row, of `in_features`: every [`Gemm`] multiplies and pads their sizes
/// without checks.
pub(super) fn check_panel(in_features: usize) -> Result<(), AllocError> {
    // More than any product pads a row to.
    let padded = in_features.checked_next_multiple_of(1024);
    let padded = padded.ok_or(AllocError { bytes: usize::MAX })?;
    elements(padded, MAX_NR * size_of::<u32>()).map(drop)
}

/// The element that weights, which `are_bf16` or are not, are packed as.
pub(super) fn packed_element(
    arithmetic: Arithmetic,
    are_bf16: bool,
    in_features: usize,
) -> Result<Element, KernelError> {
    match arithmetic {
        Arithmetic::Float32 if are_bf16 => Ok(Element::Bf16),
        Arithmetic::Float32 => Ok(Element::F32),
        Arithmetic::Bfloat16 => Ok(Element::Bf16),
        Arithmetic::Int8 if in_features > MAX_INT8_INPUTS => {
            Err(KernelError::TooManyInputs { given: in_features })
        }
        Arithmetic::Int8 => Ok(Element::Int8),
    }
}
