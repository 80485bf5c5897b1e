//! `saccade._saccade.HeadCheckpoint`: an open checkpoint and what it is.

use std::collections::BTreeMap;
use std::path::PathBuf;

use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use saccade_vla::files::Checkpoint;
use saccade_vla::{Precision, TensorFacts};

use crate::arrays::{Named, to_numpy};
use crate::config::config_dict;
use crate::detached::call;

/// Every tensor whose name begins with `prefix`, as float32, by the rest of its name.
#[pyfunction]
pub(crate) fn read_tensors<'py>(
    py: Python<'py>,
    source: PathBuf,
    prefix: &str,
) -> PyResult<Bound<'py, PyDict>> {
    let checkpoint = call(py, || Ok(Checkpoint::open(&source)?))?;
    let dict = PyDict::new(py);
    for name in checkpoint.names().filter(|name| name.starts_with(prefix)) {
        // Reading one tensor asks nobody whether to go on, and there may be a thousand.
        py.check_signals()?;
        let data = call(py, || Ok(checkpoint.read_f32(name)?))?;
        let shape = checkpoint
            .shape(name)
            .expect("the name is one of the checkpoint's");
        // Of int4 there are two weights in a byte.
        let stored = shape.iter().product::<usize>();
        let mut shape = shape.to_vec();
        if let Some(width) = shape.last_mut()
            && data.len() > stored
        {
            *width *= 2;
        }
        dict.set_item(&name[prefix.len()..], to_numpy(py, data, &shape)?)?;
    }
    Ok(dict)
}

/// The names of all tensors, sorted.
#[pyfunction]
pub(crate) fn tensor_names(py: Python<'_>, source: PathBuf) -> PyResult<Vec<String>> {
    let checkpoint = call(py, || Ok(Checkpoint::open(&source)?))?;
    Ok(checkpoint.names().map(str::to_owned).collect())
}

/// Type, shape and bytes of a tensor, as stored.
type PyStoredTensor<'py> = (String, Vec<usize>, Bound<'py, PyBytes>);

/// Every tensor of a file as it is stored, of whatever type, by name. For small files.
#[pyfunction]
pub(crate) fn read_stored<'py>(
    py: Python<'py>,
    source: PathBuf,
) -> PyResult<BTreeMap<String, PyStoredTensor<'py>>> {
    let checkpoint = call(py, || Ok(Checkpoint::open_file(&source)?))?;
    let mut tensors = BTreeMap::new();
    for name in checkpoint.names() {
        let mut bytes = Vec::new();
        let dtype = call(py, || {
            checkpoint.read_bytes(name, |piece| {
                bytes.extend_from_slice(piece);
                Ok::<_, saccade_vla::Error>(())
            })?;
            Ok(format!("{:?}", checkpoint.dtype(name)?))
        })?;
        let shape = checkpoint.shape(name).unwrap_or_default().to_vec();
        tensors.insert(name.to_owned(), (dtype, shape, PyBytes::new(py, &bytes)));
    }
    Ok(tensors)
}

/// Name, type, shape and bytes in the file of a tensor.
type PyTensorFacts = (String, String, Vec<usize>, u64);

/// An open checkpoint and what it is.
#[pyclass(frozen, module = "saccade._saccade")]
pub(crate) struct HeadCheckpoint(pub(crate) saccade_vla::HeadCheckpoint);

#[pymethods]
impl HeadCheckpoint {
    #[staticmethod]
    fn open(py: Python<'_>, source: PathBuf, config: Option<String>) -> PyResult<Self> {
        let open = || saccade_vla::HeadCheckpoint::open(&source, config.as_deref());
        call(py, open).map(Self)
    }

    /// The base of the adapter in a directory.
    #[staticmethod]
    fn open_base(
        py: Python<'_>,
        source: PathBuf,
        config: Option<String>,
        adapter: Option<PathBuf>,
    ) -> PyResult<Self> {
        let open = || saccade_vla::open_base(&source, config.as_deref(), adapter.as_deref());
        call(py, open).map(Self)
    }

    fn config<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        config_dict(py, &self.0.config)
    }

    #[getter]
    fn config_json(&self) -> String {
        self.0.config_json.clone()
    }

    #[getter]
    fn layout(&self) -> String {
        self.0.layout.to_string()
    }

    #[getter]
    fn prefix(&self) -> &'static str {
        self.0.prefix
    }

    #[getter]
    fn evidence(&self) -> Vec<String> {
        self.0.evidence.clone()
    }

    #[getter]
    fn files(&self) -> Vec<PathBuf> {
        self.0.files().map(PathBuf::from).collect()
    }

    /// What the files say of themselves.
    #[getter]
    fn metadata(&self) -> BTreeMap<String, String> {
        self.0.checkpoint.metadata().clone()
    }

    /// The embodiments that are left, if others were taken out.
    fn kept_embodiments(&self, py: Python<'_>) -> PyResult<Option<Vec<i64>>> {
        call(py, || self.0.kept_embodiments())
    }

    fn tensors(&self) -> Vec<PyTensorFacts> {
        let fields = |tensor: TensorFacts| (tensor.name, tensor.dtype, tensor.shape, tensor.nbytes);
        self.0.tensors().map(fields).collect()
    }

    fn check(&self, py: Python<'_>) -> PyResult<()> {
        call(py, || self.0.check())
    }

    /// A tensor as float32, or one slice of its first axis.
    fn read<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        index: Option<usize>,
    ) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let (data, shape) = call(py, || self.0.read(name, index))?;
        to_numpy(py, data, &shape)
    }

    fn nbytes(&self, py: Python<'_>, precision: Named<Precision>, num_embodiments: usize) -> PyResult<usize> {
        call(py, || self.0.nbytes(precision.0, num_embodiments))
    }
}
