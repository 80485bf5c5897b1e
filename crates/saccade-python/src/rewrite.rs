//! Writing changed copies of checkpoints.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use numpy::{PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use saccade_vla::{ConvertOptions, Error, Float, Precision, Problem, ResizeOptions, RewriteOptions, Written};

use crate::arrays::{Named, set_fields, to_numpy};
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
    rounded: Vec<PathBuf>,
    force: bool,
    metadata: BTreeMap<String, String>,
    max_shard_bytes: Option<u64>,
    /// Called with bytes done and bytes in all after each tensor; what it raises stops the work and is raised.
    progress: Option<Py<PyAny>>,
}

impl PyRewrite {
    fn options(&self) -> RewriteOptions {
        RewriteOptions {
            config: self.config.clone(),
            head_only: self.head_only,
            keep_backbone: self.keep_backbone,
            rounded: self.rounded.clone(),
            force: self.force,
            metadata: self.metadata.clone(),
            max_shard_bytes: self.max_shard_bytes,
        }
    }

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
        let options = self.options();
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

fn written_dict<'py>(py: Python<'py>, written: &Written) -> PyResult<Bound<'py, PyDict>> {
    let dict = PyDict::new(py);
    set_fields!(dict, written; files carried left num_dropped);
    Ok(dict)
}

#[pyfunction]
pub(crate) fn quantize<'py>(
    py: Python<'py>,
    rewrite: PyRewrite,
    to: Named<Precision>,
) -> PyResult<Bound<'py, PyDict>> {
    let report = rewrite.run(py, |source, out, options, progress| {
        saccade_vla::quantize(source, out, to.0, &options, progress)
    })?;
    let dict = written_dict(py, &report.written)?;
    set_fields!(dict, report;
        num_quantized num_calibrated num_copied head_bytes_before head_bytes_after num_quantized_backbone
        backbone_bytes_before backbone_bytes_after backbone_copied);
    Ok(dict)
}

/// Which weights `quantize` would round: the prefix of the head's names, that of the backbone's, and all names.
#[pyfunction]
pub(crate) fn quantized_weights(
    py: Python<'_>,
    rewrite: PyRewrite,
) -> PyResult<(&'static str, Option<&'static str>, BTreeSet<String>)> {
    let found = call(py, || {
        saccade_vla::quantized_weights(&rewrite.source, &rewrite.out, &rewrite.options())
    })?;
    Ok((found.head_prefix, found.backbone_prefix, found.names))
}

#[pyfunction]
pub(crate) fn convert<'py>(
    py: Python<'py>,
    rewrite: PyRewrite,
    embodiment_ids: Option<Vec<i64>>,
    dtype: Option<Named<Float>>,
    adapter: Option<PathBuf>,
) -> PyResult<Bound<'py, PyDict>> {
    let dtype = dtype.map(|given| given.0);
    let report = rewrite.run(py, |source, out, rewrite, progress| {
        let options = ConvertOptions {
            rewrite,
            embodiment_ids,
            dtype,
            adapter,
        };
        saccade_vla::convert(source, out, &options, progress)
    })?;
    let dict = written_dict(py, &report.written)?;
    set_fields!(dict, report;
        num_merged num_replaced num_converted num_rounded largest_error largest_error_in
        largest_relative_error embodiment_ids zeroed_bytes bytes_before bytes_after);
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
    let dict = written_dict(py, &report.written)?;
    set_fields!(dict, report;
        num_before num_after sources future_key_bias is_exact is_widened perturbation_rms);
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
