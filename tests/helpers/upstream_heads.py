"""Heads of the shape of those that no wheel holds: Isaac-GR00T's N1.6 and N1.7 and the forks'.

Names of attributes, arguments and results are upstream's, the arithmetic is `saccade_lab.reference`'s. So
they
test what `saccade.integrations` makes of such a class; whether the arithmetic is upstream's, other tests say.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call, operator"

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import torch
from torch import nn
from transformers.feature_extraction_utils import BatchFeature

import saccade
from saccade_lab.reference.random_weights import random_head


class Head(nn.Module):
    """N1.5 and the forks, and N1.6, which also returns what it made of features and state."""

    whole: Any

    def __init__(self, config: Mapping[str, Any]) -> None:
        super().__init__()
        whole = random_head(config, seed=0)
        for name, part in whole.named_children():
            self.add_module(name, part)
        for name, parameter in whole.named_parameters(recurse=False):
            self.register_parameter(name, parameter)
        vars(self)["whole"] = whole  # not a module of its own: its parts are this one's
        self.config = SimpleNamespace(**config)
        self.action_horizon = whole.config.action_horizon
        self.num_inference_timesteps = whole.config.num_steps
        self.num_timestep_buckets = whole.config.num_timestep_buckets
        self.eval()

    def process_backbone_output(self, backbone_output: Any) -> Any:
        backbone_output["backbone_features"] = self.whole.encode(backbone_output["backbone_features"])
        return backbone_output

    @torch.no_grad()
    def get_action(self, backbone_output: Any, action_input: Any) -> Any:
        return self.denoise(backbone_output, action_input, {})

    def denoise(self, backbone_output: Any, action_input: Any, chunk: dict[str, Any]) -> Any:
        vl_embs = self.process_backbone_output(backbone_output).backbone_features
        config = self.whole.config
        size = (len(vl_embs), self.action_horizon, config.encoder_action_dim)
        noise = torch.randn(size=size, dtype=vl_embs.dtype, device=vl_embs.device)
        masks = {}
        if config.mask_mode == "alternate":
            masks = {
                "image_mask": backbone_output.image_mask,
                "attention_mask": backbone_output.backbone_attention_mask,
            }
        state, ids = action_input.state, action_input.embodiment_id
        actions = self.whole.sample(
            vl_embs, state, ids, noise=noise, num_steps=self.num_inference_timesteps, **masks, **chunk
        )
        results = {"action_pred": actions}
        if config.version not in ("n1", "n1.5"):
            results["backbone_features"] = vl_embs
            results["state_features"] = self.state_encoder(state.reshape(len(state), 1, -1), ids)
        return BatchFeature(data=results)


class ChunkingHead(Head):
    """N1.7: real-time chunking by options."""

    @torch.no_grad()
    def get_action(self, backbone_output: Any, action_input: Any, options: Any = None) -> Any:
        return self.get_action_with_features(backbone_output, action_input, options)

    def get_action_with_features(self, backbone_output: Any, action_input: Any, options: Any) -> Any:
        chunk: dict[str, Any] = {}
        if "action" in action_input:
            overlap, horizon = options["rtc_overlap_steps"], options["action_horizon"]
            previous = action_input["action"][:, :horizon]
            rules = saccade.Chunking(overlap, options["rtc_frozen_steps"], options["rtc_ramp_rate"], horizon)
            chunk = {"previous_chunk": previous, "chunking": rules}
        return self.denoise(backbone_output, action_input, chunk)
