//! Checkpoints with fewer embodiments, in another type, cut into other files, or with an adapter merged into them.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::spec::{SCALE_SUFFIX, is_quantized};
use saccade_vla_checkpoint::{Checkpoint, CheckpointWriter, PlannedTensor};

use crate::error::{Error, Result, ensure, problem};
use crate::head::embodiments::chosen_embodiments;
use crate::head::plan::tensor_specs;
use crate::head::state_dropout::STATE_DROPOUT;
use crate::ops::check_interrupted;
use crate::recognise::{KEPT_EMBODIMENTS, kept_embodiments};
use crate::rewrite::adapter::{Adapter, Delta};
use crate::rewrite::float::Float;
use crate::rewrite::{RewriteOptions, SourceCheckpoint, Written};

/// How a checkpoint is converted.
#[derive(Clone, Debug, Default)]
pub struct ConvertOptions {
    /// Options that all rewriting shares.
    pub rewrite: RewriteOptions,
    /// Keep only these embodiments; default all. They keep their ids: the slices of the others become zero, and the files' metadata list
    /// those that were kept.
    pub embodiment_ids: Option<Vec<i64>>,
    /// The type of all floating-point tensors; default the one that each has. int8, int4 and their scales stay, and so do the
    /// probabilities of dropping a state, since one that is rounded up to 1 would act.
    pub dtype: Option<Float>,
    /// The directory of a LoRA adapter to merge into the weights, in their type in the copy. Its statistics and processors take the place of the
    /// source's, and so does its `config.json`, unless the options have one.
    pub adapter: Option<PathBuf>,
}

/// What [`convert`] wrote.
#[derive(Clone, Debug, Default)]
pub struct ConvertReport {
    /// The files.
    pub written: Written,
    /// Weights that an adapter was added to.
    pub num_merged: usize,
    /// Tensors that an adapter replaced.
    pub num_replaced: usize,
    /// Tensors of another type than before.
    pub num_converted: usize,
    /// Numbers that rounding changed.
    pub num_rounded: u64,
    /// The largest difference between a number and what it was.
    pub largest_error: f32,
    /// The tensor with the largest difference.
    pub largest_error_in: Option<String>,
    /// The largest difference relative to the number itself.
    pub largest_relative_error: f32,
    /// The embodiments that were kept, if the options list any.
    pub embodiment_ids: Option<Vec<usize>>,
    /// Bytes of the embodiments that were not kept, which are zero now.
    pub zeroed_bytes: u64,
    /// Bytes of all tensors before, including those that were left out.
    pub bytes_before: u64,
    /// Bytes of all tensors now.
    pub bytes_after: u64,
}

/// Writes the checkpoint `source` to the directory `out`, changed as the options say. Everything else is copied bit for bit.
///
/// NaN and infinity are copied too; [`ActionHead::load`](crate::ActionHead::load) refuses them in the copy as in the source. One piece of a
/// tensor is in memory at a time. `progress(done, total)`, in bytes read, is called after each tensor; if it returns false, nothing is written.
///
/// ```
/// # let out = std::env::temp_dir().join(format!("saccade-convert-{}", std::process::id()));
/// use saccade_vla::{ConvertOptions, Float, convert};
/// let options = ConvertOptions { dtype: Some(Float::F32), ..ConvertOptions::default() };
/// let report = convert("examples/tiny".as_ref(), &out, &options, |_, _| true)?;
/// assert!(report.bytes_after > report.bytes_before);
/// # std::fs::remove_dir_all(&out).ok();
/// # Ok::<(), saccade_vla::Error>(())
/// ```
///
/// # Errors
/// Of kind [`Checkpoint`](crate::ErrorKind::Checkpoint) for a source that is broken or does not fit its config, for an adapter that is not plain
/// LoRA or does not fit the source, and for a finite number that the type cannot hold; [`Input`](crate::ErrorKind::Input) for ids out of range, and if `out` exists and `force` is not set, holds anything but
/// such a checkpoint, or is the source; [`Output`](crate::ErrorKind::Output) if it cannot be written.
pub fn convert(
    source: &Path,
    out: &Path,
    options: &ConvertOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<ConvertReport> {
    let folder = options.adapter.as_deref();
    let source = SourceCheckpoint::open_base(source, options.rewrite.config.as_deref(), folder)?;
    let adapter = folder
        .map(|folder| Adapter::open(folder, &source.checkpoint))
        .transpose()?;
    let mut report = ConvertReport::default();
    if let Some(adapter) = &adapter {
        (report.num_merged, report.num_replaced) = adapter.counts();
    }
    let mut rewrite = options.rewrite.clone();
    let mut kept = None;
    if let Some(ids) = &options.embodiment_ids {
        let there = kept_embodiments(&source.checkpoint)?;
        let ids = chosen_embodiments(Some(ids), there.as_deref(), source.config.num_embodiments)?;
        let note: Vec<String> = ids.iter().map(usize::to_string).collect();
        rewrite
            .metadata
            .insert(KEPT_EMBODIMENTS.to_owned(), note.join(","));
        kept = Some(ids.iter().copied().collect::<BTreeSet<usize>>());
        report.embodiment_ids = Some(ids);
    }
    let specs = tensor_specs(&source.config)?;
    let stacked: BTreeSet<String> = specs
        .iter()
        .filter(|spec| spec.is_stacked)
        .map(|spec| format!("{}{}", source.prefix, spec.name))
        .collect();
    let planned = plan(&source, options, &mut report)?;
    let config = [("config.json", Some(source.given_config.as_str()))];
    let mut rounding = Rounding::default();
    let mut zeroed_bytes = 0;
    report.written = source.write(out, &rewrite, &config, planned, &mut progress, |name, writer| {
        let mut tensor = Changed::new(&source, name, options, adapter.as_ref())?;
        let nbytes = tensor.nbytes()?;
        let slices = match &kept {
            Some(kept) if stacked.contains(name) => {
                let slice = nbytes / source.config.num_embodiments as u64;
                let ids = 0..source.config.num_embodiments;
                ids.map(|id| (kept.contains(&id), slice)).collect()
            }
            _ => vec![(true, nbytes)],
        };
        let mut start = 0;
        for (is_kept, nbytes) in slices {
            if is_kept {
                tensor.copy(start..start + nbytes, &mut rounding, writer)?;
            } else {
                let nbytes = tensor.nbytes_after(nbytes);
                writer.zeros(name, nbytes);
                zeroed_bytes += nbytes;
            }
            start += nbytes;
        }
        Ok(())
    })?;
    Ok(ConvertReport {
        num_rounded: rounding.count,
        largest_error: rounding.largest,
        largest_error_in: rounding.largest_in,
        largest_relative_error: rounding.largest_relative,
        zeroed_bytes,
        ..report
    })
}

/// The tensors of the copy; their sizes are added to `report`.
fn plan(
    source: &SourceCheckpoint,
    options: &ConvertOptions,
    report: &mut ConvertReport,
) -> Result<Vec<PlannedTensor>> {
    for name in source.checkpoint.names() {
        let nbytes = source.checkpoint.nbytes(name)?;
        report.bytes_before = report.bytes_before.saturating_add(nbytes);
    }
    let mut planned = Vec::new();
    for name in source.names(&options.rewrite) {
        let mut tensor = source.as_it_is(name)?;
        if let Some((_, to)) = change(source, name, options)? {
            tensor.dtype = to.dtype();
            report.num_converted += 1;
        }
        report.bytes_after = report.bytes_after.saturating_add(tensor.nbytes() as u64);
        planned.push(tensor);
    }
    Ok(planned)
}

/// The types of tensor `name` before and after, if they differ.
fn change(source: &SourceCheckpoint, name: &str, options: &ConvertOptions) -> Result<Option<(Float, Float)>> {
    let from = Float::of(source.checkpoint.dtype(name)?);
    let is_state_dropout = name.strip_prefix(source.prefix) == Some(STATE_DROPOUT);
    let is_scale = name
        .strip_suffix(SCALE_SUFFIX)
        .is_some_and(|scaled| matches!(source.checkpoint.dtype(scaled), Ok(dtype) if is_quantized(dtype)));
    Ok(from
        .zip(options.dtype)
        .filter(|(from, to)| from != to && !is_scale && !is_state_dropout))
}

/// A tensor of the source on its way into the copy.
struct Changed<'a> {
    /// Its name in the copy.
    name: &'a str,
    /// Where it is read from: the source, or an adapter that replaces it.
    checkpoint: &'a Checkpoint,
    name_there: &'a str,
    /// The types before and after, if its numbers may change.
    types: Option<(Float, Float)>,
    delta: Option<Delta>,
}

impl<'a> Changed<'a> {
    fn new(
        source: &'a SourceCheckpoint,
        name: &'a str,
        options: &ConvertOptions,
        adapter: Option<&'a Adapter>,
    ) -> Result<Self> {
        let there = Float::of(source.checkpoint.dtype(name)?);
        let after = change(source, name, options)?.map(|(_, to)| to).or(there);
        let (checkpoint, name_there) = adapter
            .and_then(|adapter| adapter.replacement(name))
            .unwrap_or((&source.checkpoint, name));
        let delta = adapter.map(|adapter| adapter.delta(name)).transpose()?.flatten();
        let before = Float::of(checkpoint.dtype(name_there)?);
        let is_changed = before != after || delta.is_some();
        Ok(Self {
            name,
            checkpoint,
            name_there,
            types: before.zip(after).filter(|_| is_changed),
            delta,
        })
    }

    /// Bytes that are read.
    fn nbytes(&self) -> Result<u64> {
        Ok(self.checkpoint.nbytes(self.name_there)?)
    }

    /// What `nbytes` of them become.
    fn nbytes_after(&self, nbytes: u64) -> u64 {
        self.types
            .map_or(nbytes, |(from, to)| nbytes / from.size() * to.size())
    }

    /// Writes some of its bytes, which hold whole elements.
    fn copy(
        &mut self,
        bytes: Range<u64>,
        rounding: &mut Rounding,
        writer: &mut CheckpointWriter,
    ) -> Result<()> {
        let (name, types, delta) = (self.name, self.types, &mut self.delta);
        let mut start = bytes.start;
        self.checkpoint.read_byte_range(self.name_there, bytes, |bytes| {
            check_interrupted()?;
            let Some((from, to)) = types else {
                return Ok(writer.tensor(name, bytes)?);
            };
            let first = (start / from.size()) as usize;
            start += bytes.len() as u64;
            let delta = delta.as_mut().map(|delta| (delta, first));
            rounding.write(name, bytes, (from, to), delta, writer)
        })
    }
}

/// What was lost in converting.
#[derive(Default)]
struct Rounding {
    count: u64,
    largest: f32,
    largest_in: Option<String>,
    largest_relative: f32,
    values: Vec<f32>,
    bytes: Vec<u8>,
}

impl Rounding {
    fn write(
        &mut self,
        name: &str,
        bytes: &[u8],
        (from, to): (Float, Float),
        delta: Option<(&mut Delta, usize)>,
        writer: &mut CheckpointWriter,
    ) -> Result<()> {
        from.read(bytes, &mut self.values);
        for &value in self.values.iter().filter(|value| value.is_finite()) {
            let rounded = to.round(value);
            if rounded == value {
                continue;
            }
            ensure!(
                rounded.is_finite(), Checkpoint, "source";
                "{name} holds {value}, more than {:?} can: expected another dtype", to.dtype()
            );
            let error = (rounded - value).abs();
            self.count += 1;
            self.largest_relative = self.largest_relative.max(error / value.abs());
            if error > self.largest {
                self.largest = error;
                self.largest_in = Some(name.to_owned());
            }
        }
        if let Some((delta, first)) = delta {
            self.merge(name, to, delta, first)?;
        }
        to.write(&self.values, &mut self.bytes);
        Ok(writer.tensor(name, &self.bytes)?)
    }

    /// Adds what an adapter adds to the values, the tensor's from number `first` on, after they were rounded to the type of the copy.
    fn merge(&mut self, name: &str, to: Float, delta: &mut Delta, first: usize) -> Result<()> {
        self.values.iter_mut().for_each(|value| *value = to.round(*value));
        let is_finite = self.values.iter().all(|value| value.is_finite());
        delta.add(first, &mut self.values);
        match self.values.iter().find(|value| !to.round(**value).is_finite()) {
            Some(bad) if is_finite => Err(Error::Checkpoint(problem!(
                "adapter"; "{name} would be {bad}, more than {:?} can hold: expected another dtype",
                to.dtype()
            ))),
            _ => Ok(()),
        }
    }
}
