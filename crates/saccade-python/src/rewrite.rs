//! Writing changed copies of checkpoints.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use numpy::{PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use saccade_vla::{ConvertOptions, Error, Problem, ResizeOptions, RewriteOptions, Written};

use crate::arrays::to_numpy;
use crate::detached::call;
use crate::error::raise;

/// What `quantize`, `convert` and `resize` have in common.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct PyRewrite {
    source: PathBuf,
    out: PathBuf,
    config: Option<String>,
    head_only: bool,
    keep_backbone: bool,
    force: bool,
    metadata: BTreeMap<String, String>,
    max_shard_bytes: Option<u64>,
    /// Called with bytes done and bytes in all after each tensor; what it raises stops the work and is raised.
    progress: Option<Py<PyAny>>,
}

impl PyRewrite {
    /// Runs `work(source, out, options, progress)` without the interpreter.
    fn run<R: Send>(
        self,
        py: Python<'_>,
        work: impl FnOnce(
            &Path,
            &Path,
            RewriteOptions,
            &mut dyn FnMut(u64, u64) -> bool,
        ) -> saccade_vla::Result<R>
        + Send,
    ) -> PyResult<R> {
        let options = RewriteOptions {
            config: self.config,
            head_only: self.head_only,
            keep_backbone: self.keep_backbone,
            force: self.force,
            metadata: self.metadata,
            max_shard_bytes: self.max_shard_bytes,
        };
        let mut raised = None;
        let result = call(py, || {
            work(&self.source, &self.out, options, &mut |done, total| {
                let reported = Python::attach(|py| {
                    py.check_signals()?;
                    self.progress
                        .as_ref()
                        .map_or(Ok(()), |progress| progress.call1(py, (done, total)).map(|_| ()))
                });
                reported.map_err(|error| raised = Some(error)).is_ok()
            })
        });
        raised.map_or(result, Err)
    }
}

fn written_dict(py: Python<'_>, written: Written) -> PyResult<Bound<'_, PyDict>> {
    let dict = PyDict::new(py);
    dict.set_item("files", written.files)?;
    dict.set_item("carried", written.carried)?;
    dict.set_item("left", written.left)?;
    dict.set_item("num_dropped", written.num_dropped)?;
    Ok(dict)
}

#[pyfunction]
pub(crate) fn quantize<'py>(py: Python<'py>, rewrite: PyRewrite) -> PyResult<Bound<'py, PyDict>> {
    let report = rewrite.run(py, |source, out, options, progress| {
        saccade_vla::quantize(source, out, &options, progress)
    })?;
    let dict = written_dict(py, report.written)?;
    dict.set_item("num_quantized", report.num_quantized)?;
    dict.set_item("num_copied", report.num_copied)?;
    dict.set_item("head_bytes_before", report.head_bytes_before)?;
    dict.set_item("head_bytes_after", report.head_bytes_after)?;
    dict.set_item("num_quantized_backbone", report.num_quantized_backbone)?;
    dict.set_item("backbone_bytes_before", report.backbone_bytes_before)?;
    dict.set_item("backbone_bytes_after", report.backbone_bytes_after)?;
    dict.set_item("backbone_copied", report.backbone_copied)?;
    Ok(dict)
}

#[pyfunction]
pub(crate) fn convert<'py>(
    py: Python<'py>,
    rewrite: PyRewrite,
    embodiment_ids: Option<Vec<i64>>,
    dtype: Option<String>,
    adapter: Option<PathBuf>,
) -> PyResult<Bound<'py, PyDict>> {
    let dtype = dtype.map(|name| name.parse()).transpose().map_err(raise)?;
    let report = rewrite.run(py, |source, out, rewrite, progress| {
        let options = ConvertOptions {
            rewrite,
            embodiment_ids,
            dtype,
            adapter,
        };
        saccade_vla::convert(source, out, &options, progress)
    })?;
    let dict = written_dict(py, report.written)?;
    dict.set_item("num_merged", report.num_merged)?;
    dict.set_item("num_replaced", report.num_replaced)?;
    dict.set_item("num_converted", report.num_converted)?;
    dict.set_item("num_rounded", report.num_rounded)?;
    dict.set_item("largest_error", report.largest_error)?;
    dict.set_item("largest_error_in", report.largest_error_in)?;
    dict.set_item("largest_relative_error", report.largest_relative_error)?;
    dict.set_item("embodiment_ids", report.embodiment_ids)?;
    dict.set_item("zeroed_bytes", report.zeroed_bytes)?;
    dict.set_item("bytes_before", report.bytes_before)?;
    dict.set_item("bytes_after", report.bytes_after)?;
    Ok(dict)
}

#[pyfunction]
pub(crate) fn resize<'py>(
    py: Python<'py>,
    rewrite: PyRewrite,
    num_future_tokens: usize,
    perturbation: f64,
    seed: u64,
) -> PyResult<Bound<'py, PyDict>> {
    let report = rewrite.run(py, |source, out, rewrite, progress| {
        let options = ResizeOptions {
            rewrite,
            num_future_tokens,
            perturbation,
            seed,
        };
        saccade_vla::resize(source, out, &options, progress)
    })?;
    let dict = written_dict(py, report.written)?;
    dict.set_item("num_before", report.num_before)?;
    dict.set_item("num_after", report.num_after)?;
    dict.set_item("sources", report.sources)?;
    dict.set_item("future_key_bias", report.future_key_bias)?;
    dict.set_item("is_exact", report.is_exact)?;
    dict.set_item("is_widened", report.is_widened)?;
    dict.set_item("perturbation_rms", report.perturbation_rms)?;
    Ok(dict)
}

/// The rows, the tokens that each represents, and the biases of their keys.
type PyMergedTokens<'py> = (Bound<'py, PyArrayDyn<f32>>, Vec<Vec<usize>>, Option<Vec<f32>>);

/// Merges `tokens (count, width)` by the rule of `resize`.
#[pyfunction]
#[pyo3(signature = (tokens, num_future_tokens, key_bias=None))]
pub(crate) fn merge_future_tokens<'py>(
    py: Python<'py>,
    tokens: PyReadonlyArrayDyn<'py, f32>,
    num_future_tokens: usize,
    key_bias: Option<Vec<f32>>,
) -> PyResult<PyMergedTokens<'py>> {
    let (rows, &[_, width]) = (tokens.as_slice()?, tokens.shape()) else {
        let axes = tokens.shape().len();
        return Err(raise(Error::Shape(Problem::expected("tokens", "two axes", axes))));
    };
    let merged = call(py, || {
        saccade_vla::merge_future_tokens(rows, width, num_future_tokens, key_bias.as_deref())
    })?;
    let tokens = to_numpy(py, merged.tokens, &[merged.sources.len(), width])?;
    Ok((tokens, merged.sources, merged.key_bias))
}
