"""The configs of the published heads and backbones, and of smaller heads: the one place of their sizes."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_PUBLISHED = json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))

CONFIGS: Mapping[str, Mapping[str, Any]] = _PUBLISHED["heads"]
"""The configs of the heads in the released keys, by name.

``n1`` is nvidia/GR00T-N1-2B: neither future tokens nor VL self-attention, and vision-language tokens as wide
as the rows; width of the state, number of embodiments and steps are not confirmed. ``n1.5`` is
nvidia/GR00T-N1.5-3B, with the two class defaults that the file omits. ``n1.6`` and ``n1.7`` are the keys
about the head in nvidia/GR00T-N1.6-3B, which has no VL self-attention, and nvidia/GR00T-N1.7-3B. ``fork`` is
the N1.5 head of the humanoid_groot fork with one decoder for the arms and one for the claws, ``split-arms``
the same with a decoder for each arm.
"""

RELEASED: Mapping[str, Mapping[str, Any]] = _PUBLISHED["backbones"]
"""The configs of the backbones, by version; the keys are those of the released code."""


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
