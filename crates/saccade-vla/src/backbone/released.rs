//! The releases of the backbone: what each is called in a checkpoint, what its classes do, and the sizes it was published with.

use super::config::{PatchOrder, PixelOrder};
use crate::config::Version;

/// A release.
pub(crate) struct Release {
    pub version: Version,
    pub names: Names,
    /// Its sizes, in the keys of `config.json`.
    pub sizes: &'static str,
    pub tower: TowerKind,
    pub has_final_norm: bool,
}

/// What the parts are called in a checkpoint, below the prefix of the backbone.
#[derive(Clone, Copy)]
pub(crate) struct Names {
    pub vision: &'static str,
    /// Behind the tower; none if it is a part of it.
    pub connector: Option<&'static str>,
    pub language: &'static str,
    /// The twin of the embedding table.
    pub lm_head: &'static str,
    /// The last layer, if `project_to_dim` asks for one.
    pub projection: &'static str,
}

/// The tower of a release, before its sizes are known.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum TowerKind {
    Siglip {
        pixels: PixelOrder,
        patches: PatchOrder,
        /// Whether all views have the size of the table of positions.
        is_fixed: bool,
    },
    Qwen3Vl,
}

/// Every release.
static RELEASES: [Release; 3] = [
    Release {
        version: Version::N15,
        names: Names {
            vision: "eagle_model.vision_model.vision_model",
            connector: Some("eagle_model.mlp1"),
            language: "eagle_model.language_model.model",
            lm_head: "eagle_model.language_model.lm_head",
            projection: "eagle_linear",
        },
        sizes: r#"{
            "select_layer": 12, "project_to_dim": null,
            "eagle": {"use_pixel_shuffle": false, "downsample_ratio": 0.5, "mlp_connector_layers": 1, "select_layer": -1,
                "image_token_index": 151669},
            "vision_config": {"hidden_size": 1152, "intermediate_size": 4304, "num_hidden_layers": 27, "num_attention_heads": 16,
                "image_size": 224, "patch_size": 14, "layer_norm_eps": 1e-6},
            "text_config": {"hidden_size": 2048, "intermediate_size": 6144, "num_attention_heads": 16, "num_key_value_heads": 8,
                "head_dim": 128, "vocab_size": 151680, "rms_norm_eps": 1e-6, "rope_theta": 1e6}
        }"#,
        tower: TowerKind::Siglip {
            pixels: PixelOrder::ChannelFirst,
            patches: PatchOrder::PatchFirst,
            is_fixed: true,
        },
        has_final_norm: true,
    },
    Release {
        version: Version::N16,
        names: Names {
            vision: "model.vision_model.vision_model",
            connector: Some("model.mlp1"),
            language: "model.language_model.model",
            lm_head: "model.language_model.lm_head",
            projection: "eagle_linear",
        },
        sizes: r#"{
            "select_layer": 16, "project_to_dim": null,
            "eagle": {"use_pixel_shuffle": true, "downsample_ratio": 0.5, "mlp_connector_layers": 2, "select_layer": -1,
                "image_token_index": 151669},
            "vision_config": {"hidden_size": 1152, "intermediate_size": 4304, "num_hidden_layers": 27, "num_attention_heads": 16,
                "num_patches": 256, "patch_size": 14, "layer_norm_eps": 1e-6},
            "text_config": {"hidden_size": 2048, "intermediate_size": 6144, "num_attention_heads": 16, "num_key_value_heads": 8,
                "head_dim": 128, "vocab_size": 151680, "rms_norm_eps": 1e-6, "rope_theta": 1e6}
        }"#,
        tower: TowerKind::Siglip {
            pixels: PixelOrder::ChannelLast,
            patches: PatchOrder::PatchLast,
            is_fixed: false,
        },
        has_final_norm: true,
    },
    Release {
        version: Version::N17,
        names: Names {
            vision: "model.model.visual",
            connector: None,
            language: "model.model.language_model",
            lm_head: "model.lm_head",
            projection: "eagle_linear",
        },
        sizes: r#"{
            "select_layer": 16, "project_to_dim": null,
            "token_ids": {"image_token_id": 151655},
            "vision_config": {"hidden_size": 1024, "intermediate_size": 4096, "depth": 24, "num_heads": 16, "patch_size": 16,
                "temporal_patch_size": 2, "spatial_merge_size": 2, "num_position_embeddings": 2304,
                "deepstack_visual_indexes": [5, 11, 17]},
            "text_config": {"hidden_size": 2048, "intermediate_size": 6144, "num_attention_heads": 16, "num_key_value_heads": 8,
                "head_dim": 128, "vocab_size": 151936, "rms_norm_eps": 1e-6, "rope_theta": 5e6,
                "rope_scaling": {"mrope_interleaved": true, "mrope_section": [24, 20, 20], "rope_type": "default"}}
        }"#,
        tower: TowerKind::Qwen3Vl,
        has_final_norm: false,
    },
];

impl Release {
    /// Every release, in their order.
    pub(crate) fn all() -> impl Iterator<Item = &'static Self> {
        RELEASES.iter()
    }

    /// What the names of all tensors of the vision tower or of the language model begin with.
    pub(crate) fn marks(&self) -> [String; 2] {
        [self.names.vision, self.names.language].map(|name| format!("{name}."))
    }
}
