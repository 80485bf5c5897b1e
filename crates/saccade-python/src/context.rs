//! `saccade._saccade.Context`: an encoded observation.

use std::sync::Arc;

use numpy::PyArrayDyn;
use pyo3::prelude::*;

use crate::arrays::copied_to_numpy;

#[derive(Clone)]
#[pyclass(frozen, from_py_object, module = "saccade._saccade")]
pub(crate) struct Context(pub(crate) Arc<saccade_vla::Context>);

#[pymethods]
impl Context {
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

    fn vl_embs<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let rows = self.0.batch() * self.0.num_vl_tokens();
        let data = self.0.vl_embs();
        let shape = [self.0.batch(), self.0.num_vl_tokens(), data.len() / rows];
        copied_to_numpy(py, "vl_embs", data, &shape)
    }

    fn image_mask<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArrayDyn<bool>>>> {
        let shape = [self.0.batch(), self.0.num_vl_tokens()];
        let mask = self.0.image_mask();
        mask.map(|mask| copied_to_numpy(py, "image_mask", mask, &shape))
            .transpose()
    }
}
