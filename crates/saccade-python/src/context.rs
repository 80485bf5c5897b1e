//! `saccade._saccade.Context`: an encoded observation.

use std::sync::Arc;

use numpy::PyArrayDyn;
use pyo3::prelude::*;

use crate::arrays::to_numpy;

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct Context(pub(crate) Arc<saccade::Context>);

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
            data.to_vec(),
            &[self.0.batch(), self.0.num_vl_tokens(), data.len() / rows],
        )
    }

    fn image_mask<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArrayDyn<bool>>>> {
        let shape = [self.0.batch(), self.0.num_vl_tokens()];
        self.0
            .image_mask()
            .map(|mask| to_numpy(py, mask.to_vec(), &shape))
            .transpose()
    }
}
