//! Calibrated rounding to four bits: what linear layers are given, and weights rounded for it.

use std::collections::BTreeSet;
use std::path::PathBuf;

use numpy::{PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use crate::arrays::{set_fields, to_numpy, view};
use crate::checkpoint::HeadCheckpoint;
use crate::detached::call;
use crate::error::raise;

#[pyclass(module = "saccade._saccade")]
pub(crate) struct Gram(saccade_vla::Gram);

#[pymethods]
impl Gram {
    #[new]
    fn new(width: usize) -> PyResult<Self> {
        saccade_vla::Gram::new(width).map(Self).map_err(raise)
    }

    #[getter]
    fn width(&self) -> usize {
        self.0.width()
    }

    #[getter]
    fn num_rows(&self) -> usize {
        self.0.num_rows()
    }

    /// The matrix, `(width, width)`.
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let width = self.0.width();
        let matrix = (0..width).flat_map(|row| (0..width).map(move |column| self.0.get(row, column)));
        to_numpy(py, matrix.collect(), &[width, width])
    }

    /// Adds the rows of `x (rows, width)`.
    fn add(&mut self, py: Python<'_>, x: PyReadonlyArrayDyn<'_, f32>, num_threads: usize) -> PyResult<()> {
        let x = view(&x)?;
        call(py, || self.0.add(x, num_threads))
    }
}

/// Whole numbers `(out_features, in_features)` and errors of the outputs.
#[pyfunction]
pub(crate) fn gptq<'py>(
    py: Python<'py>,
    weight: PyReadonlyArrayDyn<'py, f32>,
    scales: PyReadonlyArrayDyn<'py, f32>,
    gram: &Gram,
    num_threads: usize,
) -> PyResult<(Bound<'py, PyArrayDyn<i8>>, Bound<'py, PyDict>)> {
    let (view, steps) = (view(&weight)?, scales.as_slice()?);
    let rounded = call(py, || saccade_vla::gptq(view, steps, &gram.0, num_threads))?;
    let errors = errors_dict(py, rounded.errors)?;
    Ok((to_numpy(py, rounded.values, weight.shape())?, errors))
}

fn errors_dict(py: Python<'_>, errors: saccade_vla::RoundingErrors) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    set_fields!(dict, errors; plain rounded outputs);
    Ok(dict)
}

/// Rounds the weights `names` of a layer and writes them to the directory `out`.
#[pyfunction]
pub(crate) fn round_layer<'py>(
    py: Python<'py>,
    checkpoint: &HeadCheckpoint,
    names: Vec<String>,
    gram: &Gram,
    out: PathBuf,
    num_threads: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let checkpoint = &checkpoint.0.checkpoint;
    let errors = call(py, || {
        saccade_vla::round_layer(checkpoint, &names, &gram.0, &out, num_threads)
    })?;
    errors_dict(py, errors)
}

/// The names of the weights of a layer that `round_layer` wrote, and their errors.
#[pyfunction]
pub(crate) fn rounded_layer(
    py: Python<'_>,
    directory: PathBuf,
) -> PyResult<(Vec<String>, Bound<'_, PyDict>)> {
    let layer = call(py, || saccade_vla::RoundedLayer::open(&directory))?;
    Ok((
        layer.weights().map(str::to_owned).collect(),
        errors_dict(py, layer.errors)?,
    ))
}

/// A context in which the linear layers that this thread runs are watched.
#[pyclass(unsendable, name = "watch_linears", module = "saccade._saccade")]
pub(crate) struct WatchLinears {
    wanted: BTreeSet<String>,
    watch: Option<saccade_vla::LinearWatch>,
    seen: Vec<saccade_vla::WatchedLinear>,
}

#[pymethods]
impl WatchLinears {
    #[new]
    fn new(wanted: Vec<String>) -> Self {
        Self {
            wanted: wanted.into_iter().collect(),
            watch: None,
            seen: Vec::new(),
        }
    }

    fn __enter__(mut this: PyRefMut<'_, Self>) -> PyResult<PyRefMut<'_, Self>> {
        let watch = saccade_vla::LinearWatch::start(this.wanted.clone());
        this.watch = Some(watch.map_err(raise)?);
        Ok(this)
    }

    #[pyo3(signature = (error, *_about))]
    fn __exit__(&mut self, error: &Bound<'_, PyAny>, _about: &Bound<'_, PyTuple>) -> PyResult<()> {
        // What was raised within is raised, not what the watch says of it.
        if let Some(watch) = self.watch.take().filter(|_| error.is_none()) {
            self.seen = watch.finish().map_err(raise)?;
        }
        Ok(())
    }

    /// `(weights, in_features, gram)` of each layer in the order in which they first ran, once the context is left; the
    /// Gram matrices of those that were wanted are handed over.
    fn layers(&mut self) -> Vec<(Vec<String>, usize, Option<Gram>)> {
        let seen = std::mem::take(&mut self.seen).into_iter();
        seen.map(|layer| (layer.weights, layer.in_features, layer.gram.map(Gram)))
            .collect()
    }
}
