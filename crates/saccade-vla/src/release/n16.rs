//! GR00T N1.6.

use saccade_vla_kernels::WeightRounding;

use super::backbone::{BackboneRules, Names, PatchOrder, PixelOrder, TowerKind};
use super::head::Feature::{AlternatingBlocks, ContextWidth, MaskToken, VlNorm};
use super::head::HeadRules;
use super::processor::{
    COMMON_ARGUMENTS, EAGLE_VIEW, Fitting, Flexible, IsaacFile, Pixels, Preprocessing, ProcessorRules,
    PromptRules, SLOW_TOKENIZER, ViewRules, Wording,
};
use super::row::Release;

pub(super) static N16: Release = Release {
    name: "n1.6",
    model_type: "Gr00tN1d6",
    head: HeadRules {
        features: &[ContextWidth, VlNorm, AlternatingBlocks, MaskToken],
        is_flat: true,
        sizes: &[
            ("max_state_dim", 29),
            ("max_action_dim", 29),
            ("action_horizon", 16),
            ("num_inference_timesteps", 4),
            ("backbone_embedding_dim", 2048),
        ],
    },
    backbone: Some(BackboneRules {
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
    }),
    processor: Some(ProcessorRules {
        tokenizers: &[
            "aravindhs-NV/eagle3-processor-groot-n1d6",
            // It has the same ids.
            "lerobot/eagle2hg-processor-groot-n1p5",
        ],
        tokenizer_files: &SLOW_TOKENIZER,
        max_positions: 40_960,
        default_preprocessing: Preprocessing::Isaac,
        isaac_file: Some(IsaacFile {
            class: "Gr00tN1d6Processor",
            arguments: &[&COMMON_ARGUMENTS],
        }),
        prompt: PromptRules {
            template: "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n\
                       <|im_start|>user\n{text}{views}<|im_end|>\n",
            view: EAGLE_VIEW,
            wording: Wording::Formalized,
            default_instruction: None,
            has_placeholders: true,
        },
        views: ViewRules::Flexible(Flexible {
            patch_size: 14,
            merge: 2,
            pixels: Pixels::Planes,
            rounding: WeightRounding::Pillow,
            fitting: Fitting::OfMultiples { max_side: 7000.0 },
            areas: (4 * 28 * 28, 4096 * 28 * 28),
            file_edge: 512,
            // It has no such option: its last release always adds bars, the first one, which made the
            // published checkpoint, did so without albumentations only.
            file_has_bars: true,
        }),
    }),
    lerobot: None,
};
