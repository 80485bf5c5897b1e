"""Seeded random heads and inputs, at the released sizes or any others, for tests and benchmarks."""

import copy
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from saccade.config import HeadConfig
from saccade.reference.model import ActionHead

N15_CONFIG: Mapping[str, Any] = {
    "action_dim": 32,
    "action_horizon": 16,
    "add_pos_embed": True,
    "backbone_embedding_dim": 2048,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_action_dim": 32,
    "max_num_embodiments": 32,
    "max_seq_len": 1024,
    "max_state_dim": 64,
    "model_dtype": "float32",
    "noise_beta_alpha": 1.5,
    "noise_beta_beta": 1.0,
    "noise_s": 0.999,
    "num_inference_timesteps": 4,
    "num_target_vision_tokens": 32,
    "num_timestep_buckets": 1000,
    "tune_diffusion_model": True,
    "tune_projector": True,
    "use_vlln": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "cross_attention_dim": 2048,
        "dropout": 0.2,
        "final_dropout": True,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 32,
        "num_layers": 16,
        "output_dim": 1024,
        "positional_embeddings": None,
    },
    "vl_self_attention_cfg": {
        "attention_head_dim": 64,
        "dropout": 0.2,
        "final_dropout": True,
        "num_attention_heads": 32,
        "num_layers": 4,
        "positional_embeddings": None,
    },
}
"""The head's config of nvidia/GR00T-N1.5-3B, with the two class defaults that it leaves out."""


def n15_config(*, num_layers: int = 16, vl_num_layers: int = 4, num_embodiments: int = 32) -> dict[str, Any]:
    """The released config, with fewer blocks or embodiments where memory or time is short."""
    config = copy.deepcopy(dict(N15_CONFIG))
    config["max_num_embodiments"] = num_embodiments
    config["diffusion_model_cfg"]["num_layers"] = num_layers
    config["vl_self_attention_cfg"]["num_layers"] = vl_num_layers
    return config


def small_config() -> dict[str, Any]:
    """The released config with every size shrunk: milliseconds instead of seconds, the same structure."""
    config = n15_config(num_layers=4, vl_num_layers=2, num_embodiments=3)
    config |= {"backbone_embedding_dim": 128, "hidden_size": 64, "input_embedding_dim": 96, "max_seq_len": 16}
    config["diffusion_model_cfg"] |= {"num_attention_heads": 2, "cross_attention_dim": 128, "output_dim": 64}
    config["vl_self_attention_cfg"] |= {"num_attention_heads": 2}
    return config


def random_head(config: Mapping[str, Any], seed: int, *, dtype: torch.dtype = torch.float32) -> ActionHead:
    """A head whose every tensor is random, so that a forgotten or transposed one shows."""
    with torch.device("meta"):
        head = ActionHead(HeadConfig.from_dict(config))
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
    """Writes the tensors of `random_head(config, seed)` in the published layout, shard by shard.

    Args:
        folder: gets `config.json` and `model-*.safetensors`.
        config: the head's config in the released key names.
        seed: of the weights.
        dtype: that the tensors are stored in.
        through: that they are rounded to before, so that files in two dtypes can hold equal numbers.
        shard_bytes: a shard is closed when it reaches this size.
    """
    with torch.device("meta"):
        shapes = {name: t.shape for name, t in ActionHead(HeadConfig.from_dict(config)).state_dict().items()}
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
    (folder / "config.json").write_text(json.dumps({"action_head_cfg": dict(config)}, indent=1))


def random_tensor(name: str, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """One tensor of `random_head` in float32, scaled so that activations stay of order one.

    Args:
        name: its name in the checkpoint, which tells weights from biases, norms and tables.
        shape: its shape.
        generator: advances.
    """
    drawn = torch.randn(shape, generator=generator)
    if name.endswith((".bias", ".b")):
        return 0.1 * drawn
    if name.endswith(".W"):
        return drawn / math.sqrt(shape[1])  # (category, in, out)
    if name in ("future_tokens.weight", "position_embedding.weight"):
        return 0.5 * drawn
    if len(shape) == 1:
        return 1.0 + 0.1 * drawn  # a LayerNorm's scale
    return drawn / math.sqrt(shape[1])  # (out, in)


def random_inputs(config: HeadConfig, seed: int, *, batch: int, num_vl_tokens: int) -> dict[str, Tensor]:
    """Standard normal inputs and one random embodiment per row.

    Args:
        config: the head's.
        seed: for all of them.
        batch: rows.
        num_vl_tokens: T_vl.

    Returns:
        Arguments of `ActionHead.forward`: `backbone_features`, `state`, `noise` in float32, `embodiment_id`
        long.
    """
    generator = torch.Generator().manual_seed(seed)
    return {
        "backbone_features": torch.randn(batch, num_vl_tokens, config.context_dim, generator=generator),
        "state": torch.randn(batch, config.state_history, config.state_dim, generator=generator),
        "noise": torch.randn(batch, config.action_horizon, config.encoder_action_dim, generator=generator),
        "embodiment_id": torch.randint(config.num_embodiments, (batch,), generator=generator),
    }
