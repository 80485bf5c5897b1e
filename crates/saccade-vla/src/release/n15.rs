//! GR00T N1.5.

use super::backbone::{BackboneRules, Names, PatchOrder, PixelOrder, TowerKind};
use super::head::Feature::{ContextWidth, FutureTokens, SeveralDecoders, VlNorm, VlSelfAttention};
use super::head::HeadRules;
use super::processor::{
    EAGLE_VIEW, Preprocessing, ProcessorRules, PromptRules, SLOW_TOKENIZER, ViewRules, Wording,
};
use super::row::{LerobotRules, LerobotStep, Release};

pub(super) static N15: Release = Release {
    name: "n1.5",
    model_type: "gr00t_n1_5",
    head: HeadRules {
        features: &[
            ContextWidth,
            FutureTokens,
            SeveralDecoders,
            VlNorm,
            VlSelfAttention,
        ],
        is_flat: false,
        sizes: &[("backbone_embedding_dim", 1536), ("num_target_vision_tokens", 32)],
    },
    backbone: Some(BackboneRules {
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
    }),
    processor: Some(ProcessorRules {
        tokenizers: &["lerobot/eagle2hg-processor-groot-n1p5"],
        tokenizer_files: &SLOW_TOKENIZER,
        max_positions: 40_960,
        default_preprocessing: Preprocessing::Lerobot,
        isaac_file: None,
        prompt: PromptRules {
            template: "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n\
                       <|im_start|>user\n{views}{text}<|im_end|>\n<|im_start|>assistant\n",
            view: EAGLE_VIEW,
            wording: Wording::List,
            default_instruction: Some("Perform the default behavior."),
            has_placeholders: true,
        },
        views: ViewRules::Square {
            size: 224,
            patch_size: 14,
        },
    }),
    lerobot: Some(LerobotRules {
        action_horizon: 16,
        padded_to: None,
        has_view_sizes: false,
        steps: &[
            LerobotStep {
                name: "groot_pack_inputs_v3",
                keys: &[
                    "action_horizon",
                    "embodiment_mapping",
                    "embodiment_tag",
                    "formalize_language",
                    "language_key",
                    "max_action_dim",
                    "max_state_dim",
                    "normalize_min_max",
                    "state_horizon",
                ],
                fits_views: false,
            },
            LerobotStep {
                name: "groot_eagle_encode_v3",
                keys: &["tokenizer_assets_repo"],
                fits_views: false,
            },
            LerobotStep {
                name: "groot_eagle_collate_v3",
                keys: &["tokenizer_assets_repo"],
                fits_views: false,
            },
        ],
    }),
};
