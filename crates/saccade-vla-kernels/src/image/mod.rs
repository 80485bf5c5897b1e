//! Resampling of RGB images, bit for bit as torch, Pillow and OpenCV do it.
//!
//! A size that is not the original's is reached in two passes, along the width and then along the height. Both run the same loop over rows:
//! the pass along the width turns blocks of [`BLOCK`] rows on their side first. All instruction sets give the same bits.
//!
//! The loops are plain, over indices: a compiler makes vectors of them for every instruction set, and chains of iterators are not always inlined.

#![allow(
    clippy::needless_range_loop,
    reason = "see above: several slices share an index"
)]

mod resize_area;
mod resize_f32;
mod resize_u8;
mod taps;

pub use resize_area::resize_area;
pub use resize_f32::{FloatImage, resize_linear_f32};
pub use resize_u8::{WeightRounding, resize_cubic_u8, resize_linear_u8};

use crate::aligned::AllocError;
use crate::isa::Isa;
use crate::simd::{Kernel, Simd};

/// Values of a pixel.
pub(crate) const CHANNELS: usize = 3;

/// Rows that the pass along the width takes together.
const BLOCK: usize = 16;

/// An RGB image, or a part of one: rows of `3 * width` bytes that are `stride` bytes apart.
#[derive(Clone, Copy, Debug)]
pub struct Image<'a> {
    pixels: &'a [u8],
    height: usize,
    width: usize,
    stride: usize,
}

impl<'a> Image<'a> {
    /// An image `(height, width, 3)`, last axis fastest.
    ///
    /// # Panics
    /// If `pixels` has another length, or if the image has no pixel.
    #[must_use]
    pub fn new(pixels: &'a [u8], height: usize, width: usize) -> Self {
        let stride = width.checked_mul(CHANNELS);
        let len = stride.and_then(|stride| stride.checked_mul(height));
        assert!(len == Some(pixels.len()) && !pixels.is_empty());
        Self {
            pixels,
            height,
            width,
            stride: width * CHANNELS,
        }
    }

    /// The part of `height` rows and `width` columns that begins at (`top`, `left`).
    ///
    /// ```
    /// let image = saccade_vla_kernels::Image::new(&[1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4], 2, 2);
    /// let part = image.crop(1, 0, 1, 2);
    /// assert_eq!(part.to_vec().unwrap(), [3, 3, 3, 4, 4, 4]);
    /// ```
    ///
    /// # Panics
    /// If that is empty or not inside the image.
    #[must_use]
    pub fn crop(self, top: usize, left: usize, height: usize, width: usize) -> Self {
        let is_inside =
            |start: usize, size: usize, all: usize| size > 0 && start <= all && size <= all - start;
        assert!(is_inside(top, height, self.height) && is_inside(left, width, self.width));
        Self {
            pixels: &self.pixels[top * self.stride + left * CHANNELS..],
            height,
            width,
            ..self
        }
    }

    /// Number of rows.
    #[must_use]
    pub fn height(self) -> usize {
        self.height
    }

    /// Number of columns.
    #[must_use]
    pub fn width(self) -> usize {
        self.width
    }

    /// The pixels of a row.
    ///
    /// # Panics
    /// If there is no such row.
    #[must_use]
    pub fn row(self, row: usize) -> &'a [u8] {
        assert!(row < self.height);
        let start = row * self.stride;
        &self.pixels[start..start + self.width * CHANNELS]
    }

    /// The pixels `(height, width, 3)`, copied.
    ///
    /// # Errors
    /// If the system refuses the memory.
    pub fn to_vec(self) -> Result<Vec<u8>, AllocError> {
        let mut pixels = reserved(area(self.height, self.width)?)?;
        for row in 0..self.height {
            pixels.extend_from_slice(self.row(row));
        }
        Ok(pixels)
    }
}

/// An empty vector with room for `len` elements.
fn reserved<T>(len: usize) -> Result<Vec<T>, AllocError> {
    let mut values = Vec::new();
    values.try_reserve_exact(len).map_err(|_| AllocError {
        bytes: len.saturating_mul(size_of::<T>()),
    })?;
    Ok(values)
}

/// `len` values that are still to be computed.
fn blank<T: Copy + Default>(len: usize) -> Result<Vec<T>, AllocError> {
    let mut values = reserved(len)?;
    values.resize(len, T::default());
    Ok(values)
}

/// `height * width * 3`, if memory can have as many bytes.
fn area(height: usize, width: usize) -> Result<usize, AllocError> {
    let all = height
        .checked_mul(width)
        .and_then(|all| all.checked_mul(CHANNELS));
    all.ok_or(AllocError { bytes: usize::MAX })
}

/// Elements of a row that are summed together: as many as fit into registers, and all of a block of the pass along the width.
const TOGETHER: usize = CHANNELS * BLOCK;

/// `out` as the sum of rows of `inner` elements times their weights: the products of the first `rounded` rows
/// are rounded, those of the others fused.
#[inline(always)]
fn sum_rows(rows: &[f32], weights: &[f32], rounded: usize, inner: usize, out: &mut [f32]) {
    let rows = &rows[..weights.len() * inner];
    for start in (0..inner).step_by(TOGETHER) {
        let len = TOGETHER.min(inner - start);
        let mut sums = [0.0; TOGETHER];
        for tap in 0..weights.len() {
            let weight = weights[tap];
            let row = padded(&rows[tap * inner + start..][..len]);
            if tap < rounded {
                // Zero plus the first product is that product.
                for index in 0..TOGETHER {
                    sums[index] += row[index] * weight;
                }
            } else {
                for index in 0..TOGETHER {
                    sums[index] = f32::mul_add(row[index], weight, sums[index]);
                }
            }
        }
        out[start..start + len].copy_from_slice(&sums[..len]);
    }
}

/// The elements of a row that are summed together, with zeros after the last one.
#[inline(always)]
fn padded(row: &[f32]) -> [f32; TOGETHER] {
    match row.try_into() {
        Ok(row) => row,
        Err(_) => {
            let mut padded = [0.0; TOGETHER];
            padded[..row.len()].copy_from_slice(row);
            padded
        }
    }
}

/// What becomes of one axis: each output is a sum over some neighbouring inputs.
trait Sums {
    /// What is summed.
    type Value: Copy + Default;

    /// Number of outputs.
    fn num_outputs(&self) -> usize;

    /// A byte of the image as it goes into a sum. `#[inline(always)]`, as [`sum`](Self::sum).
    fn value(byte: u8) -> Self::Value;

    /// Writes output `index` to the `inner` elements of `out`, from `inputs`, rows of `inner` elements. Every element is summed for itself.
    fn sum(&self, index: usize, inputs: &[Self::Value], inner: usize, out: &mut [Self::Value]);
}

/// The pass along the width: rows of `3 * num_outputs` values.
struct AlongWidth<'a, S: Sums> {
    sums: &'a S,
    image: Image<'a>,
    /// `width * 3 * BLOCK` and `num_outputs * 3 * BLOCK` values.
    turned: &'a mut [S::Value],
    summed: &'a mut [S::Value],
    out: &'a mut [S::Value],
}

impl<S: Sums> Kernel for AlongWidth<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<I: Simd>(&mut self, _: I) {
        let Self {
            sums,
            image,
            turned,
            summed,
            out,
        } = self;
        let inner = CHANNELS * BLOCK;
        let width = sums.num_outputs() * CHANNELS;
        for block in (0..image.height).step_by(BLOCK) {
            // Rows after the last one are the last one again.
            let rows: [&[u8]; BLOCK] =
                std::array::from_fn(|row| image.row((block + row).min(image.height - 1)));
            for index in 0..image.width * CHANNELS {
                for (row, from) in rows.iter().enumerate() {
                    turned[index * BLOCK + row] = S::value(from[index]);
                }
            }
            for index in 0..sums.num_outputs() {
                sums.sum(
                    index,
                    turned,
                    inner,
                    &mut summed[index * inner..(index + 1) * inner],
                );
            }
            for row in 0..BLOCK.min(image.height - block) {
                let out = &mut out[(block + row) * width..(block + row + 1) * width];
                for index in 0..width {
                    out[index] = summed[index * BLOCK + row];
                }
            }
        }
    }
}

/// The image summed along the width and then along the height, by `sums(from, to)`. A pass that would change no size is left out.
fn resized<S: Sums>(
    isa: Isa,
    image: Image<'_>,
    height: usize,
    width: usize,
    sums: impl Fn(usize, usize) -> Result<S, AllocError>,
) -> Result<Vec<S::Value>, AllocError> {
    let narrow = match image.width == width {
        true => unsummed::<S>(image)?,
        false => along_width(isa, &sums(image.width, width)?, image)?,
    };
    match image.height == height {
        true => Ok(narrow),
        false => along_height(isa, &sums(image.height, height)?, &narrow, width),
    }
}

/// The bytes of the image as they go into a sum.
fn unsummed<S: Sums>(image: Image<'_>) -> Result<Vec<S::Value>, AllocError> {
    let mut values = reserved(area(image.height, image.width)?)?;
    for row in 0..image.height {
        values.extend(image.row(row).iter().map(|&byte| S::value(byte)));
    }
    Ok(values)
}

/// The image with every row summed along the width: `height` rows of `3 * num_outputs` values.
fn along_width<S: Sums>(isa: Isa, sums: &S, image: Image<'_>) -> Result<Vec<S::Value>, AllocError> {
    let mut turned = blank(area(image.width, BLOCK)?)?;
    let mut summed = blank(area(sums.num_outputs(), BLOCK)?)?;
    let mut out = blank(area(image.height, sums.num_outputs())?)?;
    isa.run(&mut AlongWidth {
        sums,
        image,
        turned: &mut turned,
        summed: &mut summed,
        out: &mut out,
    });
    Ok(out)
}

/// The pass along the height.
struct AlongHeight<'a, S: Sums> {
    sums: &'a S,
    inputs: &'a [S::Value],
    inner: usize,
    out: &'a mut [S::Value],
}

impl<S: Sums> Kernel for AlongHeight<'_, S> {
    type Output = ();

    #[inline(always)]
    fn run<I: Simd>(&mut self, _: I) {
        let (sums, inner) = (self.sums, self.inner);
        for index in 0..sums.num_outputs() {
            sums.sum(
                index,
                self.inputs,
                inner,
                &mut self.out[index * inner..(index + 1) * inner],
            );
        }
    }
}

/// Rows of `3 * width` values summed along the height: `num_outputs` such rows.
fn along_height<S: Sums>(
    isa: Isa,
    sums: &S,
    inputs: &[S::Value],
    width: usize,
) -> Result<Vec<S::Value>, AllocError> {
    let mut out = blank(area(sums.num_outputs(), width)?)?;
    isa.run(&mut AlongHeight {
        sums,
        inputs,
        inner: width * CHANNELS,
        out: &mut out,
    });
    Ok(out)
}
