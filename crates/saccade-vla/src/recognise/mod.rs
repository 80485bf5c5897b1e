//! What a checkpoint is: its layout, the version of the architecture, and the head's whole config, from `config.json` and from the tensors.
//!
//! Every command and [`ActionHead::load`](crate::ActionHead::load) start here. Sizes that published configs leave out are taken from the
//! shapes of the tensors. Where config and tensors disagree, one error lists everything.

mod evidence;
pub(crate) mod kept;
mod layout;
mod layouts;
mod lerobot;
mod nvidia;
pub(crate) mod sizes;

use std::path::Path;

use saccade_vla_checkpoint::{Checkpoint, read_text};
use serde_json::Value;

use crate::config::{HeadConfig, WholeConfig};
use crate::error::{Error, Result};
use evidence::recognise_version;
use kept::kept_embodiments;
use layout::Clues;
use layouts::{has_head_config, head_prefix, layout_of};
use sizes::HeadShapes;

/// A checkpoint, open, and what it is.
pub struct Published {
    /// Its tensors.
    pub checkpoint: Checkpoint,
    /// What the names of the head's tensors begin with.
    pub prefix: &'static str,
    /// Who wrote it: `nvidia`, `isaac` (Isaac-GR00T's trainer), `lerobot`, `fork` (lerobot's, with several action decoders) or `saccade` (a
    /// head alone).
    pub layout: &'static str,
    /// The head's sizes and switches.
    pub config: HeadConfig,
    /// The same in the released key names, as JSON: [`HeadConfig::from_json`] needs nothing else.
    pub config_json: String,
    /// The config as it was given, or as `config.json` has it.
    pub given_config: String,
    /// The evidence for the version, a sentence each.
    pub evidence: Vec<String>,
}

impl Published {
    /// Opens `source`, one `.safetensors` file or a directory of them, with `config`, as JSON, or the `config.json` next to the weights.
    ///
    /// The names and shapes of single tensors are checked where they are read.
    ///
    /// # Errors
    /// [`Error::File`] for a path or a config that is not there and for broken files; [`Error::Checkpoint`] for a config that is not one, and
    /// for everything that config and tensors disagree on, in one list.
    pub fn open(source: &Path, config: Option<&str>) -> Result<Self> {
        Self::of(Checkpoint::open(source)?, source, config)
    }

    /// The same of the open `checkpoint` at `source`.
    pub(crate) fn of(checkpoint: Checkpoint, source: &Path, config: Option<&str>) -> Result<Self> {
        let directory = match source.is_dir() {
            true => source,
            false => source.parent().unwrap_or(Path::new("")),
        };
        let path = directory.join("config.json");
        let given_config = match config {
            Some(text) => text.to_owned(),
            None => read_text("config", &path)?,
        };
        let prefix = head_prefix(&checkpoint)?;
        let config = WholeConfig::parse(&given_config).map_err(|error| match config {
            Some(_) => error,
            None => error.in_file(&path),
        })?;
        let clues = Clues {
            has_head_config: has_head_config(&config)?,
            config: &config,
            tensors: HeadShapes {
                checkpoint: &checkpoint,
                prefix,
            },
            directory,
        };
        let layout = layout_of(&clues);
        let (version, evidence) = recognise_version(&clues, layout)?;
        let (head, problems) = layout.head_config(&clues, version)?;
        let config_json = Value::Object(head).to_string();
        // What is wrong with the config alone comes first.
        let head = HeadConfig::from_json(&config_json)?;
        if !problems.is_empty() {
            return Err(Error::Checkpoint(format!(
                "source: config and tensors disagree (GR00T {}):\n  {}",
                version.title(),
                problems.join("\n  ")
            )));
        }
        Ok(Self {
            config: head,
            config_json,
            layout: layout.name(),
            prefix,
            given_config,
            evidence,
            checkpoint,
        })
    }

    /// All tensors of the checkpoint, sorted by name; without those that are in two files, which [`Published::check`] refuses in a head.
    pub fn tensors(&self) -> impl Iterator<Item = TensorFacts> {
        let checkpoint = &self.checkpoint;
        checkpoint.names().filter_map(|name| {
            Some(TensorFacts {
                name: name.to_owned(),
                dtype: format!("{:?}", checkpoint.dtype(name).ok()?),
                shape: checkpoint.shape(name)?.to_vec(),
                nbytes: checkpoint.nbytes(name).ok()?,
            })
        })
    }

    /// The embodiments whose layers were kept when others were removed; none if all are there.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if the files' metadata list anything but numbers.
    pub fn kept_embodiments(&self) -> Result<Option<Vec<i64>>> {
        kept_embodiments(&self.checkpoint)
    }

    /// The files that tensors are read from.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.checkpoint.files()
    }
}

/// A tensor, by what its file's header says.
#[derive(Clone, Debug)]
pub struct TensorFacts {
    /// Its name, prefix included.
    pub name: String,
    /// Its type in the words of safetensors: `F32`, `BF16`.
    pub dtype: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its bytes in the file.
    pub nbytes: u64,
}
