"""Multi-head attention, written out.

Shapes in comments: B is the batch, Q the queries, S the keys.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Attention(nn.Module):
    """Multi-head attention written out; heads are contiguous slices of the width."""

    def __init__(self, width: int, context_dim: int, num_heads: int, head_dim: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.head_dim = head_dim
        inner = num_heads * head_dim
        self.to_q = nn.Linear(width, inner)
        self.to_k = nn.Linear(context_dim, inner)
        self.to_v = nn.Linear(context_dim, inner)
        self.to_out = nn.ModuleList([nn.Linear(inner, width)])

    def forward(
        self,
        x: Tensor,
        context: Tensor,
        *,
        logit_bias: Tensor | None = None,
        stop_gradient: Tensor | None = None,
        return_weights: bool = False,
    ) -> tuple[Tensor, Tensor | None]:
        """Attends from the rows of ``x`` to those of ``context``.

        Args:
            x: ``(B, Q, width)``.
            context: ``(B, S, context_dim)``.
            logit_bias: Added to the scaled scores, broadcast to ``(B, heads, Q, S)``; minus infinity removes
                a key. If no key is left, the attention of a query is zero.
            stop_gradient: ``(Q, S)`` bool, True where the query treats this key and its value as constants in
                the backward pass.
            return_weights: Whether to return the probabilities as well.

        Returns:
            ``(B, Q, width)``, and the probabilities ``(B, heads, Q, S)`` or None.
        """
        q = self.split_heads(self.to_q(x))  # (B, heads, Q, head_dim)
        k = self.split_heads(self.to_k(context))  # (B, heads, S, head_dim)
        v = self.split_heads(self.to_v(context))  # (B, heads, S, head_dim)
        if stop_gradient is None and not return_weights:
            weights, values = None, fused_attention(q, k, v, logit_bias)
        else:
            weights = attention_weights(q, k, logit_bias, stop_gradient)  # (B, heads, Q, S)
            values = attention_values(weights, v, stop_gradient)  # (B, heads, Q, head_dim)
        return self.to_out[0](values.transpose(1, 2).flatten(2)), weights  # (B, Q, width)

    def split_heads(self, x: Tensor) -> Tensor:
        """``(B, S, heads * head_dim)`` to ``(B, heads, S, head_dim)``."""
        return x.unflatten(-1, (self.num_heads, self.head_dim)).transpose(1, 2)


def attention_weights(
    q: Tensor, k: Tensor, logit_bias: Tensor | None, stop_gradient: Tensor | None = None
) -> Tensor:
    """softmax(q k^T / sqrt(head_dim) + bias), or zeros if no key is left.

    Args:
        q: ``(B, heads, Q, head_dim)``.
        k: ``(B, heads, S, head_dim)``.
        logit_bias: Broadcast to ``(B, heads, Q, S)``, or None.
        stop_gradient: ``(Q, S)`` bool, True where the key is a constant; or None.

    Returns:
        ``(B, heads, Q, S)``.
    """
    logits = q @ k.transpose(-1, -2)  # (B, heads, Q, S)
    if stop_gradient is not None:
        logits = torch.where(stop_gradient, q @ k.detach().transpose(-1, -2), logits)
    logits = logits / math.sqrt(q.shape[-1])
    if logit_bias is None:
        return torch.softmax(logits, dim=-1)
    bias, nothing_left = split_bias(logit_bias)
    weights = torch.softmax(logits + bias.to(logits.dtype), dim=-1)
    return weights.masked_fill(nothing_left, 0.0)


def fused_attention(q: Tensor, k: Tensor, v: Tensor, logit_bias: Tensor | None) -> Tensor:
    """The sums of ``attention_weights`` and ``attention_values`` by torch's own kernel: faster in training.

    Under autocast on a CPU it computes in float32 all the same: there the kernel takes 2 to 4 times as long
    in bfloat16 (torch 2.13, Zen 4, 32 x 4 heads of 17 to 92 rows).

    Args:
        q: ``(B, heads, Q, head_dim)``.
        k, v: ``(B, heads, S, head_dim)``.
        logit_bias: Broadcast to ``(B, heads, Q, S)``, or None.

    Returns:
        ``(B, heads, Q, head_dim)``.
    """
    if q.dtype == torch.bfloat16 and q.device.type == "cpu" and torch.is_autocast_enabled("cpu"):
        with torch.autocast("cpu", enabled=False):
            return fused_attention(q.float(), k.float(), v.float(), logit_bias)
    if logit_bias is None:
        return F.scaled_dot_product_attention(q, k, v)
    bias, nothing_left = split_bias(logit_bias)
    bias = bias.to(q.dtype).expand(*q.shape[:-1], k.shape[-2])
    return F.scaled_dot_product_attention(q, k, v, attn_mask=bias).masked_fill(nothing_left, 0.0)


def split_bias(logit_bias: Tensor) -> tuple[Tensor, Tensor]:
    """The bias with zeros for queries that no key is left to, and which these are, ``(..., 1)`` bool.

    Their softmax would be NaN, and so would be its gradient even if the value is replaced. Found in the bias,
    which mostly is much smaller than the scores.
    """
    nothing_left = torch.isneginf(logit_bias).all(dim=-1, keepdim=True)
    return logit_bias.masked_fill(nothing_left, 0.0), nothing_left


def attention_values(weights: Tensor, v: Tensor, stop_gradient: Tensor | None) -> Tensor:
    """The mean of the values, weighted by the probabilities.

    Args:
        weights: ``(B, heads, Q, S)``.
        v: ``(B, heads, S, head_dim)``.
        stop_gradient: ``(Q, S)`` bool, True where the value is a constant; or None.

    Returns:
        ``(B, heads, Q, head_dim)``.
    """
    if stop_gradient is None:
        return weights @ v
    constant = v.detach()
    # The second product is zero. It has the gradient to `v`, and the first one has that to the weights.
    return weights @ constant + weights.masked_fill(stop_gradient, 0.0) @ (v - constant)
