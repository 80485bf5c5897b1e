//! Frames of N1.6 and N1.7: black bars, crops and sizes, and N1.7's patches.

use saccade_vla_kernels::{Image, Isa, WeightRounding, resize_area, resize_cubic_u8, resize_linear_u8};

use super::frames::{Bytes, CHANNELS, PIXELS, View, kernel, normalized, planes};
use super::options::MAX_AREA;
use super::settings::{Flexible, Geometry};
use crate::alloc::{filled, product};
use crate::array::OwnedArray;
use crate::config::Version;
use crate::error::{Error, Result, problem};
use crate::ops::check_interrupted;

/// A frame longer than this on one side, by this factor, is refused by the released processors of N1.6 and N1.7.
const MAX_RATIO: usize = 200;

/// The longest side of N1.6's views.
const N16_MAX_SIDE: f64 = 7000.0;

const N16_FACTOR: usize = 28;
const N17_PATCH: usize = 16;
const N17_MERGE: usize = 2;
const N17_TIME: usize = 2;

/// The view of N1.6 or N1.7 that a frame becomes.
///
/// # Errors
/// [`Error::Input`] for a frame that is too elongated; [`Error::Memory`].
pub(super) fn flexible_view(
    version: Version,
    sizes: &Flexible,
    isa: Isa,
    name: &str,
    frame: Bytes<'_>,
) -> Result<View> {
    let frame = prepared(sizes, isa, name, frame)?;
    check_ratio(name, frame.height, frame.width)?;
    check_interrupted()?;
    let (factor, rule) = match version {
        Version::N17 => (N17_PATCH * N17_MERGE, WeightRounding::Torch),
        _ => (N16_FACTOR, WeightRounding::Pillow),
    };
    let (height, width) = fitting(version, sizes, factor, frame.height, frame.width);
    let pixels = kernel(resize_cubic_u8(isa, frame.image(), height, width, rule))?;
    let tokens = height * width / (factor * factor);
    if version == Version::N17 {
        return Ok(View {
            pixels: patches(&pixels, height, width)?,
            tokens,
            grid: Some([1, (height / N17_PATCH) as i64, (width / N17_PATCH) as i64]),
        });
    }
    Ok(View {
        pixels: planes(&pixels, &[1, CHANNELS, height, width])?,
        tokens,
        grid: None,
    })
}

fn check_ratio(name: &str, height: usize, width: usize) -> Result<()> {
    let (short, long) = (height.min(width), height.max(width));
    if long > short.saturating_mul(MAX_RATIO) {
        return Err(Error::Input(problem!(
            name; expected "sides that differ by a factor of at most {MAX_RATIO}"; got "{height} x {width}"
        )));
    }
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
pub(super) fn prepared<'a>(sizes: &Flexible, isa: Isa, name: &str, frame: Bytes<'a>) -> Result<Bytes<'a>> {
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

/// The multiples of `factor` nearest to a frame's sides, between the least and the greatest area.
pub(super) fn fitting(
    version: Version,
    sizes: &Flexible,
    factor: usize,
    height: usize,
    width: usize,
) -> (usize, usize) {
    let (least, most) = (sizes.min_pixels as f64, sizes.max_pixels as f64);
    let (height, width, factor) = (height as f64, width as f64, factor as f64);
    let is_n16 = version == Version::N16;
    let nearest = |side: f64| {
        let side = (side / factor).round_ties_even() * factor;
        match is_n16 {
            true => side.max(factor).min(N16_MAX_SIDE),
            false => side,
        }
    };
    let mut fitting = (nearest(height), nearest(width));
    let area = fitting.0 * fitting.1;
    if area > most {
        // N1.6 goes on from the multiples, N1.7 from the frame.
        let from = if is_n16 { fitting } else { (height, width) };
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

/// N1.7's patches: block by block of 2 x 2, each patch by channel, time, row and column, the frame standing twice along time.
fn patches(pixels: &[u8], height: usize, width: usize) -> Result<OwnedArray> {
    let table = normalized();
    let (rows, columns) = (height / N17_PATCH, width / N17_PATCH);
    let plane = N17_PATCH * N17_PATCH;
    let values = CHANNELS * N17_TIME * plane;
    let mut out = filled(PIXELS, product(PIXELS, &[rows, columns, values])?, 0.0)?;
    for (patch, out) in out.chunks_exact_mut(values).enumerate() {
        let (block, within) = (patch / (N17_MERGE * N17_MERGE), patch % (N17_MERGE * N17_MERGE));
        let (block_row, block_column) = (block / (columns / N17_MERGE), block % (columns / N17_MERGE));
        let top = (block_row * N17_MERGE + within / N17_MERGE) * N17_PATCH;
        let left = (block_column * N17_MERGE + within % N17_MERGE) * N17_PATCH;
        for (channel, planes) in out.chunks_exact_mut(N17_TIME * plane).enumerate() {
            let (first, second) = planes.split_at_mut(plane);
            for (y, out) in first.chunks_exact_mut(N17_PATCH).enumerate() {
                let line = &pixels[((top + y) * width + left) * CHANNELS..][..N17_PATCH * CHANNELS];
                for (x, out) in out.iter_mut().enumerate() {
                    *out = table[usize::from(line[x * CHANNELS + channel])];
                }
            }
            second.copy_from_slice(first);
        }
    }
    OwnedArray::new(out, &[rows * columns, values])
}
