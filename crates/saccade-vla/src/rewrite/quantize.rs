//! Quantised checkpoints: the weights that are multiplied in int8 or int4, stored so.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use saccade_vla_checkpoint::spec::{TABLE, WEIGHT};
use saccade_vla_checkpoint::{Checkpoint, CheckpointWriter, Dtype, PlannedTensor, TensorSpec};
use saccade_vla_kernels::quantize_rows;

use crate::alloc::filled;
use crate::backbone::BackboneCheckpoint;
use crate::error::{Error, Result, bail, ensure};
use crate::head::plan::tensor_specs;
use crate::nn::source::weight_view;
use crate::ops::check_interrupted;
use crate::precision::Precision;
use crate::rewrite::float::Float;
use crate::rewrite::quantized::{
    check_not_quantized, plain_int4, planned_int4, planned_with_scales, write_with_scales,
};
use crate::rewrite::rounding::RoundedWeights;
use crate::rewrite::{RewriteOptions, SourceCheckpoint, Written};

/// What [`quantize`] wrote.
#[derive(Clone, Debug, Default)]
pub struct QuantizeReport {
    /// The files.
    pub written: Written,
    /// Weights that were quantised.
    pub num_quantized: usize,
    /// How many of them were taken from [`RewriteOptions::rounded`].
    pub num_calibrated: usize,
    /// Tensors copied bit for bit.
    pub num_copied: usize,
    /// Bytes of the head's tensors before.
    pub head_bytes_before: u64,
    /// Bytes of the head's tensors after, including scales.
    pub head_bytes_after: u64,
    /// How many of the quantised weights are those of a backbone.
    pub num_quantized_backbone: usize,
    /// Bytes of the backbone's tensors before; 0 without a backbone that is quantised.
    pub backbone_bytes_before: u64,
    /// Bytes of the backbone's tensors after, including scales.
    pub backbone_bytes_after: u64,
    /// Why the tensors outside the head were copied bit for bit; none if they are those of a backbone that is quantised, or if there are none.
    pub backbone_copied: Option<String>,
}

/// Writes the checkpoint `source` to the directory `out` with the weights of the blocks' linear layers in the precision `to`: int8 as I8
/// `X.weight (out, in)` by [`quantize_rows`], or int4 as U8 `X.weight (out, in / 2)`, rounded up, by [`quantize_rows_int4`]; and float32
/// `X.weight_scale (out)`. That is what [`Precision::Int8`] and [`Precision::Int4`] compute with, so that loading the result at that precision
/// gives the same bits as loading `source` at it. So are the blocks of a backbone, if there is one that [`Backbone`](crate::Backbone) loads,
/// and with int4 its token embeddings, as int8. All other tensors are copied bit for bit.
///
/// [`quantize_rows_int4`]: saccade_vla_kernels::quantize_rows_int4
///
/// Weights in [`RewriteOptions::rounded`] are taken from there; [`round_layer`](crate::round_layer) writes such for the inputs of a layer.
///
/// One tensor is in memory at a time. `progress(done, total)`, in bytes read, is called after each tensor; if it returns false, nothing is
/// written.
///
/// ```
/// # let out = std::env::temp_dir().join(format!("saccade-quantize-{}", std::process::id()));
/// use saccade_vla::{ActionHead, LoadOptions, Precision, RewriteOptions, quantize};
/// let report = quantize("examples/tiny".as_ref(), &out, Precision::Int4, &RewriteOptions::default(), |_, _| true)?;
/// ActionHead::load(&out, &LoadOptions::default())?;
/// # std::fs::remove_dir_all(&out).ok();
/// # Ok::<(), saccade_vla::Error>(())
/// ```
///
/// # Errors
/// Of kind [`Checkpoint`](crate::ErrorKind::Checkpoint) for a source that is broken, does not fit its config or is quantised already, and for
/// weights of the head that are not finite; [`Input`](crate::ErrorKind::Input) if `to` is another precision, `out` exists and `force` is not set, holds anything but a
/// checkpoint, or is the source; [`Output`](crate::ErrorKind::Output) if it cannot be written.
pub fn quantize(
    source: &Path,
    out: &Path,
    to: Precision,
    options: &RewriteOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<QuantizeReport> {
    ensure!(to.quantizes(), Input, "to"; expected "'int8' or 'int4'"; got "'{to}'");
    ensure!(
        to == Precision::Int4 || options.rounded.is_empty(), Input, "rounded";
        expected "none with '{to}', since they have four bits"; got "{} layers", options.rounded.len()
    );
    let Quantizing {
        source,
        backbone,
        weights,
    } = Quantizing::open(source, to, options)?;
    let rounded = RoundedWeights::open(&options.rounded)?;
    if let Some(name) = rounded
        .names()
        .find(|&name| weights.stored_as(name) != Some(Dtype::U8))
    {
        bail!(Input, "rounded"; expected "weights that become int4"; got "{name}");
    }
    let backbone_prefix = weights.backbone_prefix;
    let mut planned = Vec::new();
    let mut report = QuantizeReport {
        num_calibrated: rounded.names().count(),
        backbone_copied: backbone.err(),
        ..QuantizeReport::default()
    };
    for name in source.names(options) {
        let is_backbone = backbone_prefix.is_some_and(|prefix| name.starts_with(prefix));
        let tensors = if let Some(dtype) = weights.stored_as(name) {
            report.num_quantized += 1;
            report.num_quantized_backbone += usize::from(is_backbone);
            let [out_features, in_features] = sizes_of(&source, name);
            match dtype {
                Dtype::U8 => planned_int4(name, out_features, in_features),
                _ => planned_with_scales(name, dtype, [out_features, in_features]),
            }
            .to_vec()
        } else {
            report.num_copied += 1;
            vec![source.as_it_is(name)?]
        };
        let before = source.checkpoint.nbytes(name)?;
        let after = tensors.iter().map(PlannedTensor::nbytes).sum::<usize>() as u64;
        if source.is_head(name) {
            report.head_bytes_before += before;
            report.head_bytes_after += after;
        } else if is_backbone {
            report.backbone_bytes_before += before;
            report.backbone_bytes_after += after;
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
        |name, writer| match weights.stored_as(name) {
            Some(dtype) => write_quantized(&source, name, dtype, &rounded, writer),
            None if weights.all.contains_key(name) => copy_finite(&source.checkpoint, name, writer),
            None => source.copy(name, writer),
        },
    )?;
    Ok(report)
}

/// The weights that [`quantize`] rounds to four bits.
#[derive(Clone, Debug)]
pub struct QuantizedWeights {
    /// What the names of the head's tensors begin with.
    pub head_prefix: &'static str,
    /// The same of the backbone's; none if there is none whose weights are quantised.
    pub backbone_prefix: Option<&'static str>,
    /// Their names, prefixes included.
    pub names: BTreeSet<String>,
}

/// Which weights [`quantize`] would round to int4, with the same arguments. Reads no tensor and leaves nothing.
///
/// # Errors
/// Those of [`quantize`] that can be known so far, also of `out`.
pub fn quantized_weights(source: &Path, out: &Path, options: &RewriteOptions) -> Result<QuantizedWeights> {
    let Quantizing { source, weights, .. } = Quantizing::open(source, Precision::Int4, options)?;
    source.check_out(out, options.force)?;
    Ok(QuantizedWeights {
        head_prefix: source.prefix,
        backbone_prefix: weights.backbone_prefix,
        names: weights
            .all
            .into_iter()
            .filter_map(|(name, dtype)| (dtype == Some(Dtype::U8)).then_some(name))
            .collect(),
    })
}

/// A checkpoint whose weights are to be quantised.
struct Quantizing {
    source: SourceCheckpoint,
    /// As [`backbone_of`] returns it.
    backbone: std::result::Result<Option<BackboneCheckpoint>, String>,
    weights: Names,
}

impl Quantizing {
    fn open(source: &Path, to: Precision, options: &RewriteOptions) -> Result<Self> {
        let source = SourceCheckpoint::open(source, options.config.as_deref())?;
        let backbone = backbone_of(&source, options)?;
        let mut weights = Names::default();
        weights.add(source.prefix, &tensor_specs(&source.config)?, to);
        if let Ok(Some(backbone)) = &backbone {
            weights.add(backbone.prefix(), backbone.specs(), to);
            weights.backbone_prefix = Some(backbone.prefix());
        }
        for name in &weights.may_be_quantized {
            // What the source has none of is found where the tensors are listed.
            if source.checkpoint.dtype(name).is_ok() {
                check_not_quantized(&source.checkpoint, name)?;
            }
        }
        Ok(Self {
            source,
            backbone,
            weights,
        })
    }
}

/// Tensors of models, by their names in the checkpoint.
#[derive(Default)]
struct Names {
    /// With the type that [`quantize`] stores each as; none of those that are copied.
    all: BTreeMap<String, Option<Dtype>>,
    /// Those that may be stored as whole numbers, whatever `quantize` stores them as.
    may_be_quantized: BTreeSet<String>,
    /// What the names of a backbone's begin with, if there is one that is quantised.
    backbone_prefix: Option<&'static str>,
}

impl Names {
    fn add(&mut self, prefix: &str, specs: &[TensorSpec], to: Precision) {
        for spec in specs {
            let name = format!("{prefix}{}", spec.name);
            let dtype = match (to, spec.quantized_types) {
                (Precision::Int4, WEIGHT) => Some(Dtype::U8),
                (Precision::Int4, TABLE) | (_, WEIGHT) => Some(Dtype::I8),
                // Tables stay as they are, although a model in int8 holds them as int8.
                _ => None,
            };
            if !spec.quantized_types.is_empty() {
                self.may_be_quantized.insert(name.clone());
            }
            self.all.insert(name, dtype);
        }
    }

    /// The type that a tensor is stored as; none if it is copied.
    fn stored_as(&self, name: &str) -> Option<Dtype> {
        self.all.get(name).copied().flatten()
    }
}

/// The backbone that is quantised, or why tensors outside the head are only copied; neither if there are none, or if they are left out.
fn backbone_of(
    source: &SourceCheckpoint,
    options: &RewriteOptions,
) -> Result<std::result::Result<Option<BackboneCheckpoint>, String>> {
    let has_others = source.checkpoint.names().any(|name| !source.is_head(name));
    if options.head_only || !has_others {
        return Ok(Ok(None));
    }
    if options.keep_backbone {
        return Ok(Err("as requested".to_owned()));
    }
    match BackboneCheckpoint::open(&source.path, Some(&source.given_config)) {
        Ok(backbone) => Ok(Ok(Some(backbone))),
        // Not a backbone that saccade loads, such as one of a program's own.
        Err(Error::Checkpoint(why)) => Ok(Err(why.to_string())),
        Err(error) => Err(error),
    }
}

fn write_quantized(
    source: &SourceCheckpoint,
    name: &str,
    dtype: Dtype,
    rounded: &RoundedWeights,
    writer: &mut CheckpointWriter,
) -> Result<()> {
    let [out_features, in_features] = sizes_of(source, name);
    check_interrupted()?;
    let (bytes, scales) = match rounded.read(name, &[out_features, in_features.div_ceil(2)])? {
        Some(found) => found,
        None => {
            let weight = source.checkpoint.read(name)?;
            if dtype == Dtype::U8 {
                plain_int4(&weight, out_features, in_features)?
            } else {
                let mut scales = filled("source", out_features, 0.0)?;
                let mut values = filled("source", out_features * in_features, 0_i8)?;
                quantize_rows(
                    weight_view(&weight, out_features, in_features),
                    &mut values,
                    &mut scales,
                );
                (bytemuck::cast_vec(values), scales)
            }
        }
    };
    let most = if dtype == Dtype::U8 { 7.0 } else { 127.0 };
    if let Some(row) = scales.iter().position(|scale| !(most * scale).is_finite()) {
        bail!(Checkpoint, "source"; "{name} holds NaN or infinity in row {row}, expected finite weights");
    }
    write_with_scales(name, &bytes, &scales, writer)
}

/// Outputs and inputs of a weight that is quantised.
fn sizes_of(source: &SourceCheckpoint, name: &str) -> [usize; 2] {
    let Ok(sizes) = <[usize; 2]>::try_from(source.shape(name)) else {
        unreachable!("a linear layer's weight has two axes")
    };
    sizes
}

/// Copies a tensor of the head bit for bit, if all its numbers are finite.
fn copy_finite(checkpoint: &Checkpoint, name: &str, writer: &mut CheckpointWriter) -> Result<()> {
    let Some(float) = Float::of(checkpoint.dtype(name)?) else {
        unreachable!(
            "tensors that may be stored as integers are checked not to be, and others are floating point"
        )
    };
    let mut values = Vec::new();
    checkpoint.read_bytes(name, |bytes| {
        check_interrupted()?;
        float.read(bytes, &mut values);
        if let Some(bad) = values.iter().find(|value| !value.is_finite()) {
            bail!(Checkpoint, "source"; "{name} holds {bad}, expected finite weights");
        }
        Ok(writer.tensor(name, bytes)?)
    })
}
