//! Cubic and linear resizing of bytes in whole numbers, antialiased: torch's and Pillow's.
//!
//! Equations 42 and 43 of docs/equations.md.

use super::taps::Taps;
use super::{Image, Sums, TOGETHER, resized};
use crate::aligned::AllocError;
use crate::isa::Isa;

/// Whose rounding of the weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WeightRounding {
    /// torch's `interpolate(..., antialias=True)` of uint8: as many bits as keep every weight in 16.
    Torch,
    /// Pillow's `resize(..., Image.BICUBIC)`: 22 bits.
    Pillow,
}

/// Bits of Pillow's weights, and the most that torch's have.
const MAX_BITS: u32 = 22;

/// What the inputs around an output weigh.
#[derive(Clone, Copy)]
struct Filter {
    /// Inputs on either side of an output that is as large as they.
    support: f64,
    /// The weight at a distance.
    weight: fn(f64) -> f64,
}

const CUBIC: Filter = Filter {
    support: 2.0,
    weight: cubic,
};

const LINEAR: Filter = Filter {
    support: 1.0,
    weight: |x| (1.0 - x.abs()).max(0.0),
};

/// `image` resized to `(height, width, 3)`: cubic with `a = -0.5`, antialiased, along the width and then along the height, each result rounded
/// to bytes. A pass that would change no size is left out.
///
/// ```
/// use saccade_vla_kernels::{WeightRounding, Image, Isa, resize_cubic_u8};
/// let grey = vec![100; 40 * 30 * 3];
/// let small = resize_cubic_u8(Isa::best(), Image::new(&grey, 40, 30), 20, 20, WeightRounding::Torch)?;
/// assert_eq!(small, vec![100; 20 * 20 * 3]);
/// # Ok::<(), saccade_vla_kernels::AllocError>(())
/// ```
///
/// # Errors
/// If the system refuses the memory.
///
/// # Panics
/// If `height` or `width` is 0, or if this CPU lacks `isa`.
pub fn resize_cubic_u8(
    isa: Isa,
    image: Image<'_>,
    height: usize,
    width: usize,
    rule: WeightRounding,
) -> Result<Vec<u8>, AllocError> {
    resize_u8(isa, image, height, width, CUBIC, rule)
}

/// `image` resized to `(height, width, 3)` as torch's `interpolate(..., mode="bilinear", antialias=True)` of uint8 does it on x86-64 with AVX2
/// and on ARM: linear, along the width and then along the height, each result rounded to bytes.
///
/// ```
/// use saccade_vla_kernels::{Image, Isa, resize_linear_u8};
/// let pixels = [0, 0, 0, 100, 100, 100];
/// let wide = resize_linear_u8(Isa::best(), Image::new(&pixels, 1, 2), 1, 4)?;
/// assert_eq!(wide, [0, 0, 0, 25, 25, 25, 75, 75, 75, 100, 100, 100]);
/// # Ok::<(), saccade_vla_kernels::AllocError>(())
/// ```
///
/// # Errors
/// If the system refuses the memory.
///
/// # Panics
/// If `height` or `width` is 0, or if this CPU lacks `isa`.
pub fn resize_linear_u8(
    isa: Isa,
    image: Image<'_>,
    height: usize,
    width: usize,
) -> Result<Vec<u8>, AllocError> {
    resize_u8(isa, image, height, width, LINEAR, WeightRounding::Torch)
}

fn resize_u8(
    isa: Isa,
    image: Image<'_>,
    height: usize,
    width: usize,
    filter: Filter,
    rule: WeightRounding,
) -> Result<Vec<u8>, AllocError> {
    assert!(height > 0 && width > 0);
    let sums = |from, to| Weighted::new(from, to, filter, rule);
    resized(isa, image, height, width, sums)
}

/// The sums of one axis.
struct Weighted {
    taps: Taps<i32>,
    bits: u32,
}

impl Weighted {
    fn new(from: usize, to: usize, filter: Filter, rule: WeightRounding) -> Result<Self, AllocError> {
        let taps = exact_taps(from, to, filter)?;
        let bits = match rule {
            WeightRounding::Pillow => MAX_BITS,
            WeightRounding::Torch => {
                let largest = taps.weights().iter().copied().fold(0.0, f64::max);
                let fits = |bits: &u32| 0.5 + largest * f64::from(1 << bits) < f64::from(1 << 15);
                (0..=MAX_BITS).rev().find(fits).unwrap_or(0)
            }
        };
        let one = f64::from(1 << bits);
        // Half is added towards the sign, and `as` truncates.
        let taps = taps.map(|weight| (weight * one + 0.5_f64.copysign(weight)) as i32)?;
        Ok(Self { taps, bits })
    }
}

/// The weights in double.
fn exact_taps(from: usize, to: usize, filter: Filter) -> Result<Taps<f64>, AllocError> {
    let scale = from as f64 / to as f64;
    let stretch = scale.max(1.0);
    let support = filter.support * stretch;
    let shrink = 1.0 / stretch;
    let mut taps = Taps::with_room(to)?;
    let mut weights = super::reserved((2.0 * support) as usize + 3)?;
    for output in 0..to {
        let centre = scale * (output as f64 + 0.5);
        // A negative number becomes 0.
        let first = (centre - support + 0.5) as usize;
        let end = ((centre + support + 0.5) as usize).min(from);
        weights.clear();
        weights.extend((first..end).map(|input| (filter.weight)((input as f64 - centre + 0.5) * shrink)));
        let sum: f64 = weights.iter().sum();
        weights.iter_mut().for_each(|weight| *weight /= sum);
        taps.push(first, &weights)?;
    }
    Ok(taps)
}

/// The cubic of Keys with `a = -0.5`.
fn cubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    let x = x.abs();
    if x < 1.0 {
        ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        (((x - 5.0) * x + 8.0) * x - 4.0) * A
    } else {
        0.0
    }
}

impl Sums for Weighted {
    type Value = u8;

    fn num_outputs(&self) -> usize {
        self.taps.len()
    }

    #[inline(always)]
    fn value(byte: u8) -> u8 {
        byte
    }

    #[inline(always)]
    fn sum(&self, index: usize, inputs: &[u8], inner: usize, out: &mut [u8]) {
        let (first, weights) = self.taps.of(index);
        let half = (1 << self.bits) >> 1;
        let inputs = &inputs[first * inner..(first + weights.len()) * inner];
        for start in (0..inner).step_by(TOGETHER) {
            let len = TOGETHER.min(inner - start);
            let mut sums = [half; TOGETHER];
            for tap in 0..weights.len() {
                let weight = weights[tap];
                let row = &inputs[tap * inner + start..][..len];
                if let Ok(row) = <&[u8; TOGETHER]>::try_from(row) {
                    for index in 0..TOGETHER {
                        sums[index] += weight * i32::from(row[index]);
                    }
                } else {
                    for index in 0..len {
                        sums[index] += weight * i32::from(row[index]);
                    }
                }
            }
            let out = &mut out[start..start + len];
            for index in 0..len {
                out[index] = (sums[index] >> self.bits).clamp(0, 255) as u8;
            }
        }
    }
}
