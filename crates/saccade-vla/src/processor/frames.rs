//! Frames to `pixel_values`: crops, sizes and order of each version's processor.

use std::borrow::Cow;

use saccade_vla_kernels::Image;

use super::settings::Settings;
use crate::alloc::{collected, filled};
use crate::array::{Array, OwnedArray, first_not_finite};
use crate::error::{Error, Result, ensure, problem, show_shape};
use crate::ops::refused;
use crate::release::Preprocessing;

pub(super) const CHANNELS: usize = 3;

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
pub(super) const PIXELS: &str = "frames";

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

    pub(super) fn image(&self) -> Image<'_> {
        Image::new(&self.pixels, self.height, self.width)
    }
}

pub(super) fn kernel<T>(result: std::result::Result<T, saccade_vla_kernels::AllocError>) -> Result<T> {
    result.map_err(refused(PIXELS))
}

/// The bytes of a frame.
pub(super) fn read<'a>(settings: &Settings, name: &str, frame: Frame<'a>) -> Result<Bytes<'a>> {
    let takes_lerobot = settings.preprocessing == Preprocessing::Lerobot;
    let shape = match frame {
        Frame::U8(array) => array.shape(),
        Frame::F32(array) => array.shape(),
        Frame::F64(array) => array.shape(),
    };
    ensure!(
        takes_lerobot || matches!(frame, Frame::U8(_)), Input, name;
        "expected bytes (uint8): floating point frames are lerobot's"
    );
    let expected = match takes_lerobot {
        true => "(height, width, 3) or (3, height, width)",
        false => "(height, width, 3)",
    };
    let wrong = || {
        Err(Error::Shape(problem!(
            name; expected "an RGB frame {expected} of at least one pixel"; got "{}", show_shape(shape)
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
        Some(position) => Err(Error::Input(problem!(
            name; expected "finite values"; got "one that is not at position {position}"
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
pub(super) fn normalized() -> [f32; 256] {
    std::array::from_fn(|byte| (byte as f32 - 127.5) / 127.5)
}

/// Pixels as normalised planes of this shape.
pub(super) fn planes(pixels: &[u8], shape: &[usize]) -> Result<OwnedArray> {
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
pub(super) fn crop_half_to_even(image: Image<'_>, fraction: f64) -> Image<'_> {
    let part = |side: usize| ((fraction * side as f64) as usize).max(1);
    let start = |side: usize| ((side - part(side)) as f64 / 2.0).round_ties_even() as usize;
    let (height, width) = (image.height(), image.width());
    image.crop(start(height), start(width), part(height), part(width))
}
