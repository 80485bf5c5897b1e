//! Rows converted to the elements that are multiplied: rounded to bfloat16, or quantised to bytes.
//!
//! Equations 36 and 38 of docs/equations.md.

use std::marker::PhantomData;

use super::elements::{Elements, RowElements};
use super::outliers::Outliers;
use super::{Conversion, Quantized};
use crate::simd::bits::cast_slice_mut;
use crate::simd::slices::update;
use crate::simd::{Kernel, Simd};

/// Less than unsigned bytes and zero points by this are [`RowElements::SignedBytes`].
const SIGNED: i32 = 128;

/// Converts rows to those of `E`.
pub(super) struct Convert<'a, E> {
    conversion: Conversion<'a>,
    elements: PhantomData<E>,
}

impl<'a, E> Convert<'a, E> {
    pub(super) fn new(conversion: Conversion<'a>) -> Self {
        let elements = PhantomData;
        Self { conversion, elements }
    }
}

impl<E: Elements> Kernel for Convert<'_, E> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(&mut self, simd: S) {
        let Conversion {
            x,
            words,
            quantized,
            outliers,
        } = &mut self.conversion;
        for (group, words) in words.iter_mut().enumerate() {
            for row in group * E::GROUP..x.num_rows().min((group + 1) * E::GROUP) {
                let place = |element_bytes| Place {
                    group: E::GROUP,
                    row: row % E::GROUP,
                    element_bytes,
                };
                match E::ROWS {
                    RowElements::F32 => unreachable!("read where they are"),
                    RowElements::RoundedF32 => round(simd, x.row(row), words),
                    RowElements::Bf16 => narrow(simd, x.row(row), place(2), cast_slice_mut(words)),
                    RowElements::UnsignedBytes | RowElements::SignedBytes => {
                        let signed = E::ROWS == RowElements::SignedBytes;
                        let bytes = cast_slice_mut(words);
                        let outliers = outliers.as_mut().map(|outliers| &mut outliers.row_mut(row)[0]);
                        let how = quantize(simd, x.row(row), signed, place(1), bytes, outliers);
                        if let Some(quantized) = quantized {
                            quantized.row_mut(row)[0] = how;
                        }
                    }
                }
            }
        }
    }
}

/// Where elements of a row are in its group.
#[derive(Clone, Copy)]
struct Place {
    group: usize,
    row: usize,
    element_bytes: usize,
}

impl Place {
    /// The index of element number `index`: rows of a group alternate by eight bytes.
    #[inline(always)]
    fn of(self, index: usize) -> usize {
        if self.group == 1 {
            return index;
        }
        let together = 8 / self.element_bytes;
        (index / together * self.group + self.row) * together + index % together
    }
}

/// Rounds a row to what bfloat16 can hold, as float32.
#[inline(always)]
fn round<S: Simd>(simd: S, x: &[f32], words: &mut [u32]) {
    let to: &mut [f32] = cast_slice_mut(words);
    update(simd, &mut to[..x.len()], [x], |_, [x]| simd.round_to_bf16(x));
}

/// Rounds a row to bfloat16. In pairs of rows by the instruction that multiplies them.
#[inline(always)]
fn narrow<S: Simd>(simd: S, x: &[f32], place: Place, to: &mut [u16]) {
    for (index, x) in x.chunks(S::LANES).enumerate() {
        let (x, to) = (simd.load_partial(x), &mut to[place.of(index * S::LANES)..]);
        if place.group == 1 {
            simd.store_bf16(x, to);
        } else {
            let mut both = [0; 2 * crate::simd::MAX_LANES];
            simd.store_bf16_pair(x, x, &mut both);
            to[..S::LANES].copy_from_slice(&both[..S::LANES]);
        }
    }
}

/// Quantises a row to `0 ..= S::MAX_BYTE`, over the range of its values and zero: `byte = zero + round(x /
/// scale)`, ties to even; `signed` bytes are less by 128.
///
/// Relative error of a layer of 1536 inputs with int8 weights, all standard normal, and in brackets that of
/// symmetric quantisation: 0.0113 (0.0115); of rows after GELU 0.0102 (0.0143); with four channels ten times
/// as large 0.0234 (0.0308). The weights alone are 0.0081 of it. With bytes up to 129, as without VNNI:
/// 0.0173 (0.0187), 0.0146 (0.0247), 0.0435 (0.0616).
///
/// A row that is nowhere larger than about 1e-36 counts as zero. One with NaN or infinity gets the scale NaN.
/// If outliers are to be kept apart, they are zeros in the bytes.
#[inline(always)]
fn quantize<S: Simd>(
    simd: S,
    x: &[f32],
    signed: bool,
    place: Place,
    bytes: &mut [u8],
    mut outliers: Option<&mut Outliers>,
) -> Quantized {
    let (mut quantized, inverse) = quantization(simd, x, outliers.as_deref_mut());
    let mut most = i32::from(S::MAX_BYTE);
    if signed {
        quantized.zero = quantized.zero.wrapping_sub(SIGNED);
        most -= SIGNED;
    }
    let (inverse, most) = (simd.splat(inverse), simd.splat_i32(most));
    let zero = simd.splat_i32(quantized.zero);
    for (index, x) in x.chunks(S::LANES).enumerate() {
        let steps = simd.mul(simd.load_partial(x), inverse);
        simd.store_bytes(steps, zero, most, &mut bytes[place.of(index * S::LANES)..]);
    }
    if let Some(outliers) = outliers {
        for (input, _) in outliers.iter() {
            bytes[place.of(input)] = quantized.zero as u8;
        }
    }
    quantized
}

/// How a row is quantised, and what its elements are multiplied with: one over the scale, or zero for a row
/// that counts as zero. If outliers are to be kept apart, they are found here.
#[inline(always)]
fn quantization<S: Simd>(simd: S, x: &[f32], outliers: Option<&mut Outliers>) -> (Quantized, f32) {
    let zero = simd.splat(0.0);
    let (mut lows, mut highs, mut not_finite) = ([zero; CHAINS], [zero; CHAINS], [zero; CHAINS]);
    in_chains(simd, x, |chain, x| {
        lows[chain] = simd.min(x, lows[chain]);
        highs[chain] = simd.max(x, highs[chain]);
        // Zero, except that infinity and NaN give NaN.
        not_finite[chain] = simd.fma(x, zero, not_finite[chain]);
    });
    let (mut low, mut high) = (-largest(simd, lows, -1.0), largest(simd, highs, 1.0));
    let is_not_finite = simd.reduce_add(sum(simd, not_finite)).is_nan();
    if let Some(outliers) = outliers {
        let (found, limit) = Outliers::of(x, magnitudes(simd, x), high.max(-low));
        if !found.is_empty() {
            let rest = |value: f32| if value.abs() > limit { 0.0 } else { value };
            low = x.iter().fold(0.0, |low, &value| low.min(rest(value)));
            high = x.iter().fold(0.0, |high, &value| high.max(rest(value)));
        }
        *outliers = found;
    }
    let steps = f32::from(S::MAX_BYTE);
    // Not the difference, which could overflow.
    let scale = high / steps - low / steps;
    let is_zero = scale < f32::MIN_POSITIVE;
    let inverse = if is_zero { 0.0 } else { 1.0 / scale };
    let scale = if is_not_finite {
        f32::NAN
    } else if is_zero {
        0.0
    } else {
        scale
    };
    let zero = (-low * inverse).round_ties_even() as i32;
    (Quantized { scale, zero }, inverse)
}

/// The sum of the magnitudes.
#[inline(always)]
fn magnitudes<S: Simd>(simd: S, x: &[f32]) -> f32 {
    let zero = simd.splat(0.0);
    let mut sums = [zero; CHAINS];
    in_chains(simd, x, |chain, x| {
        sums[chain] = simd.add(simd.max(x, simd.sub(zero, x)), sums[chain]);
    });
    simd.reduce_add(sum(simd, sums))
}

/// Chains of operations that do not wait for each other.
const CHAINS: usize = 4;

/// The sum of the chains.
#[inline(always)]
fn sum<S: Simd>(simd: S, chains: [S::F32; CHAINS]) -> S::F32 {
    let [a, b, c, d] = chains;
    simd.add(simd.add(a, b), simd.add(c, d))
}

/// The largest element of the chains times `sign`.
#[inline(always)]
fn largest<S: Simd>(simd: S, mut chains: [S::F32; CHAINS], sign: f32) -> f32 {
    for chain in &mut chains {
        *chain = simd.mul(*chain, simd.splat(sign));
    }
    let [a, b, c, d] = chains;
    simd.reduce_max(simd.max(simd.max(a, b), simd.max(c, d)))
}

/// Calls `f(chain, vector)` for all of `x`; what is left of it is of chain 0.
#[inline(always)]
fn in_chains<S: Simd>(simd: S, x: &[f32], mut f: impl FnMut(usize, S::F32)) {
    let mut turns = x.chunks_exact(CHAINS * S::LANES);
    for turn in turns.by_ref() {
        for chain in 0..CHAINS {
            f(chain, simd.load(&turn[chain * S::LANES..]));
        }
    }
    for x in turns.remainder().chunks(S::LANES) {
        f(0, simd.load_partial(x));
    }
}
