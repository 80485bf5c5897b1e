//! Quantised checkpoints: the weights that int8 runs in int8, stored so.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use saccade_kernels::quantize_rows;
use safetensors::Dtype;

use crate::checkpoint::{Checkpoint, SCALE_SUFFIX};
use crate::config::HeadConfig;
use crate::error::{Error, Result};
use crate::head::read_config_beside;
use crate::layers::weight_view;
use crate::layout::{HeadNames, TensorSpec};
use crate::writer::{CheckpointWriter, Planned};

/// Published checkpoints are cut into files of this size.
const MAX_SHARD_BYTES: u64 = 5_000_000_000;

/// How a checkpoint is quantised.
#[derive(Clone, Debug)]
pub struct QuantizeOptions {
    /// The config as JSON; default the `config.json` beside the weights.
    pub config: Option<String>,
    /// Whether tensors outside the head's prefix, such as a backbone's, are left out; otherwise they are copied.
    pub head_only: bool,
    /// Whether a checkpoint that is there is replaced.
    pub force: bool,
    /// What the files' metadata say.
    pub metadata: BTreeMap<String, String>,
    /// A file is closed before it grows larger than this.
    pub max_shard_bytes: u64,
}

impl Default for QuantizeOptions {
    fn default() -> Self {
        Self {
            config: None,
            head_only: false,
            force: false,
            metadata: BTreeMap::new(),
            max_shard_bytes: MAX_SHARD_BYTES,
        }
    }
}

/// What [`quantize`] wrote.
#[derive(Clone, Debug)]
pub struct QuantizeReport {
    /// The files with tensors.
    pub files: Vec<PathBuf>,
    /// Weights that are int8 now.
    pub num_quantized: usize,
    /// Tensors copied bit for bit.
    pub num_copied: usize,
    /// Tensors outside the head that were left out.
    pub num_dropped: usize,
    /// Bytes of the head's tensors before.
    pub head_bytes_before: u64,
    /// Bytes of the head's tensors now, scales included.
    pub head_bytes_after: u64,
}

/// Writes the checkpoint `source` to the directory `out` with the weights of the blocks' linear layers in int8, `X.weight (out, in)`
/// beside float32 `X.weight_scale (out)`, by [`quantize_rows`]: what [`Precision::Int8`](crate::Precision::Int8) computes with, so that
/// loading the result at that precision gives the same bits as loading `source` at it. All other tensors are copied bit for bit.
///
/// One tensor is in memory at a time. `progress(done, total)`, in bytes read, is called after each tensor; where it returns false, nothing
/// is written.
///
/// # Errors
/// As [`ActionHead::load`](crate::ActionHead::load); [`Error::Checkpoint`] for a source that is quantised already or whose weights are not
/// finite; [`Error::Input`] if `out` is there and `force` is not given, holds anything but a checkpoint, or is the source;
/// [`Error::Output`] if it cannot be written.
pub fn quantize(
    source: &Path,
    out: &Path,
    options: &QuantizeOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<QuantizeReport> {
    let checkpoint = Checkpoint::open(source)?;
    let config = match &options.config {
        Some(text) => text.clone(),
        None => read_config_beside(source)?,
    };
    let head_config = HeadConfig::from_json(&config)?;
    let specs = HeadNames::new(&head_config).tensors();
    let prefix = checkpoint.head_prefix()?;
    let int8: BTreeMap<String, &TensorSpec> = specs
        .iter()
        .filter(|spec| spec.may_be_int8)
        .map(|spec| (format!("{prefix}{}", spec.name), spec))
        .collect();
    if let Some(name) = int8
        .keys()
        .find(|name| matches!(checkpoint.dtype(name), Ok(Dtype::I8)))
    {
        return Err(Error::Checkpoint(format!(
            "source: it is quantised already: {name} is I8, expected F32, BF16 or F16"
        )));
    }
    checkpoint.check(prefix, &head_config)?;
    check_apart(source, checkpoint.files(), out)?;

    let is_kept = |name: &&str| !options.head_only || name.starts_with(prefix);
    let names: Vec<&str> = checkpoint.names().filter(is_kept).collect();
    let mut planned = Vec::with_capacity(names.len());
    let mut report = QuantizeReport {
        files: Vec::new(),
        num_quantized: 0,
        num_copied: 0,
        num_dropped: checkpoint.names().count() - names.len(),
        head_bytes_before: 0,
        head_bytes_after: 0,
    };
    let mut total = 0;
    for &name in &names {
        let shape = checkpoint
            .shape(name)
            .expect("the name is one of the checkpoint's");
        let nbytes = checkpoint.nbytes(name)?;
        total += nbytes;
        let mut nbytes_after = nbytes;
        if int8.contains_key(name) {
            report.num_quantized += 1;
            nbytes_after = (shape.iter().product::<usize>() + 4 * shape[0]) as u64;
            planned.push(Planned {
                name: format!("{name}{SCALE_SUFFIX}"),
                dtype: Dtype::F32,
                shape: vec![shape[0]],
            });
        } else {
            report.num_copied += 1;
        }
        if name.starts_with(prefix) {
            report.head_bytes_before += nbytes;
            report.head_bytes_after += nbytes_after;
        }
        planned.push(Planned {
            name: name.to_owned(),
            dtype: if int8.contains_key(name) {
                Dtype::I8
            } else {
                checkpoint.dtype(name)?
            },
            shape: shape.to_vec(),
        });
    }
    let mut writer = CheckpointWriter::create(
        out,
        planned,
        &options.metadata,
        options.max_shard_bytes,
        options.force,
    )?;
    writer.file("config.json", &config)?;
    let mut done = 0;
    for &name in &names {
        match int8.get(name) {
            Some(spec) => write_quantized(&checkpoint, name, spec, &mut writer)?,
            None => checkpoint.read_bytes(name, |bytes| writer.tensor(name, bytes))?,
        }
        done += checkpoint.nbytes(name)?;
        if !progress(done, total) {
            return Err(Error::Input("quantize: stopped; nothing was written".to_owned()));
        }
    }
    report.files = writer.finish()?;
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
    let weight = checkpoint.read(name)?;
    let (mut values, mut scales) = (vec![0; out_features * in_features], vec![0.0; out_features]);
    quantize_rows(
        weight_view(&weight, out_features, in_features),
        &mut values,
        &mut scales,
    );
    if let Some(row) = scales.iter().position(|scale| !scale.is_finite()) {
        return Err(Error::Checkpoint(format!(
            "source: {name} holds NaN or infinity in row {row}, expected finite weights"
        )));
    }
    writer.tensor(name, bytemuck::cast_slice(&values))?;
    let scales: Vec<u8> = scales.into_iter().flat_map(f32::to_le_bytes).collect();
    writer.tensor(&format!("{name}{SCALE_SUFFIX}"), &scales)
}

/// That neither the source nor a file that it links to is in what would be replaced.
fn check_apart<'a>(source: &'a Path, files: impl Iterator<Item = &'a Path>, out: &Path) -> Result<()> {
    // Of what is not a directory the writer says so.
    let Some(to) = out.canonicalize().ok().filter(|to| to.is_dir()) else {
        return Ok(());
    };
    let is_inside = |path: &Path| path.canonicalize().is_ok_and(|from| from.starts_with(&to));
    if std::iter::once(source).chain(files).any(is_inside) {
        return Err(Error::Input(format!(
            "out: {} holds the source, expected another directory",
            out.display()
        )));
    }
    Ok(())
}
