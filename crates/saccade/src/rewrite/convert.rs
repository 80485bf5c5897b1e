//! Checkpoints with fewer embodiments, in another type, or cut into other files.

use std::collections::BTreeSet;
use std::path::Path;

use half::{bf16, f16};
use saccade_checkpoint::spec::SCALE_SUFFIX;
use saccade_checkpoint::{CheckpointWriter, Dtype};

use crate::checkpoint::{KEPT_EMBODIMENTS, kept_embodiments};
use crate::error::{Error, Result};
use crate::head::embodiments::chosen_embodiments;
use crate::head::plan::tensor_specs;
use crate::rewrite::{RewriteOptions, Source, Written};

/// A type that weights are stored in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Float {
    /// float32.
    F32,
    /// bfloat16.
    Bf16,
    /// float16.
    F16,
}

impl std::str::FromStr for Float {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        match name {
            "float32" => Ok(Self::F32),
            "bfloat16" => Ok(Self::Bf16),
            "float16" => Ok(Self::F16),
            _ => Err(Error::Input(format!(
                "dtype: expected float32, bfloat16 or float16, got {name}"
            ))),
        }
    }
}

impl Float {
    pub(crate) fn of(dtype: Dtype) -> Option<Self> {
        match dtype {
            Dtype::F32 => Some(Self::F32),
            Dtype::BF16 => Some(Self::Bf16),
            Dtype::F16 => Some(Self::F16),
            _ => None,
        }
    }

    pub(crate) fn dtype(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::Bf16 => Dtype::BF16,
            Self::F16 => Dtype::F16,
        }
    }

    /// The numbers whose bytes these are.
    fn read(self, bytes: &[u8], values: &mut Vec<f32>) {
        let pairs = || {
            bytes
                .as_chunks::<2>()
                .0
                .iter()
                .map(|&pair| u16::from_le_bytes(pair))
        };
        values.clear();
        match self {
            Self::F32 => {
                let fours = bytes.as_chunks::<4>().0.iter();
                values.extend(fours.map(|&four| f32::from_le_bytes(four)));
            }
            Self::Bf16 => values.extend(pairs().map(|bits| bf16::from_bits(bits).to_f32())),
            Self::F16 => values.extend(pairs().map(|bits| f16::from_bits(bits).to_f32())),
        }
    }

    /// The bytes of these numbers, each the nearest of this type.
    pub(crate) fn write(self, values: &[f32], bytes: &mut Vec<u8>) {
        bytes.clear();
        match self {
            Self::F32 => bytes.extend(values.iter().flat_map(|value| value.to_le_bytes())),
            Self::Bf16 => bytes.extend(
                values
                    .iter()
                    .flat_map(|&value| bf16::from_f32(value).to_le_bytes()),
            ),
            Self::F16 => bytes.extend(
                values
                    .iter()
                    .flat_map(|&value| f16::from_f32(value).to_le_bytes()),
            ),
        }
    }

    /// A number as this type holds it.
    pub(crate) fn round(self, value: f32) -> f32 {
        match self {
            Self::F32 => value,
            Self::Bf16 => bf16::from_f32(value).to_f32(),
            Self::F16 => f16::from_f32(value).to_f32(),
        }
    }
}

/// How a checkpoint is converted.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct ConvertOptions {
    /// What is common to all rewriting.
    pub rewrite: RewriteOptions,
    /// Keep only these embodiments; default all. Ids keep their numbers: the slices of the others are zero, and the files' metadata say
    /// which are not.
    pub embodiment_ids: Option<Vec<i64>>,
    /// What floating point tensors become; default what they are. int8 and its scales stay.
    pub dtype: Option<Float>,
}

impl ConvertOptions {
    /// A copy by these rules that changes nothing else, to be changed field by field.
    #[must_use]
    pub fn new(rewrite: RewriteOptions) -> Self {
        Self {
            rewrite,
            ..Self::default()
        }
    }
}

/// What [`convert`] wrote.
#[derive(Clone, Debug, Default)]
pub struct ConvertReport {
    /// The files.
    pub written: Written,
    /// Tensors of another type than before.
    pub num_converted: usize,
    /// Numbers that are not what they were, by rounding.
    pub num_rounded: u64,
    /// The largest difference between a number and what it was.
    pub largest_error: f32,
    /// Where that is.
    pub largest_error_in: Option<String>,
    /// The largest difference over the number's own size.
    pub largest_relative_error: f32,
    /// The embodiments that are kept; none if nothing was asked.
    pub embodiment_ids: Option<Vec<usize>>,
    /// Bytes that are zero now, of the embodiments that are not kept.
    pub zeroed_bytes: u64,
    /// Bytes of all tensors before, those left out included.
    pub bytes_before: u64,
    /// Bytes of all tensors now.
    pub bytes_after: u64,
}

/// Writes the checkpoint `source` to the directory `out`, changed as the options say. What they leave alone is copied bit for bit.
///
/// One piece of a tensor is in memory at a time. `progress(done, total)`, in bytes read, is called after each tensor; where it returns
/// false, nothing is written.
///
/// # Errors
/// As [`ActionHead::load`](crate::ActionHead::load); [`Error::Checkpoint`] for a finite number that the type cannot hold; [`Error::Input`]
/// for ids out of range, and if `out` is there and `force` is not given, holds anything but such a checkpoint, or is the source;
/// [`Error::Output`] if it cannot be written.
pub fn convert(
    source: &Path,
    out: &Path,
    options: &ConvertOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<ConvertReport> {
    let source = Source::open(source, options.rewrite.config.as_deref())?;
    let mut report = ConvertReport::default();
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
    let specs = tensor_specs(&source.config);
    let per_embodiment: BTreeSet<String> = specs
        .iter()
        .filter(|spec| spec.per_embodiment)
        .map(|spec| format!("{}{}", source.prefix, spec.name))
        .collect();
    for name in source.checkpoint.names() {
        report.bytes_before += source.checkpoint.nbytes(name)?;
    }
    let mut planned = Vec::new();
    for name in source.names(&options.rewrite) {
        let mut tensor = source.as_it_is(name)?;
        if let Some((_, to)) = change(&source, name, options)? {
            tensor.dtype = to.dtype();
            report.num_converted += 1;
        }
        report.bytes_after += tensor.nbytes() as u64;
        planned.push(tensor);
    }
    let config = [("config.json", Some(source.given_config.as_str()))];
    let mut rounding = Rounding::default();
    let mut zeroed_bytes = 0;
    report.written = source.write(out, &rewrite, &config, planned, &mut progress, |name, writer| {
        let change = change(&source, name, options)?;
        let nbytes = source.checkpoint.nbytes(name)?;
        let slices = match &kept {
            Some(kept) if per_embodiment.contains(name) => {
                let slice = nbytes / source.config.num_embodiments as u64;
                let ids = 0..source.config.num_embodiments;
                ids.map(|id| (kept.contains(&id), slice)).collect()
            }
            _ => vec![(true, nbytes)],
        };
        let mut start = 0;
        for (is_kept, nbytes) in slices {
            if is_kept {
                source
                    .checkpoint
                    .read_byte_range(name, start..start + nbytes, |bytes| match change {
                        None => Ok(writer.tensor(name, bytes)?),
                        Some((from, to)) => rounding.write(name, bytes, from, to, writer),
                    })?;
            } else {
                let nbytes = change.map_or(nbytes, |(from, to)| {
                    nbytes * to.dtype().bitsize() as u64 / from.dtype().bitsize() as u64
                });
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

/// What type tensor `name` has and gets, if another.
fn change(source: &Source, name: &str, options: &ConvertOptions) -> Result<Option<(Float, Float)>> {
    let from = Float::of(source.checkpoint.dtype(name)?);
    let is_scale = name
        .strip_suffix(SCALE_SUFFIX)
        .is_some_and(|scaled| matches!(source.checkpoint.dtype(scaled), Ok(Dtype::I8)));
    Ok(from
        .zip(options.dtype)
        .filter(|(from, to)| from != to && !is_scale))
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
        from: Float,
        to: Float,
        writer: &mut CheckpointWriter,
    ) -> Result<()> {
        from.read(bytes, &mut self.values);
        for &value in self.values.iter().filter(|value| value.is_finite()) {
            let rounded = to.round(value);
            if rounded == value {
                continue;
            }
            if !rounded.is_finite() {
                return Err(Error::Checkpoint(format!(
                    "source: {name} holds {value}, more than {:?} can: expected another dtype",
                    to.dtype()
                )));
            }
            let error = (rounded - value).abs();
            self.count += 1;
            self.largest_relative = self.largest_relative.max(error / value.abs());
            if error > self.largest {
                self.largest = error;
                self.largest_in = Some(name.to_owned());
            }
        }
        to.write(&self.values, &mut self.bytes);
        Ok(writer.tensor(name, &self.bytes)?)
    }
}
