//! Arrays of Python as views, and arrays of the core as NumPy's.

use std::str::FromStr;

use numpy::{
    Element, IntoPyArray, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyReadwriteArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use saccade_vla::{Array, ArrayMut, ElementsRef, Error, OwnedArray, Problem, TensorView, TensorViews};

use crate::error::raise;

/// A view of an array that the Python package made C-contiguous.
pub(crate) fn view<'a, T: Element>(array: &'a PyReadonlyArrayDyn<'_, T>) -> PyResult<Array<'a, T>> {
    Array::new(array.as_slice()?, array.shape()).map_err(raise)
}

pub(crate) fn optional_view<'a, T: Element>(
    array: &'a Option<PyReadonlyArrayDyn<'_, T>>,
) -> PyResult<Option<Array<'a, T>>> {
    array.as_ref().map(view).transpose()
}

/// A mask. The Python package gives bytes: NumPy's booleans may hold any byte, and a `bool` of Rust only two.
pub(crate) struct Mask {
    data: Vec<bool>,
    shape: Vec<usize>,
}

impl<'py> FromPyObject<'_, 'py> for Mask {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let bytes: PyReadonlyArrayDyn<'py, u8> = object.extract()?;
        let data = collected("mask", bytes.as_slice()?, |byte| byte != 0)?;
        Ok(Self {
            data,
            shape: bytes.shape().to_vec(),
        })
    }
}

impl Mask {
    pub(crate) fn view(&self) -> PyResult<Array<'_, bool>> {
        Array::new(&self.data, &self.shape).map_err(raise)
    }

    pub(crate) fn optional_view(mask: &Option<Self>) -> PyResult<Option<Array<'_, bool>>> {
        mask.as_ref().map(Self::view).transpose()
    }
}

/// An array to be written, with its `shape`.
pub(crate) fn view_mut<'a>(
    array: &'a mut PyReadwriteArrayDyn<'_, f32>,
    shape: &'a [usize],
) -> PyResult<ArrayMut<'a>> {
    ArrayMut::new(array.as_slice_mut()?, shape).map_err(raise)
}

/// A copy, or a `MemoryError`.
fn copied<T: Copy>(what: &'static str, data: &[T]) -> PyResult<Vec<T>> {
    collected(what, data, |element| element)
}

/// What `of` makes of each element, or a `MemoryError`.
fn collected<T: Copy, R>(what: &'static str, data: &[T], of: impl Fn(T) -> R) -> PyResult<Vec<R>> {
    let mut made = Vec::new();
    made.try_reserve_exact(data.len()).map_err(|_| {
        raise(Error::Memory {
            what,
            bytes: data.len().saturating_mul(size_of::<R>()),
        })
    })?;
    made.extend(data.iter().map(|&element| of(element)));
    Ok(made)
}

pub(crate) fn to_numpy<'py, T: Element>(
    py: Python<'py>,
    data: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    data.into_pyarray(py).reshape(shape.to_vec())
}

pub(crate) fn owned_to_numpy<T: Element>(
    py: Python<'_>,
    array: OwnedArray<T>,
) -> PyResult<Bound<'_, PyArrayDyn<T>>> {
    let (data, shape) = array.into_parts();
    to_numpy(py, data, &shape)
}

/// A copy of what an object of the core holds, which errors call `what`.
pub(crate) fn copied_to_numpy<'py, T: Element + Copy>(
    py: Python<'py>,
    what: &'static str,
    data: &[T],
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    to_numpy(py, copied(what, data)?, shape)
}

/// An array of one axis.
pub(crate) fn row_to_numpy<T: Element>(py: Python<'_>, row: Vec<T>) -> Bound<'_, PyArrayDyn<T>> {
    row.into_pyarray(py).to_dyn().clone()
}

pub(crate) fn owned(array: &PyReadonlyArrayDyn<'_, f32>) -> PyResult<OwnedArray> {
    OwnedArray::new(copied("intervention", array.as_slice()?)?, array.shape()).map_err(raise)
}

/// A tensor as the Python package gives it: float32, or 16 bits with the name of what they are.
#[derive(FromPyObject)]
pub(crate) enum PyTensor<'py> {
    Float32(PyReadonlyArrayDyn<'py, f32>),
    Half((String, PyReadonlyArrayDyn<'py, u16>)),
}

/// Tensors by name.
pub(crate) struct PyTensors<'py>(Vec<(String, PyTensor<'py>)>);

impl<'py> FromPyObject<'_, 'py> for PyTensors<'py> {
    type Error = PyErr;

    fn extract(object: Borrowed<'_, 'py, PyAny>) -> PyResult<Self> {
        let tensors = object.cast::<PyDict>()?.iter();
        let held = tensors.map(|(name, tensor)| Ok((name.extract()?, tensor.extract()?)));
        held.collect::<PyResult<_>>().map(Self)
    }
}

impl PyTensors<'_> {
    pub(crate) fn views(&self) -> PyResult<TensorViews<'_>> {
        let held = self.0.iter();
        held.map(|(name, tensor)| Ok((name.clone(), tensor.view()?)))
            .collect()
    }
}

impl PyTensor<'_> {
    fn view(&self) -> PyResult<TensorView<'_>> {
        let (shape, elements) = match self {
            Self::Float32(array) => (array.shape(), ElementsRef::F32(array.as_slice()?)),
            Self::Half((dtype, array)) => {
                let bits = array.as_slice()?;
                let elements = match dtype.as_str() {
                    "bfloat16" => ElementsRef::Bf16(bits),
                    "float16" => ElementsRef::F16(bits),
                    _ => {
                        let expected = "float32, bfloat16 or float16";
                        return Err(raise(Error::Input(Problem::expected("tensors", expected, dtype))));
                    }
                };
                (array.shape(), elements)
            }
        };
        TensorView::new(shape, elements).map_err(raise)
    }
}

/// An argument that names one of several things, such as a precision.
pub(crate) struct Named<T>(pub T);

impl<T: FromStr<Err = Error>> FromPyObject<'_, '_> for Named<T> {
    type Error = PyErr;

    fn extract(name: Borrowed<'_, '_, PyAny>) -> PyResult<Self> {
        name.extract::<String>()?.parse().map(Self).map_err(raise)
    }
}

/// Sets fields of a struct in a dict, each under its own name.
macro_rules! set_fields {
    ($dict:expr, $of:expr; $($field:ident)*) => {
        $($dict.set_item(stringify!($field), &$of.$field)?;)*
    };
}

pub(crate) use set_fields;
