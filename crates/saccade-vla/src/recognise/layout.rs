//! What a layout of checkpoints is: who writes them, where the head is in them, and where its sizes come
//! from.

use std::path::Path;

use super::sizes::{self, HeadShapes};
use crate::config::{CheckpointConfig, Object};
use crate::error::Result;
use crate::release::Version;

/// The beginnings of the names of a backbone's tensors: in lerobot's checkpoints, in NVIDIA's, and of a
/// backbone alone.
pub(crate) const BACKBONE_PREFIXES: [&str; 3] = ["_groot_model.backbone.", "backbone.", ""];

/// What is known about a checkpoint before its version is recognised.
pub(super) struct Contents<'a> {
    pub config: &'a CheckpointConfig,
    /// Whether the config holds the head's.
    pub has_head_config: bool,
    pub tensors: HeadShapes<'a>,
    /// The directory of the weights.
    pub directory: &'a Path,
}

/// Something that only some versions have.
pub(super) struct Evidence {
    pub versions: Vec<Version>,
    pub what: String,
}

/// How one program writes checkpoints.
pub(super) trait CheckpointLayout: Sync {
    /// Its name in [`HeadCheckpoint::layout`](super::HeadCheckpoint::layout).
    fn name(&self) -> &'static str;

    /// What the names of the head's tensors begin with, if it is always the same.
    fn prefix(&self) -> Option<&'static str>;

    /// Whether a checkpoint is written so.
    fn matches(&self, contents: &Contents<'_>) -> bool;

    /// Whether a config is written so and holds no head, whose sizes must then come from elsewhere.
    ///
    /// # Errors
    /// [`Error::Checkpoint`](crate::Error::Checkpoint) for a config of another kind of policy.
    fn is_without_head(&self, _config: &CheckpointConfig) -> Result<bool> {
        Ok(false)
    }

    /// Adds what the layout says about the version.
    fn add_evidence(&self, _clues: &Contents<'_>, _found: &mut Vec<Evidence>) {}

    /// The head's config in the released keys, and everything that it and the tensors disagree on.
    ///
    /// # Errors
    /// [`Error::Checkpoint`](crate::Error::Checkpoint) if there is no head's config, and the tensors do not
    /// make one.
    fn head_config(&self, contents: &Contents<'_>, version: Version) -> Result<(Object, Vec<String>)> {
        Ok(sizes::complete(
            contents.config.head(),
            version,
            &contents.tensors,
        ))
    }
}
