//! Quantised checkpoints: the weights that are multiplied in int8, stored as int8.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use saccade_checkpoint::spec::SCALE_SUFFIX;
use saccade_checkpoint::{Checkpoint, CheckpointWriter, Dtype, PlannedTensor, TensorSpec, reserve};
use saccade_kernels::quantize_rows;

use crate::alloc::filled;
use crate::error::{Error, Result};
use crate::head::plan::tensor_specs;
use crate::nn::weights::weight_view;
use crate::ops::check_interrupted;
use crate::rewrite::float::Float;
use crate::rewrite::{RewriteOptions, SourceCheckpoint, Written};

/// What [`quantize`] wrote.
#[derive(Clone, Debug)]
pub struct QuantizeReport {
    /// The files.
    pub written: Written,
    /// Weights that were quantised.
    pub num_quantized: usize,
    /// Tensors copied bit for bit.
    pub num_copied: usize,
    /// Bytes of the head's tensors before.
    pub head_bytes_before: u64,
    /// Bytes of the head's tensors after, including scales.
    pub head_bytes_after: u64,
}

/// Writes the checkpoint `source` to the directory `out` with the weights of the blocks' linear layers in int8, `X.weight (out, in)`
/// and float32 `X.weight_scale (out)`, by [`quantize_rows`]: what [`Precision::Int8`](crate::Precision::Int8) computes with, so that
/// loading the result at that precision gives the same bits as loading `source` at it. All other tensors are copied bit for bit.
///
/// One tensor is in memory at a time. `progress(done, total)`, in bytes read, is called after each tensor; if it returns false, nothing is
/// written.
///
/// # Errors
/// Of kind [`Checkpoint`](crate::ErrorKind::Checkpoint) for a source that is broken, does not fit its config or is quantised already, and for
/// weights of the head that are not finite; [`Input`](crate::ErrorKind::Input) if `out` exists and `force` is not set, holds anything but a
/// checkpoint, or is the source; [`Output`](crate::ErrorKind::Output) if it cannot be written.
pub fn quantize(
    source: &Path,
    out: &Path,
    options: &RewriteOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<QuantizeReport> {
    let source = SourceCheckpoint::open(source, options.config.as_deref())?;
    let specs = tensor_specs(&source.config)?;
    let weights: BTreeSet<String> = specs
        .iter()
        .map(|spec| format!("{}{}", source.prefix, spec.name))
        .collect();
    let int8: BTreeMap<String, &TensorSpec> = specs
        .iter()
        .filter(|spec| spec.may_be_int8)
        .map(|spec| (format!("{}{}", source.prefix, spec.name), spec))
        .collect();
    if let Some(name) = int8
        .keys()
        .find(|name| matches!(source.checkpoint.dtype(name), Ok(Dtype::I8)))
    {
        return Err(Error::Checkpoint(format!(
            "source: it is quantised already: {name} is I8, expected F32, BF16 or F16"
        )));
    }
    let mut planned = Vec::new();
    let mut report = QuantizeReport {
        written: Written::default(),
        num_quantized: 0,
        num_copied: 0,
        head_bytes_before: 0,
        head_bytes_after: 0,
    };
    for name in source.names(options) {
        let mut tensors = vec![source.as_it_is(name)?];
        if int8.contains_key(name) {
            report.num_quantized += 1;
            tensors[0].dtype = Dtype::I8;
            tensors.push(PlannedTensor {
                name: format!("{name}{SCALE_SUFFIX}"),
                dtype: Dtype::F32,
                shape: vec![source.shape(name)[0]],
            });
        } else {
            report.num_copied += 1;
        }
        if source.is_head(name) {
            report.head_bytes_before += source.checkpoint.nbytes(name)?;
            report.head_bytes_after += tensors.iter().map(PlannedTensor::nbytes).sum::<usize>() as u64;
        }
        planned.extend(tensors);
    }
    let config = [("config.json", Some(source.given_config.as_str()))];
    report.written = source.write(
        out,
        options,
        &config,
        planned,
        &mut progress,
        |name, writer| match int8.get(name) {
            Some(spec) => write_quantized(&source.checkpoint, name, spec, writer),
            None if weights.contains(name) => copy_finite(&source.checkpoint, name, writer),
            None => source.copy(name, writer),
        },
    )?;
    Ok(report)
}

fn write_quantized(
    checkpoint: &Checkpoint,
    name: &str,
    spec: &TensorSpec,
    writer: &mut CheckpointWriter,
) -> Result<()> {
    let [out_features, in_features] = *spec.shape else {
        unreachable!("a linear layer's weight has two axes")
    };
    check_interrupted()?;
    let weight = checkpoint.read(name)?;
    let mut values: Vec<i8> = Vec::new();
    reserve("source", &mut values, out_features * in_features)?;
    values.resize(out_features * in_features, 0);
    let mut scales = filled("source", out_features, 0.0)?;
    quantize_rows(
        weight_view(&weight, out_features, in_features),
        &mut values,
        &mut scales,
    );
    if let Some(row) = scales.iter().position(|scale| !(127.0 * scale).is_finite()) {
        return Err(Error::Checkpoint(format!(
            "source: {name} holds NaN or infinity in row {row}, expected finite weights"
        )));
    }
    writer.tensor(name, bytemuck::cast_slice(&values))?;
    let scales: Vec<u8> = scales.into_iter().flat_map(f32::to_le_bytes).collect();
    Ok(writer.tensor(&format!("{name}{SCALE_SUFFIX}"), &scales)?)
}

/// Copies a tensor of the head bit for bit, if all its numbers are finite.
fn copy_finite(checkpoint: &Checkpoint, name: &str, writer: &mut CheckpointWriter) -> Result<()> {
    let Some(float) = Float::of(checkpoint.dtype(name)?) else {
        unreachable!("a head's tensors are checked to be floating point")
    };
    let mut values = Vec::new();
    checkpoint.read_bytes(name, |bytes| {
        check_interrupted()?;
        float.read(bytes, &mut values);
        if let Some(bad) = values.iter().find(|value| !value.is_finite()) {
            return Err(Error::Checkpoint(format!(
                "source: {name} holds {bad}, expected finite weights"
            )));
        }
        Ok(writer.tensor(name, bytes)?)
    })
}
