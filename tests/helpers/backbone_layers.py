"""Writes tests/data/backbone_layers.safetensors: layers of Qwen3 and SigLIP, by transformers in float64.

The Rust tests of saccade's layers compare with it. To write it again:
``python tests/helpers/backbone_layers.py``.
"""

from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from transformers import Qwen3Config, SiglipVisionConfig
from transformers.models.qwen3 import modeling_qwen3 as qwen3
from transformers.models.siglip import modeling_siglip as siglip

ROWS = 11
FIRST_POSITION = 5


def record(tensors: dict[str, torch.Tensor], name: str, layer: Any, x: torch.Tensor, *more: Any) -> None:
    """Adds a layer with random weights, its input ``x (rows, width)`` and its output to ``tensors``."""
    for parameter in layer.parameters():
        # float32 numbers, so that both sides compute with the same ones.
        parameter.data = (0.4 * torch.randn(parameter.shape)).to(torch.float64)
    with torch.no_grad():
        out = layer(x.to(torch.float64)[None], *more)
    tensors[f"{name}.input"] = x
    tensors[f"{name}.output"] = (out[0] if isinstance(out, tuple) else out)[0]
    tensors |= {f"{name}.{key}": value for key, value in layer.state_dict().items()}


def record_qwen3(tensors: dict[str, torch.Tensor]) -> None:
    """Causal self-attention with grouped keys, per-head norms and rotary positions; gated MLP; norm."""
    config = Qwen3Config(
        hidden_size=20,
        intermediate_size=28,
        num_attention_heads=6,
        num_key_value_heads=2,
        head_dim=8,
        rms_norm_eps=1e-6,
        rope_theta=1e6,
        attn_implementation="eager",
    )
    x = torch.randn(ROWS, config.hidden_size)
    positions = torch.arange(FIRST_POSITION, FIRST_POSITION + ROWS)[None]
    float64 = torch.zeros(1, dtype=torch.float64)
    rotation = qwen3.Qwen3RotaryEmbedding(config)(float64, positions)
    causal = torch.full((1, 1, ROWS, ROWS), -torch.inf, dtype=torch.float64).triu(1)
    record(tensors, "qwen3.self_attn", qwen3.Qwen3Attention(config, 0).eval(), x, rotation, causal)
    record(tensors, "qwen3.mlp", qwen3.Qwen3MLP(config), x)
    record(tensors, "qwen3.norm", qwen3.Qwen3RMSNorm(config.hidden_size, config.rms_norm_eps), x)


def record_siglip(tensors: dict[str, torch.Tensor]) -> None:
    """Self-attention and feed-forward of the vision tower."""
    config = SiglipVisionConfig(
        hidden_size=24, intermediate_size=36, num_attention_heads=3, attn_implementation="eager"
    )
    x = torch.randn(ROWS, config.hidden_size)
    record(tensors, "siglip.self_attn", siglip.SiglipAttention(config).eval(), x)
    record(tensors, "siglip.mlp", siglip.SiglipMLP(config), x)


def main() -> None:
    torch.manual_seed(0)
    tensors: dict[str, torch.Tensor] = {}
    record_qwen3(tensors)
    record_siglip(tensors)
    path = Path(__file__).parents[1] / "data" / "backbone_layers.safetensors"
    save_file({name: value.to(torch.float32).clone() for name, value in tensors.items()}, path)


if __name__ == "__main__":
    main()
