//! Arrays of Python as views, and arrays of the core as NumPy's.

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
pub(crate) fn copied<T: Copy>(what: &'static str, data: &[T]) -> PyResult<Vec<T>> {
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

pub(crate) fn owned(array: &PyReadonlyArrayDyn<'_, f32>) -> PyResult<OwnedArray> {
    OwnedArray::new(copied("intervention", array.as_slice()?)?, array.shape()).map_err(raise)
}

/// A tensor as the Python package gives it: float32, or 16 bits with the name of what they are.
#[derive(FromPyObject)]
pub(crate) enum PyTensor<'py> {
    Float32(PyReadonlyArrayDyn<'py, f32>),
    Half((String, PyReadonlyArrayDyn<'py, u16>)),
}

pub(crate) fn held_tensors<'py>(tensors: &Bound<'py, PyDict>) -> PyResult<Vec<(String, PyTensor<'py>)>> {
    let held = tensors
        .iter()
        .map(|(name, tensor)| Ok((name.extract()?, tensor.extract()?)));
    held.collect()
}

pub(crate) fn tensor_views<'a>(held: &'a [(String, PyTensor<'_>)]) -> PyResult<TensorViews<'a>> {
    let view = |tensor: &'a PyTensor<'_>| {
        Ok::<_, PyErr>(match tensor {
            PyTensor::Float32(array) => {
                TensorView::new(array.shape(), ElementsRef::F32(array.as_slice()?)).map_err(raise)?
            }
            PyTensor::Half((dtype, array)) => {
                let bits = array.as_slice()?;
                let elements = match dtype.as_str() {
                    "bfloat16" => ElementsRef::Bf16(bits),
                    "float16" => ElementsRef::F16(bits),
                    _ => {
                        return Err(raise(Error::Input(Problem::expected(
                            "tensors",
                            "float32, bfloat16 or float16",
                            dtype,
                        ))));
                    }
                };
                TensorView::new(array.shape(), elements).map_err(raise)?
            }
        })
    };
    held.iter()
        .map(|(name, tensor)| Ok((name.clone(), view(tensor)?)))
        .collect()
}
