"""lerobot's Eagle model of N1.5 at any size, around transformers' SigLIP and Qwen3, with torch's SDPA."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from transformers import Qwen3Config, Qwen3ForCausalLM, SiglipVisionConfig, SiglipVisionModel

from saccade_lab.backbone_sizes import BackboneSizes


def eagle(module: ModuleType, sizes: BackboneSizes) -> Any:
    """A model with the weights that torch gives it.

    Args:
        module: Lerobot's ``modeling_eagle2_5_vl``.
        sizes: Sizes of the backbone.
    """
    vision = {
        "hidden_size": sizes.vision.width,
        "intermediate_size": sizes.vision.mlp_width,
        "num_hidden_layers": sizes.vision.num_layers,
        "num_attention_heads": sizes.vision.num_heads,
        "image_size": round(sizes.vision.num_positions**0.5) * sizes.vision.patch_size,
        "patch_size": sizes.vision.patch_size,
        "layer_norm_eps": sizes.vision.eps,
        "model_type": "siglip_vision_model",
    }
    config = module.Eagle25VLConfig(
        vision_config=vision,
        text_config={**text_config(sizes), "architectures": ["Qwen3ForCausalLM"]},
        select_layer=-1,
        image_token_index=sizes.image_token,
        use_pixel_shuffle=sizes.merge == 2,
        mlp_connector_layers=sizes.connector_layers,
        _attn_implementation="eager",
    )
    return module.Eagle25VLForConditionalGeneration(
        config,
        SiglipVisionModel(SiglipVisionConfig(**vision, attn_implementation="sdpa")),
        Qwen3ForCausalLM(Qwen3Config(**text_config(sizes), attn_implementation="sdpa")),
    )


def text_config(sizes: BackboneSizes) -> dict[str, Any]:
    """The sizes of Qwen3 as transformers names them."""
    text = sizes.text
    return {
        "hidden_size": text.width,
        "intermediate_size": text.mlp_width,
        "num_hidden_layers": sizes.num_layers,
        "num_attention_heads": text.num_heads,
        "num_key_value_heads": text.num_key_heads,
        "head_dim": text.head_dim,
        "vocab_size": text.vocabulary,
        "rms_norm_eps": text.eps,
        "rope_theta": text.theta,
        "tie_word_embeddings": True,
    }
