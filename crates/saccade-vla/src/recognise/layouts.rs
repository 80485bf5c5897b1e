//! The table of layouts: a new one is a file with its [`CheckpointLayout`] and a line here.

use saccade_vla_checkpoint::Checkpoint;

use super::layout::{CheckpointLayout, Clues};
use super::lerobot::{Fork, Lerobot};
use super::nvidia::{IsaacFineTune, Nvidia, Own};
use crate::config::WholeConfig;
use crate::error::{Error, Result};

/// Every layout. The first one that a checkpoint has is its own; the last one fits all.
static LAYOUTS: [&dyn CheckpointLayout; 5] = [&Fork, &Lerobot, &Own, &IsaacFineTune, &Nvidia];

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

/// What the names of the tensors of a backbone begin with, in the layouts that name them so.
const BACKBONES: [&str; 2] = ["backbone.", "_groot_model.backbone."];

/// What the names of the head's tensors begin with: empty if no layout's prefix is used.
///
/// # Errors
/// [`Error::Checkpoint`] if there are two heads in one checkpoint, or a backbone alone.
pub(super) fn head_prefix(checkpoint: &Checkpoint) -> Result<&'static str> {
    let mut used: Vec<&str> = Vec::new();
    for prefix in LAYOUTS.iter().filter_map(|layout| layout.prefix()) {
        if !used.contains(&prefix) && checkpoint.names().any(|name| name.starts_with(prefix)) {
            used.push(prefix);
        }
    }
    match used[..] {
        [] => {
            let is_backbone = |name: &str| BACKBONES.iter().any(|prefix| name.starts_with(prefix));
            match checkpoint.names().next() {
                Some(first) if checkpoint.names().all(is_backbone) => Err(Error::Checkpoint(format!(
                    "source: there is no action head among the {} tensors, such as {first}: this is a backbone alone",
                    checkpoint.names().count()
                ))),
                _ => Ok(""),
            }
        }
        [prefix] => Ok(prefix),
        [first, second, ..] => Err(Error::Checkpoint(format!(
            "source: two heads in one checkpoint, under `{first}` and `{second}`"
        ))),
    }
}
