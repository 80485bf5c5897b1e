//! Arrays with their shapes: borrowed, borrowed to be written, and owned. The checks that every argument
//! passes.

use saccade_vla_kernels::Rows;

use crate::error::{Error, Result, bail, ensure, problem, show_shape};

/// A C-contiguous array: what the public functions take.
///
/// ```
/// let data = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
/// let array = saccade_vla::Array::new(&data, &[2, 3])?;
/// assert_eq!(array.shape(), [2, 3]);
/// assert!(saccade_vla::Array::new(&data, &[4]).is_err());
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Array<'a, T = f32> {
    data: &'a [T],
    shape: &'a [usize],
    /// Whether the elements were found to be finite, and need not be looked at again.
    is_finite: bool,
}

impl<'a, T> Array<'a, T> {
    /// A view of `data` with `shape`, last axis fastest. The shape `[]` is a scalar.
    ///
    /// # Errors
    /// [`Error::Shape`] if the sizes in `shape` do not multiply to the length of `data`.
    pub fn new(data: &'a [T], shape: &'a [usize]) -> Result<Self> {
        check_length("shape", data.len(), shape)?;
        Ok(Self {
            data,
            shape,
            is_finite: false,
        })
    }

    /// The elements, last axis fastest.
    #[must_use]
    pub fn data(&self) -> &'a [T] {
        self.data
    }

    /// The size of each axis.
    #[must_use]
    pub fn shape(&self) -> &'a [usize] {
        self.shape
    }

    /// Checks that the array has exactly this shape; `axes` names its axes.
    pub(crate) fn check_shape(self, name: &str, axes: &str, expected: &[usize]) -> Result<Self> {
        check_shape(name, axes, self.shape, expected).map(|()| self)
    }
}

impl<'a> Array<'a> {
    /// A view of `data`, made with this `shape`, that was found to be finite.
    pub(crate) fn finite(data: &'a [f32], shape: &'a [usize]) -> Self {
        debug_assert_eq!(data.len(), shape.iter().product::<usize>());
        Self {
            data,
            shape,
            is_finite: true,
        }
    }

    /// Checks that no element is NaN or infinite.
    pub(crate) fn check_finite(self, name: &str) -> Result<Self> {
        if self.is_finite {
            return Ok(self);
        }
        match first_not_finite(self.data) {
            None => Ok(self),
            Some(position) => Err(Error::Input(problem!(
                name; expected "finite values";
                got "{} at index {}", self.data[position], show_shape(&unravel(position, self.shape))
            ))),
        }
    }

    /// Checks that no element of a result is NaN or infinite.
    pub(crate) fn check_result(self, name: &str) -> Result<Self> {
        match first_not_finite(self.data) {
            None => Ok(self),
            Some(position) => Err(not_finite(name, self.data[position], position, self.shape)),
        }
    }
}

/// A C-contiguous array that a function writes its result to.
///
/// ```
/// let mut data = [0.0; 6];
/// let out = saccade_vla::ArrayMut::new(&mut data, &[2, 3])?;
/// assert_eq!(out.shape(), [2, 3]);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Debug)]
pub struct ArrayMut<'a, T = f32> {
    data: &'a mut [T],
    shape: &'a [usize],
}

impl<'a, T> ArrayMut<'a, T> {
    /// A view of `data` with `shape`, last axis fastest. The shape `[]` is a scalar.
    ///
    /// # Errors
    /// [`Error::Shape`] if the sizes in `shape` do not multiply to the length of `data`.
    pub fn new(data: &'a mut [T], shape: &'a [usize]) -> Result<Self> {
        check_length("shape", data.len(), shape)?;
        Ok(Self { data, shape })
    }

    /// The elements, last axis fastest.
    #[must_use]
    pub fn data(&self) -> &[T] {
        self.data
    }

    /// The elements, to be written.
    #[must_use]
    pub fn data_mut(&mut self) -> &mut [T] {
        self.data
    }

    /// The size of each axis.
    #[must_use]
    pub fn shape(&self) -> &'a [usize] {
        self.shape
    }

    /// Checks that the array has exactly this shape; `axes` names its axes. Hands over the elements.
    pub(crate) fn check_shape(self, name: &str, axes: &str, expected: &[usize]) -> Result<&'a mut [T]> {
        check_shape(name, axes, self.shape, expected).map(|()| self.data)
    }
}

/// An array that owns its elements.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnedArray<T = f32> {
    data: Vec<T>,
    shape: Vec<usize>,
}

impl<T> OwnedArray<T> {
    /// `data` with `shape`, last axis fastest.
    ///
    /// # Errors
    /// [`Error::Shape`] if the sizes in `shape` do not multiply to the length of `data`.
    pub fn new(data: Vec<T>, shape: &[usize]) -> Result<Self> {
        check_length("shape", data.len(), shape)?;
        Ok(Self {
            data,
            shape: shape.to_vec(),
        })
    }

    /// The elements, last axis fastest.
    #[must_use]
    pub fn data(&self) -> &[T] {
        &self.data
    }

    /// The elements, to be written.
    #[must_use]
    pub fn data_mut(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// The size of each axis.
    #[must_use]
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The array, borrowed.
    #[must_use]
    pub fn view(&self) -> Array<'_, T> {
        Array {
            data: &self.data,
            shape: &self.shape,
            is_finite: false,
        }
    }

    /// The elements and the size of each axis.
    #[must_use]
    pub fn into_parts(self) -> (Vec<T>, Vec<usize>) {
        (self.data, self.shape)
    }
}

impl OwnedArray {
    /// The elements as rows of the last axis.
    pub(crate) fn rows(&self) -> Rows<'_> {
        Rows::new(&self.data, self.shape.last().copied().unwrap_or(1))
    }
}

/// Checks that the sizes in `shape` multiply to `len`.
pub(crate) fn check_length(name: &str, len: usize, shape: &[usize]) -> Result<()> {
    match product(shape) {
        Some(elements) if elements == len => Ok(()),
        _ => bail!(Shape, name; "{} does not fit {len} elements", show_shape(shape)),
    }
}

/// The product of sizes; none if it is beyond what can be addressed.
pub(crate) fn product(sizes: &[usize]) -> Option<usize> {
    let mut sizes = sizes.iter();
    sizes.try_fold(1_usize, |product, &size| product.checked_mul(size))
}

fn check_shape(name: &str, axes: &str, given: &[usize], expected: &[usize]) -> Result<()> {
    ensure!(
        given == expected, Shape, name;
        expected "{axes} = {}", show_shape(expected); got "{}", show_shape(given)
    );
    Ok(())
}

/// The error for an element of a result of this shape that is not finite.
pub(crate) fn not_finite(name: &str, value: f32, position: usize, shape: &[usize]) -> Error {
    Error::Input(problem!(
        name; "the result is not finite, {value} at index {}: inputs or weights are too large for the arithmetic",
        show_shape(&unravel(position, shape))
    ))
}

/// The position of the first NaN or infinity.
pub(crate) fn first_not_finite(data: &[f32]) -> Option<usize> {
    const EXPONENT: u32 = 0x7f80_0000;
    first_where(data, |value| value.to_bits() & EXPONENT == EXPONENT)
}

/// The first value that is no bias of logits, which are below infinity; minus infinity takes a key away.
pub(crate) fn first_not_bias(values: &[f32]) -> Option<f32> {
    let is_bad = |value: &f32| value.is_nan() || *value == f32::INFINITY;
    values.iter().copied().find(is_bad)
}

/// Elements that are looked at together: a loop without exits is one that compilers turn into vector code.
const TOGETHER: usize = 1024;

/// The position of the first element that `is_bad`.
pub(crate) fn first_where<T>(data: &[T], is_bad: impl Fn(&T) -> bool) -> Option<usize> {
    let chunk = data
        .chunks(TOGETHER)
        .position(|chunk| chunk.iter().fold(false, |bad, value| bad | is_bad(value)))?;
    let within = data[chunk * TOGETHER..].iter().position(is_bad)?;
    Some(chunk * TOGETHER + within)
}

/// The index on every axis of the element at `position`.
pub(crate) fn unravel(mut position: usize, shape: &[usize]) -> Vec<usize> {
    let mut index: Vec<usize> = shape
        .iter()
        .rev()
        .map(|&size| {
            let on_axis = position % size;
            position /= size;
            on_axis
        })
        .collect();
    index.reverse();
    index
}
