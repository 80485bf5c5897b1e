//! `saccade._saccade.CrossAttention` and its keys and values.

use numpy::{PyReadonlyArrayDyn, PyReadwriteArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use saccade_vla::{KeyOptions, Precision};

use crate::arrays::{Mask, Named, PyTensors, optional_view, view, view_mut};
use crate::detached::call;

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct KeyValues(saccade_vla::KeyValues);

#[pymethods]
impl KeyValues {
    #[getter]
    fn batch(&self) -> usize {
        self.0.batch()
    }

    #[getter]
    fn num_vl_tokens(&self) -> usize {
        self.0.num_vl_tokens()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }
}

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct CrossAttention(saccade_vla::CrossAttention);

#[pymethods]
impl CrossAttention {
    #[new]
    fn new(
        py: Python<'_>,
        tensors: PyTensors<'_>,
        num_heads: usize,
        precision: Named<Precision>,
    ) -> PyResult<Self> {
        let views = tensors.views()?;
        let made = || saccade_vla::CrossAttention::new(&views, num_heads, precision.0, None);
        call(py, made).map(Self)
    }

    #[getter]
    fn width(&self) -> usize {
        self.0.width()
    }

    #[getter]
    fn context_dim(&self) -> usize {
        self.0.context_dim()
    }

    #[getter]
    fn num_heads(&self) -> usize {
        self.0.num_heads()
    }

    #[getter]
    fn precision(&self) -> String {
        self.0.engine().precision.to_string()
    }

    #[getter]
    fn nbytes(&self) -> usize {
        self.0.nbytes()
    }

    fn project(
        &self,
        py: Python<'_>,
        encoder_hidden_states: PyReadonlyArrayDyn<'_, f32>,
    ) -> PyResult<KeyValues> {
        let states = view(&encoder_hidden_states)?;
        call(py, || self.0.project(states)).map(KeyValues)
    }

    #[allow(clippy::too_many_arguments)]
    fn attend(
        &self,
        py: Python<'_>,
        hidden_states: PyReadonlyArrayDyn<'_, f32>,
        kv: &KeyValues,
        key_mask: Option<Mask>,
        key_bias: Option<PyReadonlyArrayDyn<'_, f32>>,
        mut weights: Option<PyReadwriteArrayDyn<'_, f32>>,
        mut out: PyReadwriteArrayDyn<'_, f32>,
    ) -> PyResult<()> {
        let hidden_states = view(&hidden_states)?;
        let keys = KeyOptions {
            key_mask: Mask::optional_view(&key_mask)?,
            key_bias: optional_view(&key_bias)?,
        };
        let weights_shape = weights.as_ref().map(|weights| weights.shape().to_vec());
        let weights = match (&mut weights, &weights_shape) {
            (Some(weights), Some(shape)) => Some(view_mut(weights, shape)?),
            _ => None,
        };
        let shape = out.shape().to_vec();
        let (kv, out) = (&kv.0, view_mut(&mut out, &shape)?);
        call(py, || self.0.attend(hidden_states, kv, keys, weights, out))
    }
}
