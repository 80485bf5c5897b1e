//! Writing a checkpoint from another: opening the source, choosing what is kept, writing the copy.

mod adapter;
mod convert;
mod float;
mod json_edit;
mod quantize;
mod quantized;
mod resize;
mod rounding;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::{Checkpoint, CheckpointWriter, Companions, PlannedTensor};

use crate::config::HeadConfig;
use crate::error::{Error, Problem, Result, ensure};
use crate::ops::check_interrupted;
use adapter::is_beside;

pub use adapter::open_base;
pub use convert::{ConvertOptions, ConvertReport, convert};
pub use float::Float;
pub use quantize::{QuantizeReport, QuantizedWeights, quantize, quantized_weights};
pub use resize::{MergedTokens, ResizeOptions, ResizeReport, merge_future_tokens, resize, resized_config};
pub use rounding::{Rounded, RoundedLayer, RoundingErrors, gptq, round_layer};

/// Published checkpoints are cut into files of this size.
const MAX_SHARD_BYTES: u64 = 5_000_000_000;

/// How a checkpoint is written from another.
#[derive(Clone, Debug, Default)]
pub struct RewriteOptions {
    /// The source's config as JSON; default the `config.json` next to the weights.
    pub config: Option<String>,
    /// Whether tensors outside the head's prefix, such as a backbone's, are left out; otherwise they are copied.
    pub head_only: bool,
    /// Whether [`quantize`](crate::quantize) copies the tensors of a backbone bit for bit, and quantises the head alone.
    pub keep_backbone: bool,
    /// Directories of layers that [`round_layer`](crate::round_layer) wrote, whose weights [`quantize`](crate::quantize) to int4 takes. It
    /// rounds the others plainly.
    pub rounded: Vec<PathBuf>,
    /// Whether to replace a checkpoint that exists.
    pub force: bool,
    /// Metadata of the files, added to the source's.
    pub metadata: BTreeMap<String, String>,
    /// The largest size of a file, unless a single tensor is larger. Default: no limit if the source is one file, otherwise 5 GB.
    pub max_shard_bytes: Option<u64>,
}

/// What was written.
#[derive(Clone, Debug, Default)]
pub struct Written {
    /// The files with tensors.
    pub files: Vec<PathBuf>,
    /// Files next to the weights that were copied, by their path in the directory.
    pub carried: Vec<PathBuf>,
    /// Files and folders next to the weights that were not copied: other weights, states of an optimizer, other checkpoints.
    pub left: Vec<PathBuf>,
    /// Tensors outside the head that were left out.
    pub num_dropped: usize,
}

/// An open checkpoint whose tensors fit its config.
pub(crate) struct SourceCheckpoint {
    path: PathBuf,
    pub checkpoint: Checkpoint,
    pub prefix: &'static str,
    pub config: HeadConfig,
    /// The config as it was given, or as `config.json` has it.
    pub given_config: String,
    /// The directory of an adapter, whose other files are copied too.
    adapter: Option<PathBuf>,
}

/// Called with the bytes done and the bytes in all; false stops the work.
pub(crate) type Progress<'a> = &'a mut dyn FnMut(u64, u64) -> bool;

impl SourceCheckpoint {
    /// # Errors
    /// As [`ActionHead::load`](crate::ActionHead::load).
    pub(crate) fn open(path: &Path, config: Option<&str>) -> Result<Self> {
        Self::open_base(path, config, None)
    }

    /// As [`SourceCheckpoint::open`], for the base of the adapter in a directory.
    ///
    /// # Errors
    /// As [`ActionHead::load`](crate::ActionHead::load).
    pub(crate) fn open_base(path: &Path, config: Option<&str>, adapter: Option<&Path>) -> Result<Self> {
        let published = open_base(path, config, adapter)?;
        published.check()?;
        Ok(Self {
            path: path.to_owned(),
            checkpoint: published.checkpoint,
            prefix: published.prefix,
            config: published.config,
            given_config: published.given_config,
            adapter: adapter.map(Path::to_owned),
        })
    }

    /// The tensors that are kept, sorted by name.
    pub(crate) fn names(&self, options: &RewriteOptions) -> Vec<&str> {
        let is_kept = |name: &&str| !options.head_only || self.is_head(name);
        self.checkpoint.names().filter(is_kept).collect()
    }

    /// Whether a tensor is the head's.
    pub(crate) fn is_head(&self, name: &str) -> bool {
        name.starts_with(self.prefix)
    }

    /// Tensor `name` as it is stored.
    pub(crate) fn as_it_is(&self, name: &str) -> Result<PlannedTensor> {
        Ok(PlannedTensor {
            name: name.to_owned(),
            dtype: self.checkpoint.dtype(name)?,
            shape: self.shape(name).to_vec(),
        })
    }

    pub(crate) fn shape(&self, name: &str) -> &[usize] {
        let shape = self.checkpoint.shape(name);
        shape.expect("the name is one of the checkpoint's")
    }

    /// Copies tensor `name` bit for bit.
    pub(crate) fn copy(&self, name: &str, writer: &mut CheckpointWriter) -> Result<()> {
        self.checkpoint.read_bytes(name, |bytes| {
            check_interrupted()?;
            Ok(writer.tensor(name, bytes)?)
        })
    }

    /// The other files next to the source's weights that are copied to `out`, without those of these names.
    fn companions<'a>(&self, out: &Path, without: impl Iterator<Item = &'a str>) -> Result<Companions> {
        let files = self.checkpoint.files().chain(self.adapter.as_deref());
        check_apart(&self.path, files, out)?;
        let mut companions = Companions::of(&self.path, self.checkpoint.files())?;
        if let Some(adapter) = &self.adapter {
            let beside = is_beside(&self.path, adapter);
            companions = companions.with_adapter(adapter, beside)?;
        }
        for name in without {
            companions = companions.without(name);
        }
        Ok(companions)
    }

    /// Checks that [`write`](Self::write) may write to `out`, before work that takes long.
    ///
    /// # Errors
    /// Those of [`write`](Self::write) that can be known.
    pub(crate) fn check_out(&self, out: &Path, force: bool) -> Result<()> {
        let companions = self.companions(out, std::iter::empty())?;
        CheckpointWriter::create(out, Vec::new(), &BTreeMap::new(), &companions, u64::MAX, force)?;
        Ok(())
    }

    /// Writes a checkpoint to the directory `out`: the `small` files by name and contents (`config.json` is one), the other files next to the
    /// source's weights, and the `planned` tensors, by calling `write` for each tensor that is kept.
    ///
    /// # Errors
    /// [`Error::Input`] and [`Error::File`] if `out` exists and `force` is not given, holds anything but such a checkpoint, or is the source, if
    /// it cannot be written, and if `progress` stops the work.
    pub(crate) fn write(
        &self,
        out: &Path,
        options: &RewriteOptions,
        small: &[(&str, Option<&str>)],
        planned: Vec<PlannedTensor>,
        progress: Progress<'_>,
        mut write: impl FnMut(&str, &mut CheckpointWriter) -> Result<()>,
    ) -> Result<Written> {
        let companions = self.companions(out, small.iter().map(|(name, _)| *name))?;
        let default = match self.checkpoint.files().count() {
            1 => u64::MAX,
            _ => MAX_SHARD_BYTES,
        };
        let mut metadata = self.checkpoint.metadata().clone();
        metadata.extend(options.metadata.clone());
        let mut writer = CheckpointWriter::create(
            out,
            planned,
            &metadata,
            &companions,
            options.max_shard_bytes.unwrap_or(default),
            options.force,
        )?;
        for (name, contents) in small {
            if let Some(contents) = contents {
                writer.file(name, contents)?;
            }
        }
        let names = self.names(options);
        let (mut done, mut total) = (0, 0);
        for name in &names {
            total = u64::saturating_add(total, self.checkpoint.nbytes(name)?);
        }
        for name in &names {
            write(name, &mut writer)?;
            done = u64::saturating_add(done, self.checkpoint.nbytes(name)?);
            if !progress(done, total) {
                return Err(Error::Input(Problem::from(
                    "stopped; nothing was written".to_owned(),
                )));
            }
        }
        Ok(Written {
            files: writer.finish()?.into_iter().map(|file| out.join(file)).collect(),
            carried: companions.all_paths().into_iter().collect(),
            left: companions.left().to_vec(),
            num_dropped: self.checkpoint.names().count() - names.len(),
        })
    }
}

/// That neither the source nor a file that it links to is in what would be replaced.
fn check_apart<'a>(source: &'a Path, files: impl Iterator<Item = &'a Path>, out: &Path) -> Result<()> {
    // Of what is not a directory the writer says so.
    let Some(to) = out.canonicalize().ok().filter(|to| to.is_dir()) else {
        return Ok(());
    };
    let is_inside = |path: &Path| path.canonicalize().is_ok_and(|from| from.starts_with(&to));
    ensure!(
        !std::iter::once(source).chain(files).any(is_inside), Input, "out";
        "{} holds the source, expected another directory", out.display()
    );
    Ok(())
}
