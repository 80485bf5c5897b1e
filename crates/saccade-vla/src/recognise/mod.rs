//! What a checkpoint is: its layout, the version of the architecture, and the head's whole config, from
//! `config.json` and from the tensors.
//!
//! Every command and [`ActionHead::load`](crate::ActionHead::load) start here. Sizes that published configs
//! leave out are taken from the shapes of the tensors. Where config and tensors disagree, one error lists
//! everything.

mod evidence;
mod layout;
mod lerobot;
pub(crate) mod sizes;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::OnceLock;

use saccade_vla_checkpoint::{Checkpoint, directory_of, read_text};
use serde_json::Value;

use crate::config::{CheckpointConfig, HeadConfig};
use crate::error::{Error, Result, ensure, problem};
use evidence::recognise_version;
pub(crate) use layout::BACKBONE_PREFIXES;
use layout::{Contents, LAYOUTS, layout_of};
use sizes::HeadShapes;

/// A checkpoint, open, and what it is.
pub struct HeadCheckpoint {
    /// Its tensors.
    pub checkpoint: Checkpoint,
    /// What the names of the head's tensors begin with.
    pub prefix: &'static str,
    /// Who wrote it: `nvidia`, `isaac` (Isaac-GR00T's trainer), `lerobot`, `fork` (lerobot's, with several
    /// action decoders) or `saccade` (a head alone).
    pub layout: &'static str,
    /// The head's sizes and switches.
    pub config: HeadConfig,
    /// The same in the released key names, as JSON: [`HeadConfig::from_json`] needs nothing else.
    pub config_json: String,
    /// The config as it was given, or as `config.json` has it.
    pub given_config: String,
    /// The evidence for the version, a sentence each.
    pub evidence: Vec<String>,
    /// The shapes of the head's tensors by their names without the prefix, once one was needed.
    pub(crate) shapes: OnceLock<BTreeMap<String, Vec<usize>>>,
}

impl HeadCheckpoint {
    /// Opens `source`, one `.safetensors` file or a directory of them, with `config`, as JSON, or the
    /// `config.json` next to the weights.
    ///
    /// The names and shapes of single tensors are checked where they are read.
    ///
    /// # Errors
    /// [`Error::File`] for a path or a config that is not there and for broken files; [`Error::Checkpoint`]
    /// for a config that is not one, and for everything that config and tensors disagree on, in one list.
    pub fn open(source: &Path, config: Option<&str>) -> Result<Self> {
        Self::of(Checkpoint::open(source)?, source, config)
    }

    /// The same of the open `checkpoint` at `source`.
    pub(crate) fn of(checkpoint: Checkpoint, source: &Path, config: Option<&str>) -> Result<Self> {
        let directory = directory_of(source);
        let path = directory.join("config.json");
        let given_config = match config {
            Some(text) => text.to_owned(),
            None => read_text("config", &path)?,
        };
        let prefix = head_prefix(&checkpoint)?;
        let config = CheckpointConfig::parse(&given_config).map_err(|error| match config {
            Some(_) => error,
            None => error.in_file(&path),
        })?;
        let contents = Contents {
            has_head_config: !lerobot::is_without_head(&config)?,
            config: &config,
            tensors: HeadShapes {
                checkpoint: &checkpoint,
                prefix,
            },
            directory,
        };
        let (version, evidence) = recognise_version(&contents)?;
        let (head, problems) = match contents.has_head_config {
            true => sizes::complete(config.head(), version, &contents.tensors),
            false => (lerobot::head_config(&contents, version)?, Vec::new()),
        };
        let config_json = Value::Object(head).to_string();
        // What is wrong with the config alone comes first.
        let head = HeadConfig::from_json(&config_json)?;
        ensure!(
            problems.is_empty(), Checkpoint, "source";
            "config and tensors disagree (GR00T {}):\n  {}", version, problems.join("\n  ")
        );
        Ok(Self {
            config: head,
            config_json,
            layout: layout_of(&contents).name,
            prefix,
            given_config,
            evidence,
            checkpoint,
            shapes: OnceLock::new(),
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

/// What the names of the head's tensors begin with: empty if no layout's prefix is used.
///
/// # Errors
/// [`Error::Checkpoint`] if there are two heads in one checkpoint, or a backbone alone.
fn head_prefix(checkpoint: &Checkpoint) -> Result<&'static str> {
    let mut used: Vec<&str> = Vec::new();
    for prefix in LAYOUTS.iter().filter_map(|layout| layout.prefix) {
        if !used.contains(&prefix) && checkpoint.names().any(|name| name.starts_with(prefix)) {
            used.push(prefix);
        }
    }
    match used[..] {
        [] => {
            let is_backbone = |name: &str| {
                let mut prefixes = BACKBONE_PREFIXES.iter().filter(|prefix| !prefix.is_empty());
                prefixes.any(|prefix| name.starts_with(prefix))
            };
            match checkpoint.names().next() {
                Some(first) if checkpoint.names().all(is_backbone) => Err(Error::Checkpoint(problem!(
                    "source";
                    "there is no action head among the {} tensors, such as {first}: this is a backbone alone",
                    checkpoint.names().count()
                ))),
                _ => Ok(""),
            }
        }
        [prefix] => Ok(prefix),
        [first, second, ..] => Err(Error::Checkpoint(problem!(
            "source"; "two heads in one checkpoint, under `{first}` and `{second}`"
        ))),
    }
}

/// The metadata key of the embodiments that were kept when others were removed.
pub(crate) const KEPT_EMBODIMENTS: &str = "saccade_embodiment_ids";

/// The embodiments whose layers were kept when others were removed; none if all are there.
///
/// # Errors
/// [`Error::Checkpoint`] if the files' metadata list anything but numbers.
pub(crate) fn kept_embodiments(checkpoint: &Checkpoint) -> Result<Option<Vec<i64>>> {
    let Some(listed) = checkpoint.metadata().get(KEPT_EMBODIMENTS) else {
        return Ok(None);
    };
    let ids: std::result::Result<_, _> = listed.split(',').map(str::parse).collect();
    ids.map(Some).map_err(|_| {
        Error::Checkpoint(problem!(
            "source"; "{KEPT_EMBODIMENTS} in the metadata is `{listed}`, expected numbers with commas between them"
        ))
    })
}
