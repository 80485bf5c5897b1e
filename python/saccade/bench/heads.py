"""Checkpoints of published sizes with random weights, written quickly and without torch, for timing."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import saccade._saccade as _saccade

#: Sizes of nvidia/GR00T-N1.5-3B with one embodiment; further embodiments cost memory but no time.
N15: Mapping[str, Any] = {
    "action_dim": 32,
    "action_horizon": 16,
    "add_pos_embed": True,
    "backbone_embedding_dim": 2048,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_action_dim": 32,
    "max_num_embodiments": 1,
    "max_seq_len": 1024,
    "max_state_dim": 64,
    "num_inference_timesteps": 4,
    "num_target_vision_tokens": 32,
    "num_timestep_buckets": 1000,
    "use_vlln": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "cross_attention_dim": 2048,
        "interleave_self_attention": True,
        "norm_type": "ada_norm",
        "num_attention_heads": 32,
        "num_layers": 16,
        "output_dim": 1024,
        "positional_embeddings": None,
    },
    "vl_self_attention_cfg": {
        "attention_head_dim": 64,
        "num_attention_heads": 32,
        "num_layers": 4,
        "positional_embeddings": None,
    },
}

#: What differs in nvidia/GR00T-N1.6-3B and nvidia/GR00T-N1.7-3B, whose configs have one flat object.
LATER: Mapping[str, Mapping[str, Any]] = {
    "n1.6": {
        "model_type": "Gr00tN1d6",
        "action_horizon": 50,
        "max_action_dim": 128,
        "max_state_dim": 128,
        "use_alternate_vl_dit": True,
    },
    "n1.7": {
        "model_type": "Gr00tN1d7",
        "action_horizon": 40,
        "max_action_dim": 132,
        "max_state_dim": 132,
        "state_history_length": 1,
        "use_alternate_vl_dit": True,
    },
}

#: The sizes of `sized`.
SIZES = ("n1.5", "n1.6", "n1.7", "small")


def sized(size: str) -> dict[str, Any]:
    """The config of a version's size, or of `small`: N1.5's structure, but fast enough for tests."""
    config = copy.deepcopy(dict(N15))
    if size in LATER:
        absent = ["action_dim", "num_target_vision_tokens"]
        absent += ["vl_self_attention_cfg"] if size == "n1.6" else []
        config = {key: value for key, value in config.items() if key not in absent} | dict(LATER[size])
        config["diffusion_model_cfg"]["num_layers"] = 32
    if size == "small":
        config |= {"backbone_embedding_dim": 128, "hidden_size": 64, "input_embedding_dim": 96}
        config["diffusion_model_cfg"] |= {
            "cross_attention_dim": 128,
            "num_attention_heads": 2,
            "num_layers": 4,
            "output_dim": 64,
        }
        config["vl_self_attention_cfg"] |= {"num_attention_heads": 2, "num_layers": 2}
    return config


def write(folder: Path, config: Mapping[str, Any]) -> None:
    """Writes `config.json` and `model.safetensors`; the weights keep activations of order one.

    They are stored as bfloat16. One block of random numbers is repeated, so that the disk is the limit:
    1.5 GB for N1.5, 2.2 GB for N1.6, 2.6 GB for N1.7.
    """
    text = json.dumps(dict(config) if "model_type" in config else {"action_head_cfg": dict(config)})
    (folder / "config.json").write_text(text)
    shapes = _saccade.tensor_shapes(text)
    header, end = {}, 0
    for name, shape in shapes:
        begin, end = end, end + 2 * math.prod(shape)
        entry = {"dtype": "BF16", "shape": shape, "data_offsets": [begin, end]}
        header[f"action_head.{name}"] = entry
    encoded = json.dumps(header).encode()
    encoded += b" " * (-len(encoded) % 8)
    drawn = np.random.default_rng(0).standard_normal(1 << 20, dtype=np.float32)
    with (folder / "model.safetensors").open("wb") as file:
        file.write(len(encoded).to_bytes(8, "little"))
        file.write(encoded)
        for name, shape in shapes:
            offset, scale = distribution(name, shape)
            block = (offset + scale * drawn).view(np.uint32)
            bfloat16 = (block >> 16).astype(np.uint16)
            for first in range(0, math.prod(shape), len(bfloat16)):
                file.write(bfloat16[: math.prod(shape) - first].data)


def distribution(name: str, shape: list[int]) -> tuple[float, float]:
    """Mean and standard deviation of one tensor's elements."""
    if name.endswith((".bias", ".b")):
        return 0.0, 0.1
    if len(shape) == 1:
        return 1.0, 0.1  # a LayerNorm's scale
    if name in ("future_tokens.weight", "position_embedding.weight"):
        return 0.0, 0.5
    return 0.0, 1 / math.sqrt(shape[1])  # weights; those of an embodiment are (embodiment, in, out)
