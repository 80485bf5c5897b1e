//! The layouts of checkpoints: who writes them, how they are told apart, and where the head is in them.

use std::path::Path;

use super::sizes::HeadShapes;
use crate::config::CheckpointConfig;
use crate::release::Version;

/// The beginnings of the names of a backbone's tensors: in lerobot's checkpoints, in NVIDIA's, and of a
/// backbone alone.
pub(crate) const BACKBONE_PREFIXES: [&str; 3] = ["_groot_model.backbone.", "backbone.", ""];

/// What is known about a checkpoint before its version is recognised.
pub(super) struct Contents<'a> {
    pub config: &'a CheckpointConfig,
    /// Whether the config holds the head's; otherwise it is lerobot's.
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
pub(super) struct Layout {
    /// Its name in [`HeadCheckpoint::layout`](super::HeadCheckpoint::layout).
    pub name: &'static str,
    /// What the names of the head's tensors begin with, if it is always the same.
    pub prefix: Option<&'static str>,
    /// Whether a checkpoint of no layout before this one is written so.
    matches: fn(&Contents<'_>) -> bool,
}

/// What the names of the head's tensors begin with in lerobot's checkpoints.
const LEROBOT_PREFIX: &str = "_groot_model.action_head.";

/// Keys that a config of a whole model has.
const BACKBONE_KEYS: [&str; 3] = ["backbone_cfg", "backbone_model_type", "model_name"];

/// Every layout. The first one that a checkpoint has is its own; the last one fits all.
pub(super) static LAYOUTS: [Layout; 5] = [
    // lerobot's of a fork with several action decoders.
    Layout {
        name: "fork",
        prefix: Some(LEROBOT_PREFIX),
        matches: |contents| contents.tensors.has_several_decoders(),
    },
    Layout {
        name: "lerobot",
        prefix: Some(LEROBOT_PREFIX),
        matches: |contents| {
            contents.tensors.prefix == LEROBOT_PREFIX || contents.config.top().contains_key("type")
        },
    },
    // A head of saccade's own, or a head alone.
    Layout {
        name: "saccade",
        prefix: None,
        matches: |contents| {
            let top = contents.config.top();
            !BACKBONE_KEYS.iter().any(|key| top.contains_key(*key))
        },
    },
    // NVIDIA's with the files of Isaac-GR00T's trainer.
    Layout {
        name: "isaac",
        prefix: Some("action_head."),
        matches: |contents| contents.directory.join("trainer_state.json").is_file(),
    },
    // As NVIDIA publishes them.
    Layout {
        name: "nvidia",
        prefix: Some("action_head."),
        matches: |_| true,
    },
];

/// The layout of a checkpoint.
pub(super) fn layout_of(contents: &Contents<'_>) -> &'static Layout {
    let [.., last] = &LAYOUTS;
    let found = LAYOUTS.iter().find(|layout| (layout.matches)(contents));
    found.unwrap_or(last)
}
