//! Arrays with their shapes: borrowed, borrowed to be written, and owned. The checks that every argument
//! passes.

use saccade_vla_kernels::Rows;

use crate::error::{Error, Result, problem, show_shape};

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
        check_length(data.len(), shape)?;
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
            Some(position) => Err(Error::Input(problem!(
                name;
                "the result is not finite, {} at index {}: inputs or weights are too large for the arithmetic",
                self.data[position], show_shape(&unravel(position, self.shape))
            ))),
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
        check_length(data.len(), shape)?;
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
        check_length(data.len(), shape)?;
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

fn check_length(len: usize, shape: &[usize]) -> Result<()> {
    let elements = shape
        .iter()
        .try_fold(1_usize, |elements, &size| elements.checked_mul(size));
    if elements == Some(len) {
        return Ok(());
    }
    Err(Error::Shape(problem!(
        "shape"; "{} does not fit {len} elements", show_shape(shape)
    )))
}

fn check_shape(name: &str, axes: &str, given: &[usize], expected: &[usize]) -> Result<()> {
    if given == expected {
        return Ok(());
    }
    Err(Error::Shape(problem!(
        name; expected "{axes} = {}", show_shape(expected); got "{}", show_shape(given)
    )))
}

/// The position of the first NaN or infinity.
pub(crate) fn first_not_finite(data: &[f32]) -> Option<usize> {
    const EXPONENT: u32 = 0x7f80_0000;
    first_where(data, |value| value.to_bits() & EXPONENT == EXPONENT)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_index_of_the_bad_element_is_named() {
        let mut data = [0.0; 6];
        data[4] = f32::NAN;
        let array = Array::new(&data, &[2, 3]).unwrap();
        assert_eq!(
            array.check_finite("state").unwrap_err().to_string(),
            "state: expected finite values, got NaN at index (1, 1)"
        );
        let result = array.check_result("actions").unwrap_err().to_string();
        assert!(
            result.starts_with("actions: the result is not finite, NaN at index (1, 1)"),
            "{result}"
        );
    }

    #[test]
    fn every_kind_of_bad_element_is_found_wherever_it_is() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN] {
            for position in [0, 1, TOGETHER - 1, TOGETHER, 2 * TOGETHER + 5] {
                let mut data = vec![f32::MAX; 2 * TOGETHER + 6];
                assert_eq!(first_not_finite(&data), None);
                data[position] = bad;
                assert_eq!(first_not_finite(&data), Some(position));
            }
        }
        assert_eq!(first_not_finite(&[]), None);
    }

    #[test]
    fn both_shapes_are_named() {
        let array = Array::new(&[0.0; 6], &[2, 3]).unwrap();
        let error = array
            .check_shape("state", "(batch, state_dim)", &[2, 4])
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            "state: expected (batch, state_dim) = (2, 4), got (2, 3)"
        );
    }

    #[test]
    fn a_shape_that_does_not_fit_is_an_error() {
        let mut data = [0.0; 6];
        for shape in [&[2, 2][..], &[], &[usize::MAX, 2], &[7]] {
            let messages = [
                Array::new(&data, shape).unwrap_err().to_string(),
                OwnedArray::new(data.to_vec(), shape).unwrap_err().to_string(),
                ArrayMut::new(&mut data, shape).unwrap_err().to_string(),
            ];
            let expected = format!("shape: {} does not fit 6 elements", show_shape(shape));
            assert_eq!(messages, [expected.clone(), expected.clone(), expected]);
        }
    }
}
