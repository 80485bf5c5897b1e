//! Arrays of Python as views, and arrays of the core as NumPy's.

use numpy::{Element, IntoPyArray, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use saccade::{Array, ElementsRef, OwnedArray, TensorView, TensorViews};

/// A view of an array that the Python package made C-contiguous.
pub(crate) fn view<'a, T: Element>(array: &'a PyReadonlyArrayDyn<'_, T>) -> PyResult<Array<'a, T>> {
    Ok(Array::new(array.as_slice()?, array.shape()))
}

pub(crate) fn optional_view<'a, T: Element>(
    array: &'a Option<PyReadonlyArrayDyn<'_, T>>,
) -> PyResult<Option<Array<'a, T>>> {
    array.as_ref().map(view).transpose()
}

pub(crate) fn to_numpy<'py, T: Element>(
    py: Python<'py>,
    data: Vec<T>,
    shape: &[usize],
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    data.into_pyarray(py).reshape(shape.to_vec())
}

pub(crate) fn owned(array: &PyReadonlyArrayDyn<'_, f32>) -> PyResult<OwnedArray> {
    Ok(OwnedArray::new(array.as_slice()?.to_vec(), array.shape()))
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
            PyTensor::Float32(array) => TensorView::new(array.shape(), ElementsRef::F32(array.as_slice()?)),
            PyTensor::Half((dtype, array)) => {
                let bits = array.as_slice()?;
                let elements = match dtype.as_str() {
                    "bfloat16" => ElementsRef::Bf16(bits),
                    _ => ElementsRef::F16(bits),
                };
                TensorView::new(array.shape(), elements)
            }
        })
    };
    held.iter()
        .map(|(name, tensor)| Ok((name.clone(), view(tensor)?)))
        .collect()
}
