"""Random small backbones in torch, and inputs for them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from saccade import BackboneInputs
from saccade_lab.backbone_sizes import BackboneSizes, TextSizes, VisionSizes
from saccade_lab.reference import Backbone

# Small tensors gain nothing from threads, and on a busy machine every barrier between them stalls.
torch.set_num_threads(1)


def randomised(backbone: Backbone, seed: int) -> Backbone:
    """All parameters drawn, norms and biases included, so that each shows in the features."""
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in backbone.named_parameters():
        drawn = torch.randn(parameter.shape, generator=generator)
        scale = 0.3 if parameter.ndim == 1 else parameter[0].numel() ** -0.5
        offset = 1.0 if parameter.ndim == 1 and not name.endswith("bias") else 0.0
        parameter.data = offset + scale * drawn
    return backbone


def random_sizes(version: str, rng: np.random.Generator) -> BackboneSizes:
    """Sizes of a small backbone, in which heads times head_dim is not the width."""
    key_heads, head_dim = int(rng.integers(1, 3)), 2 * int(rng.integers(3, 7))
    side = 2 * int(rng.integers(1, 4))
    merge = 2 if version == "n1.7" else int(rng.integers(1, 3))
    half = head_dim // 2
    sections = (half - 2 * (half // 3), half // 3, half // 3) if version == "n1.7" else ()
    vision = VisionSizes(
        width=24 * int(rng.integers(1, 4)),
        mlp_width=int(rng.integers(20, 60)),
        num_layers=3,
        num_heads=int(rng.choice([1, 2, 3])),
        patch_size=int(rng.integers(2, 6)),
        num_positions=side**2,
        eps=1e-6,
        deepstack=(0, 2) if version == "n1.7" else (),
        temporal_patch_size=2 if version == "n1.7" else 1,
    )
    text = TextSizes(
        width=8 * int(rng.integers(3, 9)),
        mlp_width=int(rng.integers(20, 60)),
        num_heads=key_heads * int(rng.integers(1, 4)),
        num_key_heads=key_heads,
        head_dim=head_dim,
        vocabulary=40,
        eps=1e-6,
        theta=float(rng.choice([1e4, 1e6])),
        sections=sections,
    )
    layers = int(rng.integers(1, 3)) if merge == 2 else 1
    return BackboneSizes(version, 3, 35, layers, merge, None, vision, text)


def random_inputs(sizes: BackboneSizes, rng: np.random.Generator, batch: int, views: int) -> BackboneInputs:
    """A batch whose prompts have different lengths, padded on the left."""
    vision = sizes.vision
    side = round(vision.num_positions**0.5)
    grids = [(side, side)] * (batch * views)
    pixels = rng.standard_normal((batch * views, 3, *[side * vision.patch_size] * 2))
    if sizes.version == "n1.7":
        grids = [(2 * int(rng.integers(1, 4)), 2 * int(rng.integers(1, 4))) for _ in grids]
        values = 3 * vision.temporal_patch_size * vision.patch_size**2
        pixels = rng.standard_normal((sum(rows * columns for rows, columns in grids), values))
    prompts = []
    for row in range(batch):
        prompt: list[int] = []
        for rows, columns in grids[row * views : (row + 1) * views]:
            tokens = rows * columns // sizes.merge**2
            prompt += [sizes.image_token - 2, *[sizes.image_token] * tokens, sizes.image_token - 1]
        prompts.append(prompt + rng.integers(30, size=int(rng.integers(1, 9))).tolist())
    longest = max(map(len, prompts))
    ids = np.array([[0] * (longest - len(prompt)) + prompt for prompt in prompts])
    mask = np.array([[0] * (longest - len(prompt)) + [1] * len(prompt) for prompt in prompts])
    grid_thw = np.array([(1, *grid) for grid in grids]) if sizes.version == "n1.7" else None
    return BackboneInputs(pixels, ids, mask, grid_thw)


def config_of(sizes: BackboneSizes) -> dict[str, Any]:
    """The config of a backbone, in the keys that `saccade.Backbone` takes."""
    vision, text = sizes.vision, sizes.text
    side = round(vision.num_positions**0.5)
    tower: dict[str, Any] = {
        "hidden_size": vision.width,
        "intermediate_size": vision.mlp_width,
        "patch_size": vision.patch_size,
    }
    if sizes.version == "n1.7":
        tower |= {
            "depth": vision.num_layers,
            "num_heads": vision.num_heads,
            "temporal_patch_size": vision.temporal_patch_size,
            "spatial_merge_size": sizes.merge,
            "out_hidden_size": text.width,
            "num_position_embeddings": vision.num_positions,
            "deepstack_visual_indexes": list(vision.deepstack),
        }
    else:
        tower |= {"num_hidden_layers": vision.num_layers, "num_attention_heads": vision.num_heads}
        tower |= {"layer_norm_eps": vision.eps}
        tower |= (
            {"image_size": side * vision.patch_size} if sizes.version == "n1.5" else {"num_patches": side**2}
        )
    return {
        "kind": f"{sizes.version} backbone",
        "select_layer": sizes.num_layers,
        "project_to_dim": sizes.project_to_dim,
        "eagle": {
            "use_pixel_shuffle": sizes.merge == 2,
            "downsample_ratio": 0.5,
            "mlp_connector_layers": sizes.connector_layers,
            "image_token_index": sizes.image_token,
            "select_layer": -1,
        },
        "token_ids": {"image_token_id": sizes.image_token},
        "text_config": {
            "hidden_size": text.width,
            "intermediate_size": text.mlp_width,
            "num_hidden_layers": sizes.num_layers,
            "num_attention_heads": text.num_heads,
            "num_key_value_heads": text.num_key_heads,
            "head_dim": text.head_dim,
            "vocab_size": text.vocabulary,
            "rms_norm_eps": text.eps,
            "rope_theta": text.theta,
            "rope_scaling": {"mrope_interleaved": True, "mrope_section": list(text.sections)}
            if text.sections
            else None,
        },
        "vision_config": tower,
    }
