//! Weights as they are stored, the arithmetic that multiplies them, and their quantisation to int8 and int4.
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
    /// The same with weights quantised to four bits: half of the memory.
    Int4,
}

impl Arithmetic {
    /// The element that float32 weights are packed as.
    pub(crate) fn element(self) -> Element {
        match self {
            Self::Float32 => Element::F32,
            Self::Bfloat16 => Element::Bf16,
            Self::Int8 => Element::Int8,
            Self::Int4 => Element::Int4,
        }
    }
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
    /// Four bits with a float32 scale for each output.
    Int4,
}

impl Element {
    /// Whether weights are whole numbers times the scales of their outputs.
    pub(crate) fn is_quantized(self) -> bool {
        matches!(self, Self::Int8 | Self::Int4)
    }
}

/// The largest magnitude of a weight in int8, and of one in int4.
const MOST_INT8: f32 = 127.0;
const MOST_INT4: f32 = 7.0;

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
    /// int4 as [`quantize_rows_int4`] makes it: two weights in a byte, the first one in its low half.
    Int4 {
        /// `(out_features, in_features / 2)`, rounded up: four bits of two's complement, -7 to 7. If the number of
        /// inputs is odd, the high half of a row's last byte is zero.
        values: Matrix<'a, u8>,
        /// Weights of a row.
        in_features: usize,
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
            Self::Int4 {
                values, in_features, ..
            } => (values.num_rows(), *in_features),
        }
    }

    /// The scales of int8 or int4.
    pub(crate) fn scales(&self) -> Option<&[f32]> {
        match self {
            Self::Int8 { scales, .. } | Self::Int4 { scales, .. } => Some(scales),
            Self::F32(_) | Self::Bf16(_) => None,
        }
    }

    /// Calls `f(input, weight)` for row `row`.
    #[inline(always)]
    pub(crate) fn each(&self, row: usize, mut f: impl FnMut(usize, f32)) {
        match *self {
            Self::F32(view) => elements(view, row, f),
            Self::Bf16(view) => elements(view, row, |k, value| f(k, value.to_f32())),
            Self::Int8 { values, scales } => {
                elements(values, row, |k, value| f(k, f32::from(value) * scales[row]))
            }
            Self::Int4 {
                values,
                in_features,
                scales,
            } => elements(values, row, |k, pair| {
                let [low, high] = nibbles(pair).map(|value| f32::from(value) * scales[row]);
                f(2 * k, low);
                if 2 * k + 1 < in_features {
                    f(2 * k + 1, high);
                }
            }),
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
            Self::Int4 {
                values,
                in_features,
                scales,
            } => Self::Int4 {
                values: values.rows(rows.clone()),
                in_features: *in_features,
                scales: &scales[rows],
            },
        }
    }
}

/// The two weights of a byte of int4.
#[inline(always)]
pub(crate) fn nibbles(pair: u8) -> [i8; 2] {
    [(pair << 4).cast_signed() >> 4, pair.cast_signed() >> 4]
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
            elements(from, row, |k, value| to[k] = value);
        }
        return;
    }
    for (row, scale) in scales.iter_mut().enumerate() {
        *scale = row_scale(&weight, row);
        let to = &mut values[row * inputs..][..inputs];
        weight.each(row, |k, value| to[k] = quantize(value, *scale));
    }
}

/// Quantises the rows of `weight (out_features, in_features)` to int4 as
/// [`PackedLinear::pack`](crate::PackedLinear::pack) does: `value = w / scale` to the nearest, ties to even, and to
/// -7 or 7 beyond them. `values (out_features, in_features / 2)`, rounded up, has two weights in a byte, the first
/// one in its low half; `scales` has one element for each row.
///
/// The scale is `max |w| / 7` of the row times 1, 11 / 12, ... or 5 / 12, whichever gives the least squared error,
/// the larger one if there are several. Rows of zeros, NaN and infinity are treated as by [`quantize_rows`]; weights
/// that are int4 already are copied.
///
/// # Panics
/// If `values`, `scales` or the rows of int4 weights have another length.
///
/// ```
/// use saccade_vla_kernels::{Matrix, WeightRef, quantize_rows_int4};
/// let weight = WeightRef::F32(Matrix::new(&[7.0, -3.2, 0.0], 3));
/// let (mut values, mut scales) = ([0; 2], [0.0; 1]);
/// quantize_rows_int4(weight, &mut values, &mut scales);
/// assert_eq!((values, scales), ([0xd7, 0x00], [1.0]));
/// ```
pub fn quantize_rows_int4(weight: WeightRef<'_>, values: &mut [u8], scales: &mut [f32]) {
    let (rows, inputs) = weight.shape();
    let width = inputs.div_ceil(2);
    assert_eq!(
        Some(values.len()),
        rows.checked_mul(width),
        "values: expected half as many bytes as weight has elements"
    );
    assert_eq!(scales.len(), rows, "scales: expected one for each row of weight");
    if let WeightRef::Int4 {
        values: from,
        scales: from_scales,
        ..
    } = weight
    {
        assert_eq!(
            from.num_columns(),
            width,
            "weight: expected bytes for {inputs} inputs"
        );
        scales.copy_from_slice(from_scales);
        for (row, to) in values.chunks_exact_mut(width.max(1)).enumerate() {
            elements(from, row, |k, pair| to[k] = pair);
        }
        return;
    }
    values.fill(0);
    for (row, scale) in scales.iter_mut().enumerate() {
        *scale = row_scale_int4(&weight, row);
        let to = &mut values[row * width..][..width];
        weight.each(row, |k, value| {
            let nibble = quantize_int4(value, *scale).cast_unsigned() & 15;
            to[k / 2] |= nibble << (4 * (k % 2));
        });
    }
}

/// The scale of row `row` in int8: its own, or the one that it is quantised with.
pub(crate) fn row_scale(weight: &WeightRef<'_>, row: usize) -> f32 {
    match weight {
        WeightRef::Int8 { scales, .. } => scales[row],
        _ => scale_of_range(weight, row, MOST_INT8),
    }
}

/// The scale of row `row` in int4, likewise.
pub(crate) fn row_scale_int4(weight: &WeightRef<'_>, row: usize) -> f32 {
    if let WeightRef::Int4 { scales, .. } = weight {
        return scales[row];
    }
    let scale = scale_of_range(weight, row, MOST_INT4);
    if scale == 0.0 || scale.is_nan() {
        return scale;
    }
    let mut errors = ClippingErrors::new(scale);
    weight.each(row, |_, value| errors.add(value));
    scale * errors.least()
}

/// The largest magnitude of row `row` as `most` steps.
fn scale_of_range(weight: &WeightRef<'_>, row: usize, most: f32) -> f32 {
    // Magnitudes are ordered as their bits are; NaN and infinity come last.
    let mut largest = 0;
    weight.each(row, |_, value| {
        largest = largest.max(value.to_bits() & 0x7fff_ffff)
    });
    let largest = f32::from_bits(largest);
    let scale = largest / most;
    if !largest.is_finite() {
        f32::NAN
    } else if scale < f32::MIN_POSITIVE {
        0.0
    } else {
        scale
    }
}

/// The squared errors of a row in int4, by scales that are smaller than its range needs.
///
/// Fifteen steps are few: the largest of 2048 weights is 3.5 times as large as most of them. Relative error of a layer
/// of 2048 inputs whose weights are normal, and heavy-tailed (Laplace): 0.15 and 0.24 by the range of each row, 0.11
/// and 0.16 by these; by the range of each 128 weights 0.12 and 0.16, of each 64 0.11 and 0.14. In int8 0.008 and
/// 0.013. So a row has one scale, and its sums stay whole numbers.
struct ClippingErrors {
    inverse: f32,
    /// Weights that are added together, and how many there are.
    chunk: [f32; Self::LANES],
    len: usize,
    sums: [[f32; Self::LANES]; Self::SCALES],
}

impl ClippingErrors {
    const SCALES: usize = 8;
    const LANES: usize = 16;

    fn new(scale: f32) -> Self {
        Self {
            inverse: 1.0 / scale,
            chunk: [0.0; Self::LANES],
            len: 0,
            sums: [[0.0; Self::LANES]; Self::SCALES],
        }
    }

    /// Scale number `index`, as a part of the first one.
    fn ratio(index: usize) -> f32 {
        (12 - index) as f32 / 12.0
    }

    #[inline(always)]
    fn add(&mut self, value: f32) {
        self.chunk[self.len] = value;
        self.len += 1;
        if self.len == Self::LANES {
            self.add_chunk();
        }
    }

    /// In lanes, so that compilers make vectors of them; always in the same order, so that all machines choose the same scale.
    fn add_chunk(&mut self) {
        for (index, sums) in self.sums.iter_mut().enumerate() {
            let ratio = Self::ratio(index);
            let inverse = self.inverse / ratio;
            for (sum, value) in sums.iter_mut().zip(&self.chunk) {
                let steps = value * inverse;
                let nearest = ((steps + ROUND) - ROUND).clamp(-MOST_INT4, MOST_INT4);
                let error = (steps - nearest) * ratio;
                *sum += error * error;
            }
        }
        self.chunk = [0.0; Self::LANES];
        self.len = 0;
    }

    /// The ratio of the first scale with the least error.
    fn least(mut self) -> f32 {
        self.add_chunk();
        let total = |index: usize| self.sums[index].iter().sum::<f32>();
        let least = (1..Self::SCALES).fold(
            0,
            |least, index| if total(index) < total(least) { index } else { least },
        );
        Self::ratio(least)
    }
}

/// Adding it rounds to a whole number, ties to even, which is then the difference of the bits: 1.5 * 2^23.
const ROUND: f32 = 12_582_912.0;

/// `value / scale` to the nearest, ties to even; 0 where the scale is 0 or NaN.
#[inline(always)]
pub(crate) fn quantize(value: f32, scale: f32) -> i8 {
    let steps = (value / scale + ROUND).to_bits().wrapping_sub(ROUND.to_bits()) as i8;
    if scale > 0.0 { steps } else { 0 }
}

/// The same in int4: -7 or 7 beyond them.
#[inline(always)]
pub(crate) fn quantize_int4(value: f32, scale: f32) -> i8 {
    quantize(value, scale).clamp(-MOST_INT4 as i8, MOST_INT4 as i8)
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
