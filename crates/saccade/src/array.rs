//! A borrowed array with its shape, and the checks that every argument passes.

use crate::error::{Error, Result, show_shape};

/// A C-contiguous array: what the public functions take.
///
/// ```
/// let data = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
/// let array = saccade::Array::new(&data, &[2, 3]);
/// assert_eq!(array.shape, [2, 3]);
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Array<'a, T = f32> {
    /// The elements, last axis fastest.
    pub data: &'a [T],
    /// The size of each axis; their product is `data.len()`.
    pub shape: &'a [usize],
}

impl<'a, T> Array<'a, T> {
    /// A view of `data` with `shape`; the shape `[]` is a scalar.
    ///
    /// # Panics
    /// If `shape` does not multiply to the length of `data`.
    #[must_use]
    pub fn new(data: &'a [T], shape: &'a [usize]) -> Self {
        assert_eq!(
            data.len(),
            shape.iter().product::<usize>(),
            "the shape does not fit the data"
        );
        Self { data, shape }
    }

    /// That the array has exactly this shape; `axes` names its axes.
    pub(crate) fn check_shape(self, name: &str, axes: &str, expected: &[usize]) -> Result<Self> {
        if self.shape == expected {
            return Ok(self);
        }
        Err(Error::Shape(format!(
            "{name}: expected {axes} = {}, got {}",
            show_shape(expected),
            show_shape(self.shape)
        )))
    }
}

impl Array<'_, f32> {
    /// That no element is NaN or infinite.
    pub(crate) fn check_finite(self, name: &str) -> Result<Self> {
        match self.data.iter().position(|value| !value.is_finite()) {
            None => Ok(self),
            Some(position) => Err(Error::Input(format!(
                "{name}: expected finite values, got {} at index {}",
                self.data[position],
                show_shape(&unravel(position, self.shape))
            ))),
        }
    }
}

/// An array that owns its elements: what is kept, or given for keeps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OwnedArray {
    /// The elements, last axis fastest.
    pub data: Vec<f32>,
    /// The size of each axis; their product is `data.len()`.
    pub shape: Vec<usize>,
}

impl OwnedArray {
    /// `data` with `shape`.
    ///
    /// # Panics
    /// If `shape` does not multiply to the length of `data`.
    #[must_use]
    pub fn new(data: Vec<f32>, shape: &[usize]) -> Self {
        let shape = Array::new(&data, shape).shape.to_vec();
        Self { data, shape }
    }

    /// The array, borrowed.
    #[must_use]
    pub fn view(&self) -> Array<'_> {
        Array::new(&self.data, &self.shape)
    }
}

/// The index on every axis of the element at `position`.
fn unravel(mut position: usize, shape: &[usize]) -> Vec<usize> {
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
        let error = Array::new(&data, &[2, 3]).check_finite("state").unwrap_err();
        assert_eq!(
            error.to_string(),
            "state: expected finite values, got NaN at index (1, 1)"
        );
    }

    #[test]
    fn both_shapes_are_named() {
        let array = Array::new(&[0.0; 6], &[2, 3]);
        let error = array
            .check_shape("state", "(batch, state_dim)", &[2, 4])
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            "state: expected (batch, state_dim) = (2, 4), got (2, 3)"
        );
    }
}
