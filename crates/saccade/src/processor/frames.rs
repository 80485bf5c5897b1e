//! Frames to `pixel_values`: crops, sizes and order of each version's processor.

use std::borrow::Cow;

use saccade_kernels::{CubicRule, Image, Isa, resize_area, resize_cubic_u8, resize_linear_f32};

use super::settings::{Flexible, MAX_AREA, Preprocessing, Settings, Sizes};
use crate::alloc::{collected, filled, product};
use crate::array::{Array, OwnedArray, first_not_finite};
use crate::config::Version;
use crate::error::{Error, Result, show_shape};
use crate::ops::{check_interrupted, refused};

const CHANNELS: usize = 3;

/// A camera image: `(height, width, 3)`, or for lerobot also `(3, height, width)`.
#[derive(Clone, Copy, Debug)]
pub enum Frame<'a> {
    /// Bytes.
    U8(Array<'a, u8>),
    /// Numbers from 0 to 1, which lerobot's path takes; beyond that they are clamped.
    F32(Array<'a, f32>),
    /// The same in double.
    F64(Array<'a, f64>),
}

/// One view as the vision tower takes it.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// N1.5: `(3, height, width)`. N1.6: `(1, 3, height, width)`. N1.7: `(patches, 1536)`.
    pub pixels: OwnedArray,
    /// Image tokens in the prompt.
    pub tokens: usize,
    /// N1.7: the grid of patches: time, height, width.
    pub grid: Option<[i64; 3]>,
}

/// What errors call memory for pixels.
const PIXELS: &str = "frames";

/// A frame longer than this on one side, by this factor, is refused by the released processors of N1.6 and N1.7.
const MAX_RATIO: usize = 200;

/// The longest side of N1.6's views.
const N16_MAX_SIDE: f64 = 7000.0;

const N16_FACTOR: usize = 28;
const N17_PATCH: usize = 16;
const N17_MERGE: usize = 2;
const N17_TIME: usize = 2;

/// Bytes with their size: the caller's, or new ones.
pub(super) struct Bytes<'a> {
    pub pixels: Cow<'a, [u8]>,
    pub height: usize,
    pub width: usize,
}

impl Bytes<'_> {
    pub(super) fn new(pixels: Vec<u8>, height: usize, width: usize) -> Self {
        Self {
            pixels: pixels.into(),
            height,
            width,
        }
    }

    fn image(&self) -> Image<'_> {
        Image::new(&self.pixels, self.height, self.width)
    }
}

/// The view that a frame becomes, which errors call `name`.
///
/// # Errors
/// [`Error::Shape`] and [`Error::Input`] for a frame that is none; [`Error::Memory`].
pub(super) fn view(settings: &Settings, isa: Isa, name: &str, frame: Frame<'_>) -> Result<View> {
    let bytes = read(settings, name, frame)?;
    match &settings.sizes {
        Sizes::Square { size, tokens, crop } => {
            let pixels = match settings.preprocessing {
                Preprocessing::Lerobot => kernel(resize_cubic_u8(
                    isa,
                    bytes.image(),
                    *size,
                    *size,
                    CubicRule::Torch,
                ))?,
                Preprocessing::Isaac => {
                    let centre = crop_half_to_even(bytes.image(), *crop);
                    let resized = kernel(resize_linear_f32(isa, centre, *size, *size))?;
                    kernel(resized.truncated())?
                }
            };
            check_interrupted()?;
            Ok(View {
                pixels: planes(&pixels, &[CHANNELS, *size, *size])?,
                tokens: *tokens,
                grid: None,
            })
        }
        Sizes::Flexible(sizes) => flexible_view(settings, sizes, isa, name, bytes),
    }
}

fn kernel<T>(result: std::result::Result<T, saccade_kernels::AllocError>) -> Result<T> {
    result.map_err(refused(PIXELS))
}

/// The bytes of a frame.
fn read<'a>(settings: &Settings, name: &str, frame: Frame<'a>) -> Result<Bytes<'a>> {
    let takes_lerobot = settings.preprocessing == Preprocessing::Lerobot;
    let shape = match frame {
        Frame::U8(array) => array.shape(),
        Frame::F32(array) => array.shape(),
        Frame::F64(array) => array.shape(),
    };
    if !takes_lerobot && !matches!(frame, Frame::U8(_)) {
        return Err(Error::Input(format!(
            "{name}: expected bytes (uint8): floating point frames are lerobot's"
        )));
    }
    let expected = match takes_lerobot {
        true => "(height, width, 3) or (3, height, width)",
        false => "(height, width, 3)",
    };
    let wrong = || {
        Err(Error::Shape(format!(
            "{name}: expected an RGB frame {expected} of at least one pixel, got {}",
            show_shape(shape)
        )))
    };
    let (height, width, is_planar) = match *shape {
        [height, width, CHANNELS] => (height, width, false),
        [CHANNELS, height, width] if takes_lerobot => (height, width, true),
        _ => return wrong(),
    };
    if height == 0 || width == 0 {
        return wrong();
    }
    let pixels: Cow<'_, [u8]> = match frame {
        Frame::U8(array) => array.data().into(),
        Frame::F32(array) => {
            check_finite(name, first_not_finite(array.data()))?;
            let byte = |value: &f32| (value.clamp(0.0, 1.0) * 255.0) as u8;
            collected(PIXELS, array.data().len(), array.data().iter().map(byte))?.into()
        }
        Frame::F64(array) => {
            check_finite(name, array.data().iter().position(|value| !value.is_finite()))?;
            let byte = |value: &f64| (value.clamp(0.0, 1.0) * 255.0) as u8;
            collected(PIXELS, array.data().len(), array.data().iter().map(byte))?.into()
        }
    };
    let pixels = match is_planar {
        false => pixels,
        true => interleaved(&pixels, height * width)?.into(),
    };
    Ok(Bytes {
        pixels,
        height,
        width,
    })
}

fn check_finite(name: &str, bad: Option<usize>) -> Result<()> {
    match bad {
        None => Ok(()),
        Some(position) => Err(Error::Input(format!(
            "{name}: expected finite values, got one that is not at position {position}"
        ))),
    }
}

/// Three planes as pixels.
fn interleaved(planes: &[u8], len: usize) -> Result<Vec<u8>> {
    let mut pixels = filled(PIXELS, planes.len(), 0)?;
    for channel in 0..CHANNELS {
        for index in 0..len {
            pixels[index * CHANNELS + channel] = planes[channel * len + index];
        }
    }
    Ok(pixels)
}

/// `(byte - 127.5) / 127.5` for every byte.
fn normalized() -> [f32; 256] {
    std::array::from_fn(|byte| (byte as f32 - 127.5) / 127.5)
}

/// Pixels as normalised planes of this shape.
fn planes(pixels: &[u8], shape: &[usize]) -> Result<OwnedArray> {
    let table = normalized();
    let len = pixels.len() / CHANNELS;
    let mut values = filled(PIXELS, pixels.len(), 0.0)?;
    for (channel, plane) in values.chunks_exact_mut(len).enumerate() {
        for index in 0..len {
            plane[index] = table[usize::from(pixels[index * CHANNELS + channel])];
        }
    }
    OwnedArray::new(values, shape)
}

/// The centre of `fraction` of each side. Where it begins is rounded half to even.
fn crop_half_to_even(image: Image<'_>, fraction: f64) -> Image<'_> {
    let part = |side: usize| ((fraction * side as f64) as usize).max(1);
    let start = |side: usize| ((side - part(side)) as f64 / 2.0).round_ties_even() as usize;
    let (height, width) = (image.height(), image.width());
    image.crop(start(height), start(width), part(height), part(width))
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

/// N1.6 and N1.7.
fn flexible_view(settings: &Settings, sizes: &Flexible, isa: Isa, name: &str, frame: Bytes) -> Result<View> {
    let frame = match sizes.letter_box {
        true => letter_box(name, frame)?,
        false => frame,
    };
    let frame = match sizes.use_albumentations {
        true => by_area(settings, sizes, isa, name, frame)?,
        false => by_cubic(settings, sizes, isa, frame)?,
    };
    check_ratio(name, frame.height, frame.width)?;
    check_interrupted()?;
    let (factor, rule) = match settings.version {
        Version::N17 => (N17_PATCH * N17_MERGE, CubicRule::Torch),
        _ => (N16_FACTOR, CubicRule::Pillow),
    };
    let (height, width) = fitting(settings.version, sizes, factor, frame.height, frame.width);
    let pixels = kernel(resize_cubic_u8(isa, frame.image(), height, width, rule))?;
    let tokens = height * width / (factor * factor);
    if settings.version == Version::N17 {
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
        return Err(Error::Input(format!(
            "{name}: expected sides that differ by a factor of at most {MAX_RATIO}, got {height} x {width}"
        )));
    }
    Ok(())
}

/// That a frame on its way to a view does not become larger than any view.
fn check_area(name: &str, frame: &Bytes<'_>, height: usize, width: usize) -> Result<()> {
    let most = MAX_AREA.max(frame.height * frame.width);
    match height.checked_mul(width) {
        Some(area) if area <= most => Ok(()),
        _ => Err(Error::Input(format!(
            "{name}: expected a frame that is less elongated than {} x {}, which becomes {height} x {width}",
            frame.height, frame.width
        ))),
    }
}

/// Black bars make it a square.
fn letter_box<'a>(name: &str, frame: Bytes<'a>) -> Result<Bytes<'a>> {
    let side = frame.height.max(frame.width);
    if frame.height == frame.width {
        return Ok(frame);
    }
    check_area(name, &frame, side, side)?;
    let (top, left) = ((side - frame.height) / 2, (side - frame.width) / 2);
    let mut pixels = filled(PIXELS, product(PIXELS, &[side, side, CHANNELS])?, 0)?;
    for (row, from) in frame.pixels.chunks_exact(frame.width * CHANNELS).enumerate() {
        let start = ((top + row) * side + left) * CHANNELS;
        pixels[start..start + from.len()].copy_from_slice(from);
    }
    Ok(Bytes::new(pixels, side, side))
}

/// The path of checkpoints that say `use_albumentations`: OpenCV's INTER_AREA, a crop, and again.
pub(super) fn by_area<'a>(
    settings: &Settings,
    sizes: &Flexible,
    isa: Isa,
    name: &str,
    frame: Bytes<'a>,
) -> Result<Bytes<'a>> {
    let is_lerobot = settings.preprocessing == Preprocessing::Lerobot;
    // lerobot leaves frames alone where there is no target.
    if sizes.target_size.is_none() && (is_lerobot || sizes.shortest_edge.is_none()) {
        return Ok(frame);
    }
    let resized = |height: usize, width: usize| match (sizes.shortest_edge, sizes.target_size) {
        (Some(edge), _) => edge_sizes(edge, height, width),
        (None, Some([edge, _])) if is_lerobot => edge_sizes(edge, height, width),
        (None, Some([height, width])) => (height, width),
        (None, None) => (height, width),
    };
    let (height, width) = resized(frame.height, frame.width);
    check_area(name, &frame, height, width)?;
    let resize = |image: Image<'_>| -> Result<Bytes<'a>> {
        let (height, width) = resized(image.height(), image.width());
        let pixels = kernel(resize_area(isa, image, height, width))?;
        Ok(Bytes::new(pixels, height, width))
    };
    let frame = resize(frame.image())?;
    check_interrupted()?;
    match crop_fraction(sizes) {
        None => resize(frame.image()),
        Some(fraction) => {
            let part = |side: usize| ((side as f64 * fraction) as usize).max(1);
            resize(crop_floor(frame.image(), part(frame.height), part(frame.width)))
        }
    }
}

/// The path without albumentations: cubic to a square, a crop, and again.
fn by_cubic<'a>(settings: &Settings, sizes: &Flexible, isa: Isa, frame: Bytes<'a>) -> Result<Bytes<'a>> {
    if settings.preprocessing == Preprocessing::Isaac {
        return Err(Error::Input(
            "options: use_albumentations: expected true: Isaac-GR00T's other path is not supported"
                .to_owned(),
        ));
    }
    let Some([height, width]) = sizes.target_size else {
        return Ok(frame);
    };
    let edge = sizes.shortest_edge.unwrap_or(height);
    let cubic = |image: Image<'_>, height: usize, width: usize| -> Result<Bytes<'a>> {
        let pixels = kernel(resize_cubic_u8(isa, image, height, width, CubicRule::Torch))?;
        Ok(Bytes::new(pixels, height, width))
    };
    let square = cubic(frame.image(), edge, edge)?;
    let part = match crop_fraction(sizes) {
        None => edge,
        Some(fraction) => ((edge as f64 * fraction).round_ties_even() as usize).max(1),
    };
    cubic(crop_floor(square.image(), part, part), height, width)
}

/// The part of the frame that is kept, if not all of it.
fn crop_fraction(sizes: &Flexible) -> Option<f64> {
    let of_sizes = || Some(sizes.crop_size?[0] as f64 / sizes.target_size?[0] as f64);
    let fraction = sizes.crop_fraction.or_else(of_sizes)?;
    (fraction < 1.0).then_some(fraction)
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
