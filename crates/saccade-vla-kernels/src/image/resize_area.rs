//! OpenCV's INTER_AREA of bytes.
//!
//! Equation 45 of docs/equations.md.

use super::taps::Taps;
use super::{CHANNELS, Image, Sums, along_height, along_width, area, blank, reserved, sum_rows};
use crate::aligned::AllocError;
use crate::isa::Isa;

/// `image` resized to `(height, width, 3)` as OpenCV's `resize(..., interpolation=INTER_AREA)` does it: the mean over the area that an output
/// covers where neither side grows, and else linear in 11 bits.
///
/// ```
/// use saccade_vla_kernels::{Image, Isa, resize_area};
/// let pixels: Vec<u8> = (0..4).flat_map(|value| [10 * value; 3]).collect();
/// let mean = resize_area(Isa::best(), Image::new(&pixels, 2, 2), 1, 1)?;
/// assert_eq!(mean, [15; 3]);
/// # Ok::<(), saccade_vla_kernels::AllocError>(())
/// ```
///
/// # Errors
/// If the system refuses the memory.
///
/// # Panics
/// If `height` or `width` is 0, or if this CPU lacks `isa`.
pub fn resize_area(isa: Isa, image: Image<'_>, height: usize, width: usize) -> Result<Vec<u8>, AllocError> {
    assert!(height > 0 && width > 0);
    if (image.height, image.width) == (height, width) {
        return image.to_vec();
    }
    if height > image.height || width > image.width {
        return grown(isa, image, height, width);
    }
    if image.height.is_multiple_of(height) && image.width.is_multiple_of(width) {
        return cells(image, height, width);
    }
    let narrow = along_width(isa, &Area::new(image.width, width)?, image)?;
    let sums = along_height(isa, &Area::new(image.height, height)?, &narrow, width)?;
    let mut pixels = blank(sums.len())?;
    for index in 0..sums.len() {
        pixels[index] = rounded(sums[index]);
    }
    Ok(pixels)
}

/// To the nearest byte, ties to even. The sum has no bits for a fraction, so that it is rounded; that needs no call where an instruction set
/// has no rounding of its own.
fn rounded(value: f32) -> u8 {
    const NO_FRACTION: f32 = 12_582_912.0;
    (value + NO_FRACTION - NO_FRACTION) as u8
}

/// The mean of cells of whole pixels.
fn cells(image: Image<'_>, height: usize, width: usize) -> Result<Vec<u8>, AllocError> {
    let (down, across) = (image.height / height, image.width / width);
    let one = 1.0 / (down * across) as f32;
    let is_quad = (down, across) == (2, 2);
    let mut pixels = blank(area(height, width)?)?;
    let mut sums = blank::<u64>(area(1, width)?)?;
    for (y, pixels) in pixels.chunks_exact_mut(sums.len()).enumerate() {
        sums.fill(0);
        for row in y * down..(y + 1) * down {
            let row = image.row(row);
            for index in 0..row.len() {
                let (pixel, channel) = (index / CHANNELS, index % CHANNELS);
                sums[pixel / across * CHANNELS + channel] += u64::from(row[index]);
            }
        }
        for index in 0..sums.len() {
            pixels[index] = match is_quad {
                true => ((sums[index] + 2) >> 2) as u8,
                false => rounded(sums[index] as f32 * one),
            };
        }
    }
    Ok(pixels)
}

/// Sums over the part of the axis that an output covers.
struct Area(Taps<f32>);

/// A part of a pixel that is less than this does not count.
const LEAST: f64 = 1e-3;

impl Area {
    fn new(from: usize, to: usize) -> Result<Self, AllocError> {
        let scale = from as f64 / to as f64;
        let mut taps = Taps::with_room(to)?;
        let mut weights = reserved(scale as usize + 3)?;
        for output in 0..to {
            let begin = output as f64 * scale;
            let end = begin + scale;
            let cell = scale.min(from as f64 - begin);
            let last = (end.floor() as usize).min(from - 1);
            let whole = (begin.ceil() as usize).min(last);
            weights.clear();
            let mut first = whole;
            if whole as f64 - begin > LEAST {
                first -= 1;
                weights.push(((whole as f64 - begin) / cell) as f32);
            }
            weights.extend((whole..last).map(|_| (1.0 / cell) as f32));
            if end - last as f64 > LEAST {
                weights.push(((end - last as f64).min(1.0).min(cell) / cell) as f32);
            }
            taps.push(first, &weights)?;
        }
        Ok(Self(taps))
    }
}

impl Sums for Area {
    type Value = f32;

    fn num_outputs(&self) -> usize {
        self.0.len()
    }

    #[inline(always)]
    fn value(byte: u8) -> f32 {
        f32::from(byte)
    }

    #[inline(always)]
    fn sum(&self, index: usize, inputs: &[f32], inner: usize, out: &mut [f32]) {
        let (first, weights) = self.0.of(index);
        sum_rows(&inputs[first * inner..], weights, weights.len(), inner, out);
    }
}

/// Two neighbours on each axis, with weights of 11 bits.
fn grown(isa: Isa, image: Image<'_>, height: usize, width: usize) -> Result<Vec<u8>, AllocError> {
    let wide = along_width(isa, &Neighbours::new(image.width, width)?, image)?;
    let rows = Neighbours::new(image.height, height)?.0;
    let row_len = width * CHANNELS;
    let mut pixels = blank(area(height, width)?)?;
    for (output, pixels) in pixels.chunks_exact_mut(row_len).enumerate() {
        let (first, weights) = rows.of(output);
        let row = |index: usize| &wide[index * row_len..][..row_len];
        let (upper, lower) = (row(first), row((first + 1).min(image.height - 1)));
        let part = |sum: i32, weight: i32| (weight * (sum >> 4)) >> 16;
        for index in 0..row_len {
            let sum = (part(upper[index], weights[0]) + part(lower[index], weights[1]) + 2) >> 2;
            pixels[index] = sum.clamp(0, 255) as u8;
        }
    }
    Ok(pixels)
}

/// For each output an input and the one after it. At the end of the axis the second one counts nothing.
struct Neighbours(Taps<i32>);

impl Neighbours {
    fn new(from: usize, to: usize) -> Result<Self, AllocError> {
        let inverse = to as f64 / from as f64;
        let scale = 1.0 / inverse;
        let mut taps = Taps::with_room(to)?;
        for output in 0..to {
            let first = (output as f64 * scale).floor() as usize;
            let past = ((output + 1) as f64 - (first + 1) as f64 * inverse) as f32;
            let (first, part) = match first >= from - 1 {
                true => (from - 1, 0.0),
                false => (first, if past <= 0.0 { 0.0 } else { past - past.floor() }),
            };
            let weight = |part: f32| (part * 2048.0).round_ties_even() as i32;
            taps.push(first, &[weight(1.0 - part), weight(part)])?;
        }
        Ok(Self(taps))
    }
}

impl Sums for Neighbours {
    type Value = i32;

    fn num_outputs(&self) -> usize {
        self.0.len()
    }

    #[inline(always)]
    fn value(byte: u8) -> i32 {
        i32::from(byte)
    }

    #[inline(always)]
    fn sum(&self, index: usize, inputs: &[i32], inner: usize, out: &mut [i32]) {
        let (first, weights) = self.0.of(index);
        let left = &inputs[first * inner..][..inner];
        // There is none after the last one, which then counts alone.
        let right = inputs
            .get((first + 1) * inner..(first + 2) * inner)
            .unwrap_or(left);
        for index in 0..inner {
            out[index] = left[index] * weights[0] + right[index] * weights[1];
        }
    }
}
