//! Linear, antialiased resizing in float32, as torch 2.9 for x86-64 does it.
//!
//! Equation 44 of docs/equations.md.

use super::taps::Taps;
use super::{Image, Sums, blank, reserved, resized, sum_rows};
use crate::aligned::AllocError;
use crate::isa::Isa;

/// An image in float32: 0 is black and 1 is full.
#[derive(Clone, Debug, PartialEq)]
pub struct FloatImage {
    /// `(height, width, 3)`.
    pub pixels: Vec<f32>,
    /// Number of rows.
    pub height: usize,
    /// Number of columns.
    pub width: usize,
}

impl FloatImage {
    /// Times 255 in float32, truncated to bytes: `(height, width, 3)`.
    ///
    /// # Errors
    /// If the system refuses the memory.
    pub fn truncated(&self) -> Result<Vec<u8>, AllocError> {
        let mut bytes = blank(self.pixels.len())?;
        for index in 0..bytes.len() {
            bytes[index] = (self.pixels[index] * 255.0) as u8;
        }
        Ok(bytes)
    }
}

/// `image / 255` resized to `(height, width, 3)`: linear, antialiased, along the width and then along the height, as torch's
/// `interpolate(..., mode="bilinear", antialias=True)` of float32.
///
/// The taps of an output are summed as torch's compiled loop does: of those after the first, four at a time with a rounded product, the last
/// ones fused. A pass that would change no size is left out: its weights are one and zero.
///
/// ```
/// use saccade_vla_kernels::{Image, Isa, resize_linear_f32};
/// let white = vec![255; 40 * 30 * 3];
/// let small = resize_linear_f32(Isa::best(), Image::new(&white, 40, 30), 20, 20)?;
/// assert!(small.pixels.iter().all(|value| (value - 1.0).abs() < 1e-6));
/// # Ok::<(), saccade_vla_kernels::AllocError>(())
/// ```
///
/// # Errors
/// If the system refuses the memory.
///
/// # Panics
/// If `height` or `width` is 0, or if this CPU lacks `isa`.
pub fn resize_linear_f32(
    isa: Isa,
    image: Image<'_>,
    height: usize,
    width: usize,
) -> Result<FloatImage, AllocError> {
    assert!(height > 0 && width > 0);
    Ok(FloatImage {
        pixels: resized(isa, image, height, width, Linear::new)?,
        height,
        width,
    })
}

/// The sums of one axis.
struct Linear(Taps<f32>);

impl Linear {
    /// Every `as f32` is where torch rounds to float32; between them it computes in double.
    fn new(from: usize, to: usize) -> Result<Self, AllocError> {
        let scale = (from as f64 / to as f64) as f32;
        let support = scale.max(1.0);
        let shrink = match scale >= 1.0 {
            true => 1.0 / scale,
            false => 1.0,
        };
        let mut taps = Taps::with_room(to)?;
        let mut weights: Vec<f32> = reserved((2.0 * support) as usize + 3)?;
        for output in 0..to {
            let centre = (f64::from(scale) * (output as f64 + 0.5)) as f32;
            // A negative number becomes 0.
            let first = (f64::from(centre - support) + 0.5) as usize;
            let end = ((f64::from(centre + support) + 0.5) as usize).min(from);
            weights.clear();
            weights.extend((first..end).map(|input| {
                let distance = (input as f64 - f64::from(centre)) as f32;
                let x = ((f64::from(distance) + 0.5) * f64::from(shrink)) as f32;
                match x.abs() < 1.0 {
                    true => 1.0 - x.abs(),
                    false => 0.0,
                }
            }));
            let sum = weights.iter().fold(0.0, |sum, weight| sum + weight);
            weights.iter_mut().for_each(|weight| *weight /= sum);
            taps.push(first, &weights)?;
        }
        Ok(Self(taps))
    }
}

impl Sums for Linear {
    type Value = f32;

    fn num_outputs(&self) -> usize {
        self.0.len()
    }

    #[inline(always)]
    fn value(byte: u8) -> f32 {
        f32::from(byte) / 255.0
    }

    #[inline(always)]
    fn sum(&self, index: usize, inputs: &[f32], inner: usize, out: &mut [f32]) {
        let (first, weights) = self.0.of(index);
        // The first tap, and as many fours of the others as there are.
        let rounded = 1 + (weights.len() - 1) / 4 * 4;
        sum_rows(&inputs[first * inner..], weights, rounded, inner, out);
    }
}

#[cfg(test)]
mod tests {
    use super::super::{along_height, along_width};
    use super::*;

    #[test]
    fn an_axis_that_keeps_its_length_has_the_bits_of_its_sums() {
        // The bytes count up, so the crop of the last 16 rows and columns has every value.
        let all: Vec<u8> = (0..20 * 18 * 3).map(|index| (index % 256) as u8).collect();
        let image = Image::new(&all, 20, 18).crop(4, 2, 16, 16);
        for isa in Isa::available() {
            for (height, width) in [(16, 16), (16, 5), (3, 16)] {
                let narrow = along_width(isa, &Linear::new(16, width).unwrap(), image).unwrap();
                let expected = along_height(isa, &Linear::new(16, height).unwrap(), &narrow, width).unwrap();
                let found = resize_linear_f32(isa, image, height, width).unwrap();
                assert!(
                    found
                        .pixels
                        .iter()
                        .map(|value| value.to_bits())
                        .eq(expected.iter().map(|value| value.to_bits()))
                );
            }
        }
    }
}
