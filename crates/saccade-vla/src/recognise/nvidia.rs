//! NVIDIA's checkpoints, as published and as Isaac-GR00T's trainer writes them, and heads alone, as saccade
//! writes them.

use super::layout::{CheckpointLayout, Contents};

/// NVIDIA's: `action_head.*` and `backbone.*`.
pub(super) struct Nvidia;

/// The same with the files of Isaac-GR00T's trainer.
pub(super) struct IsaacFineTune;

/// A head of saccade's own, or a head alone.
pub(super) struct Own;

/// Keys that a config of a whole model has.
const BACKBONE_KEYS: [&str; 3] = ["backbone_cfg", "backbone_model_type", "model_name"];

const PREFIX: &str = "action_head.";

impl CheckpointLayout for Nvidia {
    fn name(&self) -> &'static str {
        "nvidia"
    }

    fn prefix(&self) -> Option<&'static str> {
        Some(PREFIX)
    }

    fn matches(&self, contents: &Contents<'_>) -> bool {
        !Own.matches(contents)
    }
}

impl CheckpointLayout for IsaacFineTune {
    fn name(&self) -> &'static str {
        "isaac"
    }

    fn prefix(&self) -> Option<&'static str> {
        Some(PREFIX)
    }

    fn matches(&self, contents: &Contents<'_>) -> bool {
        Nvidia.matches(contents) && contents.directory.join("trainer_state.json").is_file()
    }
}

impl CheckpointLayout for Own {
    fn name(&self) -> &'static str {
        "saccade"
    }

    fn prefix(&self) -> Option<&'static str> {
        None
    }

    fn matches(&self, contents: &Contents<'_>) -> bool {
        let top = contents.config.top();
        !BACKBONE_KEYS.iter().any(|key| top.contains_key(*key))
    }
}
