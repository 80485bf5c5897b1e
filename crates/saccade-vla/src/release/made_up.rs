//! GR00T N1.9, which nobody has released: what a new release adds, as the fifth recipe of CONTRIBUTING.md has
//! it.

use saccade_vla_kernels::WeightRounding;

use super::backbone::{BackboneRules, Names, PatchOrder, PixelOrder, TowerKind};
use super::head::Feature::{AlternatingBlocks, ContextWidth, FutureTokens, VlNorm};
use super::head::HeadRules;
use super::processor::{
    Fitting, Flexible, Pixels, Preprocessing, ProcessorRules, PromptRules, ViewRules, ViewTokens, Wording,
};
use super::row::Release;

pub(super) static N19: Release = Release {
    name: "n1.9",
    model_type: "Gr00tN1d9",
    head: HeadRules {
        // Features that no release has had together.
        features: &[ContextWidth, FutureTokens, VlNorm, AlternatingBlocks],
        is_flat: true,
        sizes: &[
            ("max_state_dim", 5),
            ("max_action_dim", 6),
            ("action_horizon", 4),
            ("num_inference_timesteps", 2),
            ("backbone_embedding_dim", 16),
            ("num_target_vision_tokens", 3),
        ],
    },
    backbone: Some(BackboneRules {
        names: Names {
            vision: "eyes",
            connector: Some("bridge"),
            language: "words",
            lm_head: "lm_head",
            projection: "projection",
        },
        sizes: r#"{
            "select_layer": 1, "project_to_dim": null,
            "eagle": {"use_pixel_shuffle": true, "downsample_ratio": 0.5, "mlp_connector_layers": 2, "select_layer": -1,
                "image_token_index": 425},
            "vision_config": {"hidden_size": 8, "intermediate_size": 12, "num_hidden_layers": 1, "num_attention_heads": 2,
                "num_patches": 16, "patch_size": 4, "layer_norm_eps": 1e-6},
            "text_config": {"hidden_size": 16, "intermediate_size": 20, "num_attention_heads": 2, "num_key_value_heads": 1,
                "head_dim": 8, "vocab_size": 443, "rms_norm_eps": 1e-6, "rope_theta": 1e6}
        }"#,
        tower: TowerKind::Siglip {
            pixels: PixelOrder::ChannelLast,
            patches: PatchOrder::PatchFirst,
            is_fixed: false,
        },
        has_final_norm: false,
    }),
    processor: Some(ProcessorRules {
        tokenizers: &["nobody/n1d9"],
        tokenizer_files: &["tokenizer.json"],
        max_positions: 100,
        default_preprocessing: Preprocessing::Isaac,
        isaac_file: None,
        prompt: PromptRules {
            template: "<|im_start|>do {text} with{views}<|im_end|>",
            view: ViewTokens {
                is_numbered: true,
                start: "<|box_start|>",
                image: "<|fim_pad|>",
                end: "<|box_end|>",
            },
            wording: Wording::Formalized,
            default_instruction: Some("nothing"),
            has_placeholders: false,
        },
        views: ViewRules::Flexible(Flexible {
            patch_size: 4,
            merge: 2,
            pixels: Pixels::Planes,
            rounding: WeightRounding::Pillow,
            fitting: Fitting::OfFrame,
            areas: (64, 256),
            file_edge: 16,
            file_has_bars: false,
        }),
    }),
    lerobot: None,
};
