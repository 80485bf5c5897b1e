"""Softmax attention as both towers and the language model use it."""

# Some methods of tensors are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import math

from torch import Tensor


def attend(queries: Tensor, keys: Tensor, values: Tensor, allowed: Tensor | None = None) -> Tensor:
    """Attention of each query to the keys that it is allowed to see.

    Args:
        queries: ``(..., heads, Q, head_dim)``.
        keys, values: ``(..., heads, K, head_dim)``.
        allowed: Bool, broadcast over the heads: ``(..., 1, Q, K)``. Default: every key.

    Returns:
        ``(..., Q, heads * head_dim)``. A query without any allowed key gets zeros, as in torch's SDPA.
    """
    logits = queries @ keys.transpose(-1, -2) / math.sqrt(queries.shape[-1])  # (..., heads, Q, K)
    if allowed is not None:
        # A finite number instead of -inf: a row without allowed keys would become NaN, and so its gradient.
        logits = logits.masked_fill(~allowed, -1e30)
    weights = logits.softmax(dim=-1)
    if allowed is not None:
        weights = weights * allowed.any(dim=-1, keepdim=True)
    return (weights @ values).transpose(-2, -3).flatten(-2)  # (..., Q, heads * head_dim)


def split_heads(x: Tensor, head_dim: int) -> Tensor:
    """``(..., rows, heads * head_dim)`` to ``(..., heads, rows, head_dim)``."""
    return x.unflatten(-1, (-1, head_dim)).transpose(-2, -3)
