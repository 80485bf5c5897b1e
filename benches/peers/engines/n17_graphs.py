"""N1.7's whole policy as graphs: the modules that are exported, and a chunk from them.

As a careful user of torch would write them: the tables of a view are constants, blocks read the image tokens
or the text tokens and project nothing else, and keys and values are cached between Euler steps.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from benches.peers import pieces
from benches.peers.policy_inputs import Arrays, Given, given
from saccade_lab.backbone_sizes import BackboneSizes
from saccade_lab.reference import ActionHead, Backbone
from saccade_lab.reference.backbone.attention import split_heads
from saccade_lab.reference.backbone.qwen3_vl import patch_places, prompt_positions
from saccade_lab.reference.backbone.rotary import grid_angles, interleaved_angles, rotate
from saccade_lab.reference.masks import reads_images

Graphs = Any  # opened graphs by name


class Tower(nn.Module):
    """Views of one grid to image tokens, and as many for each deepstack layer."""

    def __init__(self, visual: Any, grid: tuple[int, int]) -> None:
        super().__init__()
        self.visual = visual
        rows, columns = patch_places(*grid, visual.merge, torch.device("cpu"))
        self.positions = pieces.frozen(visual.positions(*grid, rows, columns))
        self.angles = pieces.frozen(grid_angles(rows, columns, visual.head_dim // 2, torch.float32))

    def forward(self, patches: Tensor) -> tuple[Tensor, ...]:
        """`(V, patches, values)` to `(V * tokens of a view, width)`, several times."""
        x = self.visual.patch_embed(patches) + self.positions
        found = []
        for index, block in enumerate(self.visual.blocks):
            y = block.norm1(x)
            q, k, v = (split_heads(part, block.attn.head_dim) for part in block.attn.qkv(y).chunk(3, dim=-1))
            attended = F.scaled_dot_product_attention(rotate(q, self.angles), rotate(k, self.angles), v)
            x = x + block.attn.proj(attended.transpose(1, 2).flatten(2))
            x = x + block.mlp(block.norm2(x))
            if index in self.visual.deepstack:
                found.append(self.visual.deepstack_merger_list[self.visual.deepstack.index(index)](x))
        return (self.visual.merger(x), *found)


class Language(nn.Module):
    """Qwen3 with torch's SDPA, without padding and without the last norm."""

    def __init__(self, decoder: Any, sizes: BackboneSizes) -> None:
        super().__init__()
        self.layers, self.sizes = decoder.layers, sizes.text

    def forward(self, x: Tensor, angles: Tensor, *added: Tensor) -> tuple[Tensor, ...]:
        """Embedded tokens `(1, T, width)`, angles `(T, head_dim / 2)`, and what is added behind the first
        layers, of the same shape as the tokens; to features of that shape.
        """
        for index, layer in enumerate(self.layers):
            x = pieces.decoder_layer(layer, x, angles, self.sizes.head_dim)
            if index < len(added):
                x = x + added[index]
        return (x,)


class Encode(nn.Module):
    """Features to the keys and values of all cross blocks, each of its tokens alone."""

    def __init__(self, head: ActionHead) -> None:
        super().__init__()
        self.all = pieces.Encode(head)
        modules: Any = head
        blocks = enumerate(modules.model.transformer_blocks)
        self.sees_images = [reads_images(head.config, index) for index, block in blocks if block.is_cross]

    def forward(self, features: Tensor, image: Tensor, text: Tensor) -> tuple[Tensor, ...]:
        """`(1, T, C)`, and where the image and the text tokens are."""
        x = self.all.context(features)
        seen = {True: x.index_select(1, image), False: x.index_select(1, text)}
        return self.all.project.of([seen[sees_images] for sees_images in self.sees_images])


def write_backbone(source: Path, folder: Path, arrays: Arrays) -> Tensor:
    """Exports tower and language model; returns the table of tokens."""
    from benches.peers.engines.onnx_runtime import export

    backbone: Any = Backbone.from_pretrained(source).requires_grad_(False)
    visual, decoder = backbone.core.visual, backbone.core.language_model
    two = given(arrays, 2)
    patches = torch.from_numpy(by_view(two))
    export(
        Tower(visual, grid_of(two)),
        (patches,),
        folder / "tower.onnx",
        ({0: torch.export.Dim("views", max=64)},),
    )
    tokens = torch.export.Dim("tokens", min=2, max=4096)
    embedded = decoder.embed_tokens(torch.from_numpy(two.ids))
    added = [torch.zeros_like(embedded) for _ in visual.deepstack]
    angles = torch.from_numpy(angles_of(two, backbone.sizes))
    shapes = ({1: tokens}, {0: tokens}, tuple({1: tokens} for _ in added))
    export(Language(decoder, backbone.sizes), (embedded, angles, *added), folder / "language.onnx", shapes)
    table: Tensor = decoder.embed_tokens.weight
    return table


def write_encode(head: ActionHead, folder: Path, arrays: Arrays) -> list[dict[int, Any]]:
    """Exports `Encode`; returns which axis of each of its results varies."""
    from benches.peers.engines.onnx_runtime import export

    two = given(arrays, 2)
    num_tokens, half = two.ids.shape[1], two.ids.shape[1] // 2
    axes = {kind: torch.export.Dim(f"{kind}_tokens", min=2, max=4096) for kind in ("image", "text")}
    module = Encode(head)
    features = torch.zeros(1, num_tokens, head.config.context_dim)
    places = (torch.arange(half), torch.arange(half, num_tokens))
    varying = ({1: torch.export.Dim("tokens", min=2, max=4096)}, {0: axes["image"]}, {0: axes["text"]})
    export(module, (features, *places), folder / "encode.onnx", varying)
    kinds = ["image" if sees_images else "text" for sees_images in module.sees_images]
    return [{2: axes[kind]} for kind in kinds for _ in range(2)]


def features_of(
    run: Graphs, one: Given, embedded: NDArray[np.float32], sizes: BackboneSizes
) -> NDArray[np.float32]:
    """Tower and language model, whose embedded tokens are written into: `(1, T, width)`."""
    tokens, *stacked = run["tower"](by_view(one))
    is_image = one.ids == sizes.image_token
    embedded[is_image] = tokens
    added = []
    for layer in stacked:
        added.append(np.zeros_like(embedded))
        added[-1][is_image] = layer
    (features,) = run["language"](embedded, angles_of(one, sizes), *added)
    return features


def context_of(
    run: Graphs, one: Given, features: NDArray[np.float32], sizes: BackboneSizes
) -> tuple[NDArray[np.float32], ...]:
    """Keys and values of all cross blocks."""
    is_image = one.ids[0] == sizes.image_token
    return run["encode"](features, np.flatnonzero(is_image), np.flatnonzero(~is_image))


def grid_of(one: Given) -> tuple[int, int]:
    """The grid of patches of every view."""
    assert one.grids is not None
    ((_, rows, columns),) = np.unique(one.grids, axis=0)
    return int(rows), int(columns)


def by_view(one: Given) -> NDArray[np.float32]:
    """The patches of each view: `(V, patches, values)`."""
    rows, columns = grid_of(one)
    return one.pixels.reshape(-1, rows * columns, one.pixels.shape[1])


def angles_of(one: Given, sizes: BackboneSizes) -> NDArray[np.float32]:
    """Rotary angles of the prompt: `(T, head_dim / 2)`."""
    ids, text = torch.from_numpy(one.ids), sizes.text
    grids = [grid_of(one)] * (len(one.pixels) // (grid_of(one)[0] * grid_of(one)[1]))
    positions = prompt_positions(ids, torch.ones_like(ids, dtype=torch.bool), grids, sizes)[:, 0]
    angles = interleaved_angles(positions, text.theta, text.head_dim // 2, text.sections, torch.float32)
    found: NDArray[np.float32] = angles.numpy()
    return found
