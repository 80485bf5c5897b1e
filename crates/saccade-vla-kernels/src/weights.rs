//! Weights as they are stored, the arithmetic that multiplies them, and their quantisation to int8.
//!
//! Equation 37 of docs/equations.md.

use std::ops::Range;

use half::bf16;

use crate::matrix::Matrix;

/// How a [`PackedLinear`](crate::PackedLinear) multiplies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Arithmetic {
    /// float32 throughout. Weights that are bf16 stay so in memory, and are widened in registers.
    Float32,
    /// Weights and activations rounded to bf16, products and sums in float32.
    Bfloat16,
    /// Weights quantised to int8, one scale for each output; activations to 8 bits (7 where the CPU has no
    /// int8 dot product), one scale for each row; sums in int32.
    Int8,
}

/// How weights, or keys and values, are held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Element {
    /// float32.
    F32,
    /// bfloat16.
    Bf16,
    /// int8 with a float32 scale for each output.
    Int8,
}

/// Weights to pack, `(out_features, in_features)`, of any strides.
#[derive(Clone, Copy, Debug)]
pub enum WeightRef<'a> {
    /// float32.
    F32(Matrix<'a, f32>),
    /// bfloat16.
    Bf16(Matrix<'a, bf16>),
    /// int8 as [`quantize_rows`] makes it: a weight is its value times the scale of its row.
    Int8 {
        /// -127 to 127.
        values: Matrix<'a, i8>,
        /// One for each row.
        scales: &'a [f32],
    },
}

impl WeightRef<'_> {
    /// `(out_features, in_features)`.
    #[must_use]
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::F32(view) => (view.num_rows(), view.num_columns()),
            Self::Bf16(view) => (view.num_rows(), view.num_columns()),
            Self::Int8 { values, .. } => (values.num_rows(), values.num_columns()),
        }
    }

    /// The rows in `rows`.
    #[must_use]
    pub fn rows(&self, rows: Range<usize>) -> Self {
        match self {
            Self::F32(view) => Self::F32(view.rows(rows)),
            Self::Bf16(view) => Self::Bf16(view.rows(rows)),
            Self::Int8 { values, scales } => Self::Int8 {
                values: values.rows(rows.clone()),
                scales: &scales[rows],
            },
        }
    }
}

/// Quantises the rows of `weight (out_features, in_features)` to int8 as
/// [`PackedLinear::pack`](crate::PackedLinear::pack) does: `scale = max |w| / 127` of the row, `value = w /
/// scale` to the nearest, ties to even. `values` is row-major, `scales` has one element for each row.
///
/// A row whose elements are all smaller than 127 times the smallest normal number (1.5e-36) becomes zeros
/// with the scale 0; one with NaN or infinity becomes zeros with the scale NaN. Weights that are int8 already
/// are copied.
///
/// # Panics
/// If `values` or `scales` have another length.
///
/// ```
/// use saccade_vla_kernels::{Matrix, WeightRef, quantize_rows};
/// let weight = WeightRef::F32(Matrix::new(&[1.0, -0.5, 0.0, 0.25], 2));
/// let (mut values, mut scales) = ([0; 4], [0.0; 2]);
/// quantize_rows(weight, &mut values, &mut scales);
/// assert_eq!((values, scales), ([127, -64, 0, 127], [1.0 / 127.0, 0.25 / 127.0]));
/// ```
pub fn quantize_rows(weight: WeightRef<'_>, values: &mut [i8], scales: &mut [f32]) {
    let (rows, inputs) = weight.shape();
    assert_eq!(
        Some(values.len()),
        rows.checked_mul(inputs),
        "values: expected the elements of weight"
    );
    assert_eq!(scales.len(), rows, "scales: expected one for each row of weight");
    if let WeightRef::Int8 {
        values: from,
        scales: from_scales,
    } = weight
    {
        scales.copy_from_slice(from_scales);
        for (row, to) in values.chunks_exact_mut(inputs.max(1)).enumerate() {
            to.iter_mut()
                .enumerate()
                .for_each(|(k, to)| *to = from.get(row, k));
        }
        return;
    }
    for (row, scale) in scales.iter_mut().enumerate() {
        *scale = row_scale(&weight, row);
        let to = &mut values[row * inputs..][..inputs];
        match &weight {
            WeightRef::F32(view) => elements(*view, row, |k, value| to[k] = quantize(value, *scale)),
            WeightRef::Bf16(view) => {
                elements(*view, row, |k, value| to[k] = quantize(value.to_f32(), *scale))
            }
            WeightRef::Int8 { .. } => unreachable!("copied above"),
        }
    }
}

/// The scale of row `row`: that of int8 weights, or the one that they are quantised with.
pub(crate) fn row_scale(weight: &WeightRef<'_>, row: usize) -> f32 {
    // Magnitudes are ordered as their bits are; NaN and infinity come last.
    let mut largest = 0;
    let mut look = |value: f32| largest = largest.max(value.to_bits() & 0x7fff_ffff);
    match weight {
        WeightRef::F32(view) => elements(*view, row, |_, value| look(value)),
        WeightRef::Bf16(view) => elements(*view, row, |_, value| look(value.to_f32())),
        WeightRef::Int8 { scales, .. } => return scales[row],
    }
    let largest = f32::from_bits(largest);
    let scale = largest / 127.0;
    if !largest.is_finite() {
        f32::NAN
    } else if scale < f32::MIN_POSITIVE {
        0.0
    } else {
        scale
    }
}

/// `value / scale` to the nearest, ties to even; 0 where the scale is 0 or NaN.
#[inline(always)]
pub(crate) fn quantize(value: f32, scale: f32) -> i8 {
    /// Adding it rounds to a whole number, ties to even, which is then the difference of the bits: 1.5 *
    /// 2^23.
    const ROUND: f32 = 12_582_912.0;
    let steps = (value / scale + ROUND).to_bits().wrapping_sub(ROUND.to_bits()) as i8;
    if scale > 0.0 { steps } else { 0 }
}

/// Calls `f(column, element)` for row `row`.
#[inline(always)]
fn elements<T: Copy>(view: Matrix<'_, T>, row: usize, mut f: impl FnMut(usize, T)) {
    if let Some(row) = view.contiguous_row(row) {
        row.iter().enumerate().for_each(|(k, &value)| f(k, value));
    } else {
        (0..view.num_columns()).for_each(|k| f(k, view.get(row, k)));
    }
}
