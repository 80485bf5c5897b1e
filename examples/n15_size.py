"""A checkpoint of GR00T N1.5's size with random weights, from NumPy alone: to time what is not downloaded."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

CONFIG = {
    "action_dim": 32,
    "action_horizon": 16,
    "add_pos_embed": True,
    "backbone_embedding_dim": 2048,
    "hidden_size": 1024,
    "input_embedding_dim": 1536,
    "max_num_embodiments": 1,
    "max_state_dim": 64,
    "num_inference_timesteps": 4,
    "num_target_vision_tokens": 32,
    "num_timestep_buckets": 1000,
    "use_vlln": True,
    "diffusion_model_cfg": {
        "attention_head_dim": 48,
        "interleave_self_attention": True,
        "num_attention_heads": 32,
        "num_layers": 16,
    },
    "vl_self_attention_cfg": {"attention_head_dim": 64, "num_attention_heads": 32, "num_layers": 4},
}
"""The released sizes, with one embodiment."""

TENSORS = Path(__file__).parents[1] / "tests" / "data" / "groot_n15_tensors.tsv"
"""Names and shapes of the released head's tensors."""


def write_checkpoint(folder: Path) -> None:
    """Writes `config.json` and 1.1 GB of bfloat16 weights to `folder`."""
    (folder / "config.json").write_text(json.dumps(CONFIG))
    header, sizes, end = {}, [], 0
    for line in TENSORS.read_text().splitlines():
        if not line.startswith("action_head."):
            continue
        name, shape_text = line.split("\t")
        shape = [int(size) for size in shape_text.split("x")]
        if name.endswith((".W", ".b")):  # one slice an embodiment
            shape[0] = 1
        begin, end = end, end + 2 * math.prod(shape)
        header[name] = {"dtype": "BF16", "shape": shape, "data_offsets": [begin, end]}
        sizes.append(math.prod(shape))
    text = json.dumps(header).encode()
    # A million numbers over and over: no engine is faster for it, and the file is written in seconds.
    numbers = np.random.default_rng(0).normal(0, 0.02, 1 << 20).astype(np.float32)
    bfloat16 = (numbers.view(np.uint32) >> 16).astype("<u2")
    with (folder / "model.safetensors").open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for size in sizes:
            file.write(np.resize(bfloat16, size).tobytes())
