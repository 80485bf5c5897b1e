//! `saccade._saccade.Context`: an encoded observation.

use std::sync::Arc;

use numpy::PyArrayDyn;
use pyo3::prelude::*;

use crate::arrays::{copied, to_numpy};

#[pyclass(frozen, module = "saccade._saccade")]
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
        to_numpy(
            py,
            copied("vl_embs", data)?,
            &[self.0.batch(), self.0.num_vl_tokens(), data.len() / rows],
        )
    }

    fn image_mask<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArrayDyn<bool>>>> {
        let shape = [self.0.batch(), self.0.num_vl_tokens()];
        let to_numpy = |mask| to_numpy(py, copied("image_mask", mask)?, &shape);
        self.0.image_mask().map(to_numpy).transpose()
    }
}
