"""Seeded random heads and inputs of the released sizes or others, for tests and benchmarks."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from saccade.head.config import HeadConfig
from saccade_lab.published import CONFIGS, sized_config, small_config, whole_config
from saccade_lab.reference.head import ActionHead

__all__ = [
    "CONFIGS",
    "random_head",
    "random_inputs",
    "random_masks",
    "random_tensor",
    "sized_config",
    "small_config",
    "unused_parameters",
    "whole_config",
    "write_checkpoint",
]


def unused_parameters(config: Mapping[str, Any]) -> list[str]:
    """Parameters that the released code creates from a config, but that inference does not use."""
    names = []
    if config.get("use_multi_action_heads") and config.get("use_learnable_loss_weights"):
        arms = ["left_arm", "right_arm"] if config.get("split_arm_heads") else ["arm"]
        names += [f"task_log_sigma.{part}" for part in [*arms, "claw"]]
    if config.get("model_type") == "Gr00tN1d6" and config.get("state_dropout_prob", 0.0) > 0:
        names.append("mask_token")
    return names


def random_head(config: Mapping[str, Any], seed: int, *, dtype: torch.dtype = torch.float32) -> ActionHead:
    """A head with random tensors only, so that a missing or transposed one shows in the result."""
    with torch.device("meta"):
        head = ActionHead(HeadConfig.from_dict(config), unused=unused_parameters(config))
    generator = torch.Generator().manual_seed(seed)
    shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
    tensors = {name: random_tensor(name, shape, generator).to(dtype) for name, shape in shapes.items()}
    head.load_state_dict(tensors, assign=True)
    return head


def write_checkpoint(
    folder: Path,
    config: Mapping[str, Any],
    seed: int,
    *,
    dtype: torch.dtype = torch.float32,
    through: torch.dtype = torch.float32,
    shard_bytes: int = 2**28,
) -> None:
    """Writes the tensors of ``random_head(config, seed)`` as a checkpoint in the published layout.

    Args:
        folder: The directory of ``config.json`` and ``model-*.safetensors``.
        config: The config of the head in the released names.
        seed: Seed of the weights.
        dtype: Dtype of the stored tensors.
        through: Dtype that they are rounded to first, so that files in two dtypes can have equal values.
        shard_bytes: A shard is complete when it reaches this size.
    """
    with torch.device("meta"):
        head = ActionHead(HeadConfig.from_dict(config), unused=unused_parameters(config))
    shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
    generator = torch.Generator().manual_seed(seed)
    shard: dict[str, Tensor] = {}
    num_shards, held = 0, 0
    for index, (name, shape) in enumerate(shapes.items(), start=1):
        shard[f"action_head.{name}"] = random_tensor(name, shape, generator).to(through).to(dtype)
        held += shard[f"action_head.{name}"].nbytes
        if held >= shard_bytes or index == len(shapes):
            num_shards += 1
            save_file(shard, folder / f"model-{num_shards:05}.safetensors")
            shard, held = {}, 0
    (folder / "config.json").write_text(json.dumps(whole_config(config), indent=1))


def random_tensor(name: str, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """One tensor of ``random_head`` in float32, scaled so that activations stay of order one.

    Args:
        name: Name in the checkpoint, which distinguishes weights, biases, norms and tables.
        shape: Shape of the tensor.
        generator: Advances.
    """
    drawn = torch.randn(shape, generator=generator)
    if name.endswith((".bias", ".b")) or not shape:
        return 0.1 * drawn
    if name.endswith(".W"):
        return drawn / math.sqrt(shape[1])  # (category, in, out)
    if name in ("future_tokens.weight", "position_embedding.weight"):
        return 0.5 * drawn
    if len(shape) == 1:
        return 1.0 + 0.1 * drawn  # a LayerNorm's scale
    return drawn / math.sqrt(shape[1])  # (out, in)


def random_inputs(config: HeadConfig, seed: int, *, batch: int, num_vl_tokens: int) -> dict[str, Tensor]:
    """Standard normal inputs, one random embodiment per row, and masks if the head needs them.

    Args:
        config: Config of the head.
        seed: Seed of all inputs.
        batch: Number of observations.
        num_vl_tokens: T_vl.

    Returns:
        Arguments of ``ActionHead.forward``: ``backbone_features``, ``state``, ``noise`` in float32,
        ``embodiment_id`` long. With alternate masks also those of ``random_masks``.
    """
    generator = torch.Generator().manual_seed(seed)
    inputs = {
        "backbone_features": torch.randn(batch, num_vl_tokens, config.context_dim, generator=generator),
        "state": torch.randn(batch, config.num_states, config.state_dim, generator=generator),
        "noise": torch.randn(batch, config.action_horizon, config.encoder_action_dim, generator=generator),
        "embodiment_id": torch.randint(config.num_embodiments, (batch,), generator=generator),
    }
    if config.mask_mode == "alternate":
        inputs |= random_masks(generator, batch=batch, num_vl_tokens=num_vl_tokens)
    return inputs


def random_masks(generator: torch.Generator, *, batch: int, num_vl_tokens: int) -> dict[str, Tensor]:
    """Padding on the left and a sequence of image tokens, of different lengths in every row.

    Args:
        generator: Advances.
        batch: Number of observations.
        num_vl_tokens: T_vl, at least 2, since each row has an attended text and an attended image token.

    Returns:
        ``attention_mask`` and ``image_mask``, bool ``(batch, T_vl)``.
    """

    def draw(high: int) -> int:
        return int(torch.randint(high, (), generator=generator))

    attended = torch.ones(batch, num_vl_tokens, dtype=torch.bool)
    image = torch.zeros(batch, num_vl_tokens, dtype=torch.bool)
    for row in range(batch):
        length = num_vl_tokens - draw(num_vl_tokens // 2)  # of what is not padding
        num_images = 1 + draw(length - 1)
        first = num_vl_tokens - length + draw(length - num_images + 1)
        attended[row, : num_vl_tokens - length] = False
        image[row, first : first + num_images] = True
    return {"attention_mask": attended, "image_mask": image}
