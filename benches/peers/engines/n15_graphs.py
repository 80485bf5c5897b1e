"""N1.5's whole policy as graphs: the modules that are exported, and a chunk from them."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.peers import pieces
from benches.peers.policy_inputs import Arrays, Given, given
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.reference import ActionHead, Backbone
from saccade_lab.reference.backbone.rotary import text_angles

Graphs = Any  # opened graphs by name


class Tower(nn.Module):
    """Views to image tokens: SigLIP and the connector."""

    def __init__(self, eagle: Any) -> None:
        super().__init__()
        self.eagle = eagle

    def forward(self, views: Tensor) -> tuple[Tensor, ...]:
        """`(V, 3, side, side)` to `(V * tokens of a view, width)`."""
        return (self.eagle.image_tokens(views),)


class Language(nn.Module):
    """Qwen3 with torch's SDPA, without padding."""

    def __init__(self, decoder: Any, sizes: BackboneSizes) -> None:
        super().__init__()
        self.layers, self.norm, self.sizes = decoder.layers, decoder.norm, sizes.text

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        """Embedded tokens `(1, T, width)` to features of the same shape."""
        text = self.sizes
        angles = text_angles(torch.arange(x.shape[1]), text.theta, text.head_dim // 2, x.dtype)
        for layer in self.layers:
            x = pieces.decoder_layer(layer, x, angles, text.head_dim)
        return (self.norm(x),)


def write_backbone(source: Path, folder: Path, arrays: Arrays) -> Tensor:
    """Exports tower and language model; returns the table of tokens."""
    from benches.peers.engines.onnx_runtime import export

    eagle: Any = Backbone.from_pretrained(source).requires_grad_(False).eagle_model
    decoder = eagle.language_model.model
    two = given(arrays, 2)
    tokens = torch.export.Dim("tokens", min=2, max=4096)
    pixels = torch.from_numpy(two.pixels)
    export(Tower(eagle), (pixels,), folder / "tower.onnx", ({0: torch.export.Dim("views", max=64)},))
    embedded = decoder.embed_tokens(torch.from_numpy(two.ids))
    export(Language(decoder, eagle.sizes), (embedded,), folder / "language.onnx", ({1: tokens},))
    table: Tensor = decoder.embed_tokens.weight
    return table


def write_encode(head: ActionHead, folder: Path, arrays: Arrays) -> list[dict[int, Any]]:
    """Exports `pieces.Encode`; returns which axis of each of its results varies."""
    from benches.peers.engines.onnx_runtime import export

    tokens = torch.export.Dim("tokens", min=2, max=4096)
    module = pieces.Encode(head)
    features = torch.zeros(1, given(arrays, 2).ids.shape[1], head.config.context_dim)
    export(module, (features,), folder / "encode.onnx", ({1: tokens},))
    return [{2: tokens} for _ in range(2 * len(module.project.to_kv))]


def features_of(
    run: Graphs, one: Given, embedded: NDArray[np.float32], sizes: BackboneSizes
) -> NDArray[np.float32]:
    """Tower and language model, whose embedded tokens are written into: `(1, T, width)`."""
    (tokens,) = run["tower"](one.pixels)
    embedded[one.ids == sizes.image_token] = tokens
    (features,) = run["language"](embedded)
    return features


def context_of(
    run: Graphs, one: Given, features: NDArray[np.float32], sizes: BackboneSizes
) -> tuple[NDArray[np.float32], ...]:
    """Keys and values of all cross blocks."""
    return run["encode"](features)
