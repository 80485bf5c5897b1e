//! The layouts of checkpoints: who writes them, where the head is in them, and where its sizes come from.

use std::path::Path;

use saccade_checkpoint::Checkpoint;

use super::evidence::Evidence;
use super::lerobot::{Fork, Lerobot};
use super::nvidia::{IsaacFineTune, Nvidia, Own};
use super::sizes::{self, HeadShapes};
use crate::config::{Object, Version, WholeConfig};
use crate::error::{Error, Result};

/// Every layout. The first one that a checkpoint has is its own; the last one fits all.
static LAYOUTS: [&dyn CheckpointLayout; 5] = [&Fork, &Lerobot, &Own, &IsaacFineTune, &Nvidia];

/// What is known of a checkpoint before its version is.
pub(super) struct Clues<'a> {
    pub config: &'a WholeConfig,
    /// Whether the config holds the head's.
    pub has_head_config: bool,
    pub tensors: HeadShapes<'a>,
    /// The directory of the weights.
    pub directory: &'a Path,
}

/// How one program writes checkpoints.
pub(super) trait CheckpointLayout: Sync {
    /// Its name in [`Published::layout`](super::Published::layout).
    fn name(&self) -> &'static str;

    /// What the names of the head's tensors begin with, if it is always the same.
    fn prefix(&self) -> Option<&'static str>;

    /// Whether a checkpoint is written so.
    fn matches(&self, clues: &Clues<'_>) -> bool;

    /// Whether a config is written so and holds no head, whose sizes must then come from elsewhere.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] for a config of another kind of policy.
    fn is_without_head(&self, _config: &WholeConfig) -> Result<bool> {
        Ok(false)
    }

    /// Adds what the layout says about the version.
    fn add_evidence(&self, _clues: &Clues<'_>, _found: &mut Vec<Evidence>) {}

    /// The head's config in the released keys, and everything that it and the tensors disagree on.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if there is no head's config, and the tensors do not make one.
    fn head_config(&self, clues: &Clues<'_>, version: Version) -> Result<(Object, Vec<String>)> {
        Ok(sizes::complete(clues.config.head(), version, &clues.tensors))
    }
}

/// The layout of a checkpoint.
pub(super) fn layout_of(clues: &Clues<'_>) -> &'static dyn CheckpointLayout {
    let [.., last] = LAYOUTS;
    let found = LAYOUTS.into_iter().find(|layout| layout.matches(clues));
    found.unwrap_or(last)
}

/// Whether a config holds a head's.
///
/// # Errors
/// [`Error::Checkpoint`] for a config of another kind of policy.
pub(super) fn has_head_config(config: &WholeConfig) -> Result<bool> {
    for layout in LAYOUTS {
        if layout.is_without_head(config)? {
            return Ok(false);
        }
    }
    Ok(true)
}

/// What the names of the head's tensors begin with: empty if no layout's prefix is used.
///
/// # Errors
/// [`Error::Checkpoint`] if there are two heads in one checkpoint.
pub(super) fn head_prefix(checkpoint: &Checkpoint) -> Result<&'static str> {
    let mut used: Vec<&str> = Vec::new();
    for prefix in LAYOUTS.iter().filter_map(|layout| layout.prefix()) {
        if !used.contains(&prefix) && checkpoint.names().any(|name| name.starts_with(prefix)) {
            used.push(prefix);
        }
    }
    match used[..] {
        [] => Ok(""),
        [prefix] => Ok(prefix),
        [first, second, ..] => Err(Error::Checkpoint(format!(
            "source: two heads in one checkpoint, under `{first}` and `{second}`"
        ))),
    }
}
