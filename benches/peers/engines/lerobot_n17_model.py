"""lerobot's N1.7 model, of lerobot 0.6.1, with the weights of a checkpoint.

lerobot has the sizes of the published backbone in its code; a checkpoint of other sizes has them in its
config. Attention is torch's SDPA.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benches.backbone.setup import sizes_of
from benches.peers.policy_inputs import Given


def build(source: Path, tensors: dict[str, Tensor], _: torch.dtype) -> Any:
    """A `GR00TN17` in evaluation mode.

    Args:
        source: a checkpoint of N1.7.
        tensors: its weights, which become those of the model without a copy.
        _: N1.7 casts its inputs to the dtype of its weights, not to another one.
    """
    from lerobot.policies.groot import groot_n1_7 as groot
    from transformers.initialization import no_init_weights

    config = json.loads((source / "config.json").read_text())
    sizes = groot._cosmos_reason2_qwen3_vl_config()
    own = config.get("backbone_cfg", {}).get("eagle_config")
    if own is not None:
        own = {key: own[key] for key in ("text_config", "vision_config")}
        sizes = groot.Qwen3VLConfig(**own, image_token_id=sizes_of(source).image_token)
    sizes._attn_implementation = "sdpa"
    # Nothing is initialised, since the weights replace all.
    with (
        mock.patch.object(groot, "_cosmos_reason2_qwen3_vl_config", lambda: sizes),
        no_init_weights(),
    ):
        model: Any = groot.GR00TN17(groot.GR00TN17Config(**config), load_backbone_weights=False)
    names = model.state_dict().keys()
    missing = model.load_state_dict(
        {name: tensor for name, tensor in tensors.items() if name in names}, strict=False, assign=True
    ).missing_keys
    backbone: Any = model.backbone
    backbone.model.lm_head.weight = backbone.language_model.embed_tokens.weight  # tied
    unread = [name for name in missing if "lm_head" not in name]
    if unread:
        raise ValueError(f"{source}: these tensors of lerobot's model are missing: {', '.join(unread)}")
    return model.eval()


def inputs_of(one: Given) -> dict[str, Tensor]:
    """What lerobot's processor hands to the policy."""
    ids = torch.from_numpy(one.ids)
    assert one.grids is not None
    return {
        "pixel_values": torch.from_numpy(one.pixels),
        "image_grid_thw": torch.from_numpy(one.grids),
        "input_ids": ids,
        "attention_mask": torch.ones_like(ids),
        "state": torch.from_numpy(one.state).reshape(1, 1, -1),
        "embodiment_id": torch.tensor([one.embodiment_id]),
    }
