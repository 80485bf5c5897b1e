//! `saccade_vla::linalg` for `saccade.linalg`.

use numpy::{PyArrayDyn, PyReadonlyArrayDyn};
use pyo3::prelude::*;
use saccade_vla::{Array, linalg};

use crate::arrays::{copied_to_numpy, owned_to_numpy, row_to_numpy, view};
use crate::detached::call;

type PyRows<'py> = PyReadonlyArrayDyn<'py, f64>;
type PyMade<'py> = Bound<'py, PyArrayDyn<f64>>;

/// What an object of the core holds, copied.
fn held<'py>(py: Python<'py>, array: Array<'_, f64>) -> PyResult<PyMade<'py>> {
    copied_to_numpy(py, "linear algebra", array.data(), array.shape())
}

fn held_row<'py>(py: Python<'py>, row: &[f64]) -> PyResult<PyMade<'py>> {
    copied_to_numpy(py, "linear algebra", row, &[row.len()])
}

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct Standardizer(linalg::Standardizer);

#[pymethods]
impl Standardizer {
    #[staticmethod]
    fn fit(py: Python<'_>, x: PyRows<'_>, scaled: bool) -> PyResult<Self> {
        let x = view(&x)?;
        let fit = if scaled {
            linalg::Standardizer::fit
        } else {
            linalg::Standardizer::centring
        };
        call(py, || fit(x)).map(Self)
    }

    #[getter]
    fn mean<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held_row(py, self.0.mean())
    }

    #[getter]
    fn scale<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held_row(py, self.0.scale())
    }

    fn transform<'py>(&self, py: Python<'py>, x: PyRows<'_>) -> PyResult<PyMade<'py>> {
        let x = view(&x)?;
        owned_to_numpy(py, call(py, || self.0.transform(x))?)
    }
}

#[pyclass(frozen, name = "PCA", module = "saccade._saccade")]
pub(crate) struct Pca(linalg::Pca);

#[pymethods]
impl Pca {
    #[staticmethod]
    fn fit(py: Python<'_>, x: PyRows<'_>, components: usize) -> PyResult<Self> {
        let x = view(&x)?;
        call(py, || linalg::Pca::fit(x, components)).map(Self)
    }

    #[getter]
    fn mean<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held_row(py, self.0.mean())
    }

    #[getter]
    fn components<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held(py, self.0.components())
    }

    #[getter]
    fn explained_variance<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held_row(py, self.0.explained_variance())
    }

    #[getter]
    fn total_variance(&self) -> f64 {
        self.0.total_variance()
    }

    fn transform<'py>(&self, py: Python<'py>, x: PyRows<'_>) -> PyResult<PyMade<'py>> {
        let x = view(&x)?;
        owned_to_numpy(py, call(py, || self.0.transform(x))?)
    }
}

#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct Ridge(linalg::Ridge);

#[pymethods]
impl Ridge {
    #[staticmethod]
    fn fit(py: Python<'_>, x: PyRows<'_>, y: PyRows<'_>, alphas: PyRows<'_>) -> PyResult<Self> {
        let (x, y, alphas) = (view(&x)?, view(&y)?, view(&alphas)?);
        call(py, || linalg::Ridge::fit(x, y, alphas.data())).map(Self)
    }

    #[getter]
    fn weights<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held(py, self.0.weights())
    }

    #[getter]
    fn intercepts<'py>(&self, py: Python<'py>) -> PyResult<PyMade<'py>> {
        held(py, self.0.intercepts())
    }

    fn predict<'py>(&self, py: Python<'py>, x: PyRows<'_>) -> PyResult<PyMade<'py>> {
        let x = view(&x)?;
        owned_to_numpy(py, call(py, || self.0.predict(x))?)
    }
}

#[pyfunction]
pub(crate) fn linear_cka(py: Python<'_>, x: PyRows<'_>, y: PyRows<'_>) -> PyResult<f64> {
    let (x, y) = (view(&x)?, view(&y)?);
    call(py, || linalg::linear_cka(x, y))
}

#[pyfunction]
pub(crate) fn principal_angles<'py>(py: Python<'py>, a: PyRows<'_>, b: PyRows<'_>) -> PyResult<PyMade<'py>> {
    let (a, b) = (view(&a)?, view(&b)?);
    Ok(row_to_numpy(py, call(py, || linalg::principal_angles(a, b))?))
}
