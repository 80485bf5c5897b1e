//! From weights as they are stored to panels, on several threads.

use super::error::{KernelError, MAX_QUANTIZED_INPUTS};
use crate::aligned::{AlignedBuffer, AllocError, elements};
use crate::gemm::{Gemm, MAX_NR, PanelMut};
use crate::matrix::Matrix;
use crate::pool::{Interrupted, is_stopped, parallel_for};
use crate::rows::{RowsMut, SharedRows};
use crate::weights::{Arithmetic, Element, WeightRef, nibbles};

/// Packed weights.
pub(super) struct Panels {
    /// One after the other.
    pub words: AlignedBuffer<u32>,
    /// Of each column of the panels, for int8 and int4: its scale; otherwise empty.
    pub scales: AlignedBuffer<f32>,
    /// The sum of its bytes, likewise.
    pub sums: AlignedBuffer<i32>,
}

/// Packs `parts`, stacked along `out_features`, as panels of `gemm`, which are of `element`.
pub(super) fn pack_panels(
    threads: usize,
    gemm: &dyn Gemm,
    element: Element,
    parts: &[(WeightRef<'_>, Option<&[f32]>)],
) -> Result<Panels, KernelError> {
    let columns = gemm.shape().nr;
    let in_features = parts[0].0.shape().1;
    let out_features: usize = parts.iter().map(|(weight, _)| weight.shape().0).sum();
    let num_panels = out_features.div_ceil(columns);
    let size = gemm.panel_words(in_features);
    let scaled = if element.is_quantized() { columns } else { 0 };
    let of_bytes = |(weight, _): &(WeightRef<'_>, _)| bytes_for(element, weight);
    let bytes = parts.iter().map(of_bytes).collect::<Result<Vec<_>, _>>()?;
    let mut words = AlignedBuffer::zeroed(elements(num_panels, size)?)?;
    let mut scales = AlignedBuffer::zeroed(num_panels * scaled)?;
    let mut sums = AlignedBuffer::zeroed(num_panels * scaled)?;
    let to_words = SharedRows::new(RowsMut::strided(&mut words, num_panels, size, size));
    let to_scales = SharedRows::new(RowsMut::strided(&mut scales, num_panels, scaled, scaled));
    let to_sums = SharedRows::new(RowsMut::strided(&mut sums, num_panels, scaled, scaled));
    parallel_for(threads, num_panels, &|index| {
        let panel = index..index + 1;
        // SAFETY: tasks have different panels.
        let (mut words, mut scales, mut sums) = unsafe {
            (
                to_words.block(panel.clone(), 0..size),
                to_scales.block(panel.clone(), 0..scaled),
                to_sums.block(panel, 0..scaled),
            )
        };
        let (first, end) = (index * columns, (index + 1) * columns);
        let mut part_first = 0;
        for ((weight, _), bytes) in parts.iter().zip(&bytes) {
            let weight = as_bytes(*weight, bytes.as_deref());
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

/// Checks that rows of int4 are whole bytes, and that nothing follows their last weight.
pub(super) fn check_int4(weight: &WeightRef<'_>) -> Result<(), KernelError> {
    let WeightRef::Int4 {
        values, in_features, ..
    } = *weight
    else {
        return Ok(());
    };
    let (expected, given) = (in_features.div_ceil(2), values.num_columns());
    if given != expected {
        return Err(KernelError::Int4Bytes {
            in_features,
            expected,
            given,
        });
    }
    let is_padded = |row: usize| in_features % 2 == 0 || values.get(row, expected - 1) >> 4 == 0;
    match (0..values.num_rows()).find(|&row| !is_padded(row)) {
        Some(row) => Err(KernelError::Int4Padding { row, in_features }),
        None => Ok(()),
    }
}

/// The element that weights, which `are_bf16` or are not, are packed as.
pub(super) fn packed_element(
    arithmetic: Arithmetic,
    are_bf16: bool,
    in_features: usize,
) -> Result<Element, KernelError> {
    match arithmetic {
        Arithmetic::Float32 if are_bf16 => Ok(Element::Bf16),
        Arithmetic::Int8 | Arithmetic::Int4 if in_features > MAX_QUANTIZED_INPUTS => {
            Err(KernelError::TooManyInputs { given: in_features })
        }
        _ => Ok(arithmetic.element()),
    }
}

/// A byte for each weight, if they are int4 and to be packed as something else.
fn bytes_for(element: Element, weight: &WeightRef<'_>) -> Result<Option<AlignedBuffer<i8>>, AllocError> {
    let WeightRef::Int4 {
        values, in_features, ..
    } = *weight
    else {
        return Ok(None);
    };
    if element == Element::Int4 {
        return Ok(None);
    }
    let mut bytes = AlignedBuffer::zeroed(elements(values.num_rows(), in_features)?)?;
    for (row, bytes) in bytes.chunks_exact_mut(in_features.max(1)).enumerate() {
        for (k, bytes) in bytes.chunks_mut(2).enumerate() {
            bytes.copy_from_slice(&nibbles(values.get(row, k))[..bytes.len()]);
        }
    }
    Ok(Some(bytes))
}

/// The weights that `bytes` are made of, or those that are given where there are none.
fn as_bytes<'a>(weight: WeightRef<'a>, bytes: Option<&'a [i8]>) -> WeightRef<'a> {
    match (weight, bytes) {
        (
            WeightRef::Int4 {
                in_features, scales, ..
            },
            Some(bytes),
        ) => WeightRef::Int8 {
            values: Matrix::new(bytes, in_features),
            scales,
        },
        _ => weight,
    }
}
