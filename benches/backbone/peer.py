"""N1.5's backbone from transformers' SigLIP and Qwen3: what a careful user of torch runs on a CPU.

Compared with the released code it computes no logits, no pooling head and no cache of keys and values.
"""

# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from torch import Tensor, nn
from transformers import Qwen3Config, Qwen3Model, SiglipVisionConfig, SiglipVisionModel

from saccade import BackboneInputs
from saccade_lab.backbone_sizes import BackboneSizes

PREFIX = "backbone.eagle_model."


class Peer(nn.Module):
    """Module names are those of the checkpoint below `PREFIX`.

    Args:
        sizes: of the backbone; without pixel shuffle.
    """

    def __init__(self, sizes: BackboneSizes) -> None:
        super().__init__()
        vision, text = sizes.vision, sizes.text
        self.image_token = sizes.image_token
        self.vision_model = SiglipVisionModel(
            SiglipVisionConfig(
                hidden_size=vision.width,
                intermediate_size=vision.mlp_width,
                num_hidden_layers=vision.num_layers,
                num_attention_heads=vision.num_heads,
                image_size=round(vision.num_positions**0.5) * vision.patch_size,
                patch_size=vision.patch_size,
                layer_norm_eps=vision.eps,
                vision_use_head=False,
                attn_implementation="sdpa",
            )
        )
        self.mlp1 = nn.Sequential(nn.Linear(vision.width, text.width))
        self.language_model: Any = nn.Module()
        self.language_model.model = Qwen3Model(
            Qwen3Config(
                hidden_size=text.width,
                intermediate_size=text.mlp_width,
                num_hidden_layers=sizes.num_layers,
                num_attention_heads=text.num_heads,
                num_key_value_heads=text.num_key_heads,
                head_dim=text.head_dim,
                vocab_size=text.vocabulary,
                rms_norm_eps=text.eps,
                rope_theta=text.theta,
                attn_implementation="sdpa",
            )
        )

    @classmethod
    def load(cls, folder: Path, sizes: BackboneSizes, dtype: torch.dtype) -> Peer:
        """With the weights of a checkpoint, in `dtype`."""
        peer = cls(sizes)
        shapes = peer.state_dict().keys()
        tensors = {}
        for path in sorted(folder.glob("*.safetensors")):
            with safe_open(path, framework="pt") as file:
                for name in file.keys():  # noqa: SIM118 (the handle of safetensors is not a dict)
                    if name.removeprefix(PREFIX) in shapes:
                        # Copied, because a mapped file has no huge pages.
                        tensors[name.removeprefix(PREFIX)] = file.get_tensor(name).to(dtype, copy=True)
        peer.load_state_dict(tensors, assign=True)
        return peer.to(dtype).requires_grad_(False).eval()

    def use_attention(self, kind: str) -> None:
        """`"sdpa"` or `"eager"`."""
        for model in (self.vision_model, self.language_model.model):
            config: Any = model.config
            config._attn_implementation = kind

    def forward(self, pixels: Tensor, ids: Tensor) -> Tensor:
        """`(views, 3, side, side)` in the model's dtype and `(1, T)` to `(1, T, width)`."""
        qwen3 = self.language_model.model
        tokens = self.mlp1(self.vision_model(pixel_values=pixels).last_hidden_state)
        x = qwen3.embed_tokens(ids)
        x = x.masked_scatter((ids == self.image_token)[..., None], tokens.to(x.dtype))
        return qwen3(inputs_embeds=x, use_cache=False).last_hidden_state


def arguments(inputs: BackboneInputs, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """What `Peer` takes."""
    assert not isinstance(inputs.pixel_values, tuple)
    return torch.from_numpy(inputs.pixel_values).to(dtype), torch.from_numpy(inputs.input_ids)
