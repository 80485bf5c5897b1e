//! GR00T N1.7.

use saccade_vla_kernels::WeightRounding;

use super::backbone::{BackboneRules, Names, TowerKind};
use super::head::Feature::{AlternatingBlocks, ContextWidth, StateHistory, VlNorm, VlSelfAttention};
use super::head::HeadRules;
use super::processor::{
    COMMON_ARGUMENTS, Fitting, Flexible, IsaacFile, PIXEL_LIMITS, Pixels, Preprocessing, ProcessorRules,
    PromptRules, QWEN_VIEW, ViewRules, Wording,
};
use super::row::{LerobotRules, LerobotStep, Release};

pub(super) static N17: Release = Release {
    name: "n1.7",
    model_type: "Gr00tN1d7",
    head: HeadRules {
        features: &[
            ContextWidth,
            VlNorm,
            VlSelfAttention,
            AlternatingBlocks,
            StateHistory,
        ],
        is_flat: true,
        sizes: &[
            ("max_state_dim", 132),
            ("max_action_dim", 132),
            ("action_horizon", 40),
            ("num_inference_timesteps", 4),
            ("backbone_embedding_dim", 2048),
        ],
    },
    backbone: Some(BackboneRules {
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
    }),
    processor: Some(ProcessorRules {
        tokenizers: &["nvidia/Cosmos-Reason2-2B", "Qwen/Qwen3-VL-2B-Instruct"],
        tokenizer_files: &["tokenizer.json", PIXEL_LIMITS],
        max_positions: 262_144,
        default_preprocessing: Preprocessing::Isaac,
        isaac_file: Some(IsaacFile {
            class: "Gr00tN1d7Processor",
            arguments: &[
                &COMMON_ARGUMENTS,
                &[
                    "exclude_state",
                    "letter_box_transform",
                    "state_dropout_prob",
                    "tactile_embed_dim",
                    "tactile_input_shape",
                    "tactile_state_keys",
                    "use_mean_std",
                    "use_tactile",
                ],
            ],
        }),
        prompt: PromptRules {
            template: "<|im_start|>user\n{views}{text}<|im_end|>\n",
            view: QWEN_VIEW,
            wording: Wording::Formalized,
            default_instruction: None,
            has_placeholders: false,
        },
        views: ViewRules::Flexible(Flexible {
            patch_size: 16,
            merge: 2,
            pixels: Pixels::Patches { frames: 2 },
            rounding: WeightRounding::Torch,
            fitting: Fitting::OfFrame,
            areas: (1 << 16, 1 << 24),
            file_edge: 256,
            file_has_bars: false,
        }),
    }),
    lerobot: Some(LerobotRules {
        action_horizon: 40,
        padded_to: Some(132),
        has_view_sizes: true,
        steps: &[
            LerobotStep {
                name: "groot_n1_7_pack_inputs_v1",
                keys: &[
                    "action_horizon",
                    "clip_outliers",
                    "embodiment_mapping",
                    "embodiment_tag",
                    "formalize_language",
                    "language_key",
                    "max_action_dim",
                    "max_state_dim",
                    "modality_config",
                    "normalize_min_max",
                    "raw_stats",
                    "state_dropout_prob",
                    "state_horizon",
                    "training",
                    "use_percentiles",
                    "valid_action_horizon",
                    "video_horizon",
                    "video_modality_keys",
                ],
                fits_views: false,
            },
            LerobotStep {
                name: "groot_n1_7_vlm_encode_v1",
                keys: &[
                    "crop_fraction",
                    "device",
                    "image_crop_size",
                    "image_target_size",
                    "letter_box_transform",
                    "model_name",
                    "shortest_image_edge",
                    "training",
                    "use_albumentations",
                ],
                fits_views: true,
            },
        ],
    }),
};
