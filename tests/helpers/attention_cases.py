"""diffusers' Attention as GR00T makes it, small, and what tests of the torch module compare with it."""

from __future__ import annotations

import copy
from typing import Any

import torch
from diffusers.models.attention import Attention

HEADS, HEAD_DIM, WIDTH, CONTEXT_DIM = 3, 17, 51, 29


def attention(seed: int = 0, context_dim: int | None = CONTEXT_DIM, **options: Any) -> Attention:
    """diffusers' Attention as GR00T makes it."""
    torch.manual_seed(seed)
    sizes = {"query_dim": WIDTH, "heads": HEADS, "dim_head": HEAD_DIM, "cross_attention_dim": context_dim}
    return Attention(**{**sizes, "bias": True, "dropout": 0.2, **options}).eval().requires_grad_(False)


def tensors(batch: int = 2, queries: int = 5, keys: int = 7) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    states = torch.randn(batch, queries, WIDTH, generator=generator)
    return states, torch.randn(batch, keys, CONTEXT_DIM, generator=generator)


def in_float64(module: Attention, *args: torch.Tensor | None) -> torch.Tensor:
    def double(value: torch.Tensor | None) -> torch.Tensor | None:
        return value.double() if value is not None and value.is_floating_point() else value

    output: torch.Tensor = copy.deepcopy(module).double()(*(double(value) for value in args))
    return output


def assert_matches(output: torch.Tensor, expected: torch.Tensor, tolerance: float = 1e-6) -> None:
    torch.testing.assert_close(
        output.double(), expected, rtol=0, atol=tolerance * max(1, float(expected.abs().max()))
    )
