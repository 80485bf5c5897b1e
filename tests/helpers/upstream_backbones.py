"""Backbones of the released classes: lerobot's Eagle 2.5 and transformers' SigLIP, Qwen3 and Qwen3-VL.

In double precision these classes still compute RMSNorm and rotary positions in float32.
"""

# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn
from transformers.models.qwen3_vl.configuration_qwen3_vl import Qwen3VLConfig
from transformers.models.qwen3_vl.modeling_qwen3_vl import Qwen3VLForConditionalGeneration

from saccade import BackboneInputs
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.reference.lerobot_backbone import eagle, text_config

EAGLE = "lerobot.policies.groot.eagle2_hg_model"


def eagle_module() -> ModuleType:
    """The module of lerobot's Eagle model, without lerobot's packages and without peft, which is not used."""
    spec = importlib.util.find_spec("lerobot")
    assert spec is not None
    assert spec.submodule_search_locations
    root = Path(spec.submodule_search_locations[0])
    packages = {}
    package = EAGLE
    while package:
        packages[package] = ModuleType(package)
        packages[package].__path__ = [str(root.joinpath(*package.split(".")[1:]))]
        package = package.rpartition(".")[0]
    peft: Any = ModuleType("peft")
    peft.LoraConfig = peft.get_peft_model = None
    with mock.patch.dict(sys.modules, {**packages, "peft": peft}):
        return importlib.import_module(f"{EAGLE}.modeling_eagle2_5_vl")


class Eagle(nn.Module):
    """N1.5's backbone: lerobot's Eagle model, with torch's SDPA as its attention."""

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        self.eagle_model = eagle(eagle_module(), sizes)
        self.eval()

    def forward(self, inputs: BackboneInputs) -> Tensor:
        weight = self.eagle_model.language_model.model.embed_tokens.weight
        outputs = self.eagle_model(
            pixel_values=torch.from_numpy(inputs.pixel_values).to(weight),
            input_ids=torch.from_numpy(inputs.input_ids),
            attention_mask=torch.from_numpy(inputs.attention_mask).long(),
            output_hidden_states=True,
            return_dict=True,
        )
        return outputs.hidden_states[-1]


class Qwen3Vl(nn.Module):
    """N1.7's backbone: transformers' Qwen3-VL, whose features are the output of the last decoder layer."""

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        vision = sizes.vision
        config = Qwen3VLConfig(
            text_config={
                **text_config(sizes),
                "rope_scaling": {
                    "mrope_interleaved": True,
                    "mrope_section": list(sizes.text.sections),
                    "rope_type": "default",
                },
            },
            vision_config={
                "hidden_size": vision.width,
                "intermediate_size": vision.mlp_width,
                "depth": vision.num_layers,
                "num_heads": vision.num_heads,
                "patch_size": vision.patch_size,
                "temporal_patch_size": vision.temporal_patch_size,
                "spatial_merge_size": sizes.merge,
                "out_hidden_size": sizes.text.width,
                "num_position_embeddings": vision.num_positions,
                "deepstack_visual_indexes": list(vision.deepstack),
            },
            image_token_id=sizes.image_token,
            video_token_id=sizes.image_token + 1,
            vision_start_token_id=sizes.image_token - 2,
            vision_end_token_id=sizes.image_token - 1,
            tie_word_embeddings=True,
        )
        config._attn_implementation = "sdpa"
        self.model = Qwen3VLForConditionalGeneration(config)
        self.eval()

    def forward(self, inputs: BackboneInputs) -> Tensor:
        model = self.model.model
        kept: list[Tensor] = []
        last = model.language_model.layers[-1]
        handle = last.register_forward_hook(lambda _, __, out: kept.append(out))
        assert inputs.image_grid_thw is not None
        try:
            model(
                pixel_values=torch.from_numpy(inputs.pixel_values).to(model.language_model.norm.weight),
                input_ids=torch.from_numpy(inputs.input_ids),
                attention_mask=torch.from_numpy(inputs.attention_mask).long(),
                image_grid_thw=torch.from_numpy(inputs.image_grid_thw),
            )
        finally:
            handle.remove()
        return kept[0]
