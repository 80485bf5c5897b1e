"""The configs of the published heads and backbones, and of smaller heads: the one place of their sizes."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

N1_CONFIG: Mapping[str, Any] = {
    "action_dim": 32,
    "action_horizon": 16,
    "add_pos_embed": True,
    "backbone_embedding_dim": 1536,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_action_dim": 32,
    "max_num_embodiments": 32,
    "max_seq_len": 1024,
    "max_state_dim": 64,
    "model_dtype": "float32",
    "noise_beta_alpha": 1.5,
    "noise_beta_beta": 1.0,
    "noise_s": 0.999,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "tune_diffusion_model": True,
    "tune_projector": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "cross_attention_dim": None,
        "dropout": 0.2,
        "final_dropout": True,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 32,
        "num_layers": 16,
        "output_dim": 1024,
        "positional_embeddings": None,
    },
}
"""Config of the head of nvidia/GR00T-N1-2B. It has neither future tokens nor VL self-attention, and its
vision-language tokens are as wide as the rows. Width of the state, number of embodiments and steps are not
confirmed."""

N15_CONFIG: Mapping[str, Any] = {
    **N1_CONFIG,
    "backbone_embedding_dim": 2048,
    "num_target_vision_tokens": 32,
    "use_vlln": True,
    "diffusion_model_cfg": {**N1_CONFIG["diffusion_model_cfg"], "cross_attention_dim": 2048},
    "vl_self_attention_cfg": {
        "attention_head_dim": 64,
        "dropout": 0.2,
        "final_dropout": True,
        "num_attention_heads": 32,
        "num_layers": 4,
        "positional_embeddings": None,
    },
}
"""Config of the head of nvidia/GR00T-N1.5-3B, including the two class defaults that the file omits."""

N17_CONFIG: Mapping[str, Any] = {
    "model_type": "Gr00tN1d7",
    "action_horizon": 40,
    "add_pos_embed": True,
    "attend_text_every_n_blocks": 2,
    "backbone_embedding_dim": 2048,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_action_dim": 132,
    "max_num_embodiments": 32,
    "max_seq_len": 1024,
    "max_state_dim": 132,
    "model_dtype": "bfloat16",
    "noise_beta_alpha": 1.5,
    "noise_beta_beta": 1.0,
    "noise_s": 0.999,
    "num_inference_timesteps": 4,
    "num_timestep_buckets": 1000,
    "state_dropout_prob": 0.2,
    "state_history_length": 1,
    "tune_diffusion_model": True,
    "tune_projector": True,
    "tune_vlln": True,
    "use_alternate_vl_dit": True,
    "use_vlln": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "dropout": 0.2,
        "final_dropout": True,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 32,
        "num_layers": 32,
        "output_dim": 1024,
        "positional_embeddings": None,
    },
    "vl_self_attention_cfg": N15_CONFIG["vl_self_attention_cfg"],
}
"""The keys about the head in the config of nvidia/GR00T-N1.7-3B, which has no `action_head_cfg`."""

N16_CONFIG: Mapping[str, Any] = {
    **{
        key: value
        for key, value in N17_CONFIG.items()
        if key not in ("state_history_length", "vl_self_attention_cfg")
    },
    "model_type": "Gr00tN1d6",
    "action_horizon": 50,
    "max_action_dim": 128,
    "max_state_dim": 128,
    "state_dropout_prob": 0.0,
}
"""The same for nvidia/GR00T-N1.6-3B, which has no VL self-attention."""

FORK_CONFIG: Mapping[str, Any] = {
    **N15_CONFIG,
    "action_arm_dim": 14,
    "action_claw_dim": 2,
    "action_dim": 16,
    "max_action_dim": 16,
    "pretrained_action_dim": 32,
    "use_learnable_loss_weights": True,
    "use_multi_action_heads": True,
}
"""The N1.5 head of the humanoid_groot fork, with one decoder for the arms and one for the claws."""

SPLIT_ARMS_CONFIG: Mapping[str, Any] = {
    **FORK_CONFIG,
    "action_arm_dim": 18,
    "action_dim": 20,
    "action_left_arm_dim": 9,
    "action_right_arm_dim": 9,
    "max_action_dim": 20,
    "split_arm_heads": True,
    "use_cross_attention_arms": False,
    "use_shared_arm_features": False,
}
"""The same fork with a decoder for each arm."""

CONFIGS: Mapping[str, Mapping[str, Any]] = {
    "n1": N1_CONFIG,
    "n1.5": N15_CONFIG,
    "n1.6": N16_CONFIG,
    "n1.7": N17_CONFIG,
    "fork": FORK_CONFIG,
    "split-arms": SPLIT_ARMS_CONFIG,
}
"""All heads with their published sizes."""


_QWEN3 = {
    "hidden_size": 2048,
    "intermediate_size": 6144,
    "num_hidden_layers": 28,
    "num_attention_heads": 16,
    "num_key_value_heads": 8,
    "head_dim": 128,
    "vocab_size": 151680,
    "rms_norm_eps": 1e-6,
    "rope_theta": 1e6,
}
_SIGLIP = {
    "hidden_size": 1152,
    "intermediate_size": 4304,
    "num_hidden_layers": 27,
    "num_attention_heads": 16,
    "patch_size": 14,
    "layer_norm_eps": 1e-6,
}

#: The configs of the published backbones, by version; the keys are those of the released code.
RELEASED: Mapping[str, Mapping[str, Any]] = {
    "n1.5": {
        "select_layer": 12,
        "project_to_dim": None,
        "use_pixel_shuffle": False,
        "downsample_ratio": 0.5,
        "mlp_connector_layers": 1,
        "image_token_index": 151669,
        "text_config": _QWEN3,
        "vision_config": {**_SIGLIP, "image_size": 224},
    },
    "n1.6": {
        "select_layer": 16,
        "use_pixel_shuffle": True,
        "downsample_ratio": 0.5,
        "mlp_connector_layers": 2,
        "image_token_index": 151669,
        "text_config": _QWEN3,
        "vision_config": {**_SIGLIP, "num_patches": 256},
    },
    "n1.7": {
        "select_layer": 16,
        "image_token_index": 151655,
        "text_config": {
            **_QWEN3,
            "vocab_size": 151936,
            "rope_theta": 5e6,
            "rope_scaling": {"mrope_section": [24, 20, 20]},
        },
        "vision_config": {
            "hidden_size": 1024,
            "intermediate_size": 4096,
            "depth": 24,
            "num_heads": 16,
            "patch_size": 16,
            "temporal_patch_size": 2,
            "spatial_merge_size": 2,
            "out_hidden_size": 2048,
            "num_position_embeddings": 2304,
            "deepstack_visual_indexes": [5, 11, 17],
        },
    },
}


def sized_config(
    kind: str,
    *,
    num_layers: int | None = None,
    vl_num_layers: int | None = None,
    num_embodiments: int | None = None,
) -> dict[str, Any]:
    """A copy of one of `CONFIGS`, optionally with fewer blocks or embodiments to save memory and time."""
    config = copy.deepcopy(dict(CONFIGS[kind]))
    if num_layers is not None:
        config["diffusion_model_cfg"]["num_layers"] = num_layers
    if vl_num_layers is not None and "vl_self_attention_cfg" in config:
        config["vl_self_attention_cfg"]["num_layers"] = vl_num_layers
    if num_embodiments is not None:
        config["max_num_embodiments"] = num_embodiments
    return config


def small_config(kind: str = "n1.5") -> dict[str, Any]:
    """One of `CONFIGS` with small sizes, so that a test takes milliseconds."""
    # Six blocks with alternate masks: text, image and text again.
    alternate = "use_alternate_vl_dit" in CONFIGS[kind]
    config = sized_config(kind, num_layers=6 if alternate else 4, vl_num_layers=2, num_embodiments=3)
    context_dim = 96 if kind == "n1" else 128
    config |= {"backbone_embedding_dim": context_dim, "hidden_size": 64, "input_embedding_dim": 96}
    config["max_seq_len"] = max(16, config["action_horizon"])
    config["diffusion_model_cfg"] |= {"num_attention_heads": 2, "output_dim": 64}
    if config["diffusion_model_cfg"].get("cross_attention_dim") is not None:
        config["diffusion_model_cfg"]["cross_attention_dim"] = context_dim
    if "vl_self_attention_cfg" in config:
        config["vl_self_attention_cfg"] |= {"num_attention_heads": 2}
    return config


def whole_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a checkpoint's `config.json` that describes the head.

    N1.6 and N1.7 have one flat object. In earlier versions the head has an object of its own.
    """
    if "model_type" in config:
        return dict(config)
    model_type = "gr00t_n1_5" if "num_target_vision_tokens" in config else "gr00t_n1"
    return {"model_type": model_type, "action_head_cfg": dict(config)}
