//! Views as large as their frames make them: black bars, crops, sizes, patches.

use saccade_vla_kernels::{Image, Isa, WeightRounding, resize_area, resize_cubic_u8, resize_linear_u8};

use super::frames::{Bytes, CHANNELS, PIXELS, View, kernel, normalized, planes};
use super::options::MAX_AREA;
use super::settings::{Flexible, Geometry};
use crate::alloc::{filled, product};
use crate::array::OwnedArray;
use crate::error::{Error, Result, ensure, problem};
use crate::ops::check_interrupted;
use crate::release::{self, Fitting, Pixels};

/// A frame longer than this on one side, by this factor, is refused by the released processors.
const MAX_RATIO: usize = 200;

/// The view that a frame becomes.
///
/// # Errors
/// [`Error::Input`] for a frame that is too elongated; [`Error::Memory`].
pub(super) fn flexible_view(sizes: &Flexible, isa: Isa, name: &str, frame: Bytes<'_>) -> Result<View> {
    let frame = prepared(sizes, isa, name, frame)?;
    check_ratio(name, frame.height, frame.width)?;
    check_interrupted()?;
    let rules = sizes.rules;
    let (height, width) = fitting(sizes, frame.height, frame.width);
    let pixels = kernel(resize_cubic_u8(isa, frame.image(), height, width, rules.rounding))?;
    let factor = rules.patch_size * rules.merge;
    let (pixels, grid) = match rules.pixels {
        Pixels::Planes => (planes(&pixels, &[1, CHANNELS, height, width])?, None),
        Pixels::Patches { frames } => {
            let grid = [1, height / rules.patch_size, width / rules.patch_size];
            let patches = patches(rules, frames, &pixels, height, width)?;
            (patches, Some(grid.map(|size| size as i64)))
        }
    };
    Ok(View {
        pixels,
        tokens: height * width / (factor * factor),
        grid,
    })
}

fn check_ratio(name: &str, height: usize, width: usize) -> Result<()> {
    let (short, long) = (height.min(width), height.max(width));
    ensure!(
        long <= short.saturating_mul(MAX_RATIO), Input, name;
        expected "sides that differ by a factor of at most {MAX_RATIO}"; got "{height} x {width}"
    );
    Ok(())
}

/// That a frame on its way to a view does not become larger than any view.
fn check_area(name: &str, frame: &Bytes<'_>, height: usize, width: usize) -> Result<()> {
    let most = MAX_AREA.max(frame.height * frame.width);
    match height.checked_mul(width) {
        Some(area) if area <= most => Ok(()),
        _ => Err(Error::Input(problem!(
            name; "expected a frame that is less elongated than {} x {}, which becomes {height} x {width}",
            frame.height, frame.width
        ))),
    }
}

/// The centre of this size. Where it begins is rounded down.
fn crop_floor(image: Image<'_>, height: usize, width: usize) -> Image<'_> {
    let (height, width) = (height.min(image.height()), width.min(image.width()));
    image.crop(
        (image.height() - height) / 2,
        (image.width() - width) / 2,
        height,
        width,
    )
}

/// Black bars make it a square.
fn letter_box<'a>(name: &str, frame: Bytes<'a>) -> Result<Bytes<'a>> {
    if frame.height == frame.width {
        return Ok(frame);
    }
    let side = frame.height.max(frame.width);
    check_area(name, &frame, side, side)?;
    padded(&frame, side, side)
}

/// The frame in the middle of a black one of this size, which is at least as large.
fn padded<'a>(frame: &Bytes<'_>, height: usize, width: usize) -> Result<Bytes<'a>> {
    let (top, left) = ((height - frame.height) / 2, (width - frame.width) / 2);
    let mut pixels = filled(PIXELS, product(PIXELS, &[height, width, CHANNELS])?, 0)?;
    for (row, from) in frame.pixels.chunks_exact(frame.width * CHANNELS).enumerate() {
        let start = ((top + row) * width + left) * CHANNELS;
        pixels[start..start + from.len()].copy_from_slice(from);
    }
    Ok(Bytes::new(pixels, height, width))
}

/// The frame before it is fitted to patches.
///
/// # Errors
/// [`Error::Input`] for a frame that becomes too large; [`Error::Memory`].
fn prepared<'a>(sizes: &Flexible, isa: Isa, name: &str, frame: Bytes<'a>) -> Result<Bytes<'a>> {
    let frame = match sizes.letter_box {
        true => letter_box(name, frame)?,
        false => frame,
    };
    match sizes.geometry {
        Geometry::Untouched => Ok(frame),
        Geometry::Area { edge, fraction } => by_area(isa, name, &frame, edge, fraction),
        Geometry::Linear { target, crop } => by_linear(isa, &frame, target, crop),
        Geometry::Cubic {
            edge,
            fraction,
            target,
        } => by_cubic(isa, &frame, edge, fraction, target),
    }
}

/// OpenCV's INTER_AREA, a crop, and again.
fn by_area<'a>(isa: Isa, name: &str, frame: &Bytes<'_>, edge: usize, fraction: f64) -> Result<Bytes<'a>> {
    let (height, width) = edge_sizes(edge, frame.height, frame.width);
    check_area(name, frame, height, width)?;
    let resize = |image: Image<'_>| -> Result<Bytes<'a>> {
        let (height, width) = edge_sizes(edge, image.height(), image.width());
        let pixels = kernel(resize_area(isa, image, height, width))?;
        Ok(Bytes::new(pixels, height, width))
    };
    let frame = resize(frame.image())?;
    check_interrupted()?;
    let part = |side: usize| ((side as f64 * fraction) as usize).max(1);
    resize(crop_floor(frame.image(), part(frame.height), part(frame.width)))
}

/// torchvision's bilinear of bytes, its centre crop, and again.
fn by_linear<'a>(isa: Isa, frame: &Bytes<'_>, target: [usize; 2], crop: [usize; 2]) -> Result<Bytes<'a>> {
    let [height, width] = target;
    let linear = |image: Image<'_>| -> Result<Bytes<'a>> {
        let pixels = kernel(resize_linear_u8(isa, image, height, width))?;
        Ok(Bytes::new(pixels, height, width))
    };
    let resized = linear(frame.image())?;
    check_interrupted()?;
    // What a crop lacks is black.
    let padded = match crop[0] > height || crop[1] > width {
        true => padded(&resized, crop[0].max(height), crop[1].max(width))?,
        false => resized,
    };
    let start = |side: usize, part: usize| ((side - part) as f64 / 2.0).round_ties_even() as usize;
    linear(padded.image().crop(
        start(padded.height, crop[0]),
        start(padded.width, crop[1]),
        crop[0],
        crop[1],
    ))
}

/// torchvision's bicubic of bytes to a square, a crop, and bicubic again.
fn by_cubic<'a>(
    isa: Isa,
    frame: &Bytes<'_>,
    edge: usize,
    fraction: f64,
    target: [usize; 2],
) -> Result<Bytes<'a>> {
    let cubic = |image: Image<'_>, height: usize, width: usize| -> Result<Bytes<'a>> {
        let pixels = kernel(resize_cubic_u8(isa, image, height, width, WeightRounding::Torch))?;
        Ok(Bytes::new(pixels, height, width))
    };
    let square = cubic(frame.image(), edge, edge)?;
    check_interrupted()?;
    let part = ((edge as f64 * fraction).round_ties_even() as usize).max(1);
    cubic(crop_floor(square.image(), part, part), target[0], target[1])
}

/// The sizes at which the shorter side is `edge`.
fn edge_sizes(edge: usize, height: usize, width: usize) -> (usize, usize) {
    let scale = edge as f64 / height.min(width) as f64;
    let side = |side: usize| ((side as f64 * scale).round_ties_even() as usize).max(1);
    (side(height), side(width))
}

/// The height and width of a view, whole tokens: the multiples nearest to the frame's sides, between the
/// least and the greatest area.
fn fitting(sizes: &Flexible, height: usize, width: usize) -> (usize, usize) {
    let (least, most) = (sizes.min_pixels as f64, sizes.max_pixels as f64);
    let factor = (sizes.rules.patch_size * sizes.rules.merge) as f64;
    let (height, width) = (height as f64, width as f64);
    let nearest = |side: f64| {
        let side = (side / factor).round_ties_even() * factor;
        match sizes.rules.fitting {
            Fitting::OfMultiples { max_side } => side.max(factor).min(max_side),
            Fitting::OfFrame => side,
        }
    };
    let mut fitting = (nearest(height), nearest(width));
    let area = fitting.0 * fitting.1;
    if area > most {
        let from = match sizes.rules.fitting {
            Fitting::OfMultiples { .. } => fitting,
            Fitting::OfFrame => (height, width),
        };
        let shrink = (from.0 * from.1 / most).sqrt();
        let side = |side: f64| ((side / shrink / factor).floor() * factor).max(factor);
        fitting = (side(from.0), side(from.1));
    } else if area < least {
        let grow = (least / (height * width)).sqrt();
        let side = |side: f64| (side * grow / factor).ceil() * factor;
        fitting = (side(height), side(width));
    }
    (fitting.0 as usize, fitting.1 as usize)
}

/// Patches, block by block of `merge x merge`; each by channel, time, row and column, the frame standing
/// `frames` times along time.
fn patches(
    rules: &release::Flexible,
    frames: usize,
    pixels: &[u8],
    height: usize,
    width: usize,
) -> Result<OwnedArray> {
    let table = normalized();
    let (side, merge) = (rules.patch_size, rules.merge);
    let (rows, columns) = (height / side, width / side);
    let plane = side * side;
    let values = CHANNELS * frames * plane;
    let mut out = filled(PIXELS, product(PIXELS, &[rows, columns, values])?, 0.0)?;
    for (patch, out) in out.chunks_exact_mut(values).enumerate() {
        let (block, within) = (patch / (merge * merge), patch % (merge * merge));
        let (block_row, block_column) = (block / (columns / merge), block % (columns / merge));
        let top = (block_row * merge + within / merge) * side;
        let left = (block_column * merge + within % merge) * side;
        for (channel, planes) in out.chunks_exact_mut(frames * plane).enumerate() {
            let (first, others) = planes.split_at_mut(plane);
            for (y, out) in first.chunks_exact_mut(side).enumerate() {
                let line = &pixels[((top + y) * width + left) * CHANNELS..][..side * CHANNELS];
                for (x, out) in out.iter_mut().enumerate() {
                    *out = table[usize::from(line[x * CHANNELS + channel])];
                }
            }
            for other in others.chunks_exact_mut(plane) {
                other.copy_from_slice(first);
            }
        }
    }
    OwnedArray::new(out, &[rows * columns, values])
}
