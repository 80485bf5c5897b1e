"""Qwen3, the language model of all backbones. Module names follow the checkpoint.

Shapes in comments: B is the batch, T the tokens of a prompt.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade_lab.backbone_sizes import TextSizes
from saccade_lab.reference.backbone.attention import attend, split_heads
from saccade_lab.reference.backbone.rotary import rotate
from saccade_lab.reference.backbone.tables import embedding


class RmsNorm(nn.Module):
    """Divides by the root mean square of the last axis, then scales."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        """``(..., width)`` to the same shape."""
        return self.weight * (x * torch.rsqrt(x.square().mean(dim=-1, keepdim=True) + self.eps))


class SelfAttention(nn.Module):
    """Causal attention whose query heads share fewer key heads.

    Queries and keys of each head are normalised before they are rotated.
    """

    def __init__(self, sizes: TextSizes) -> None:
        super().__init__()
        self.head_dim = sizes.head_dim
        self.queries_per_key = sizes.num_heads // sizes.num_key_heads
        queries, keys = sizes.num_heads * sizes.head_dim, sizes.num_key_heads * sizes.head_dim
        self.q_proj = nn.Linear(sizes.width, queries, bias=False)
        self.k_proj = nn.Linear(sizes.width, keys, bias=False)
        self.v_proj = nn.Linear(sizes.width, keys, bias=False)
        self.o_proj = nn.Linear(queries, sizes.width, bias=False)
        self.q_norm = RmsNorm(sizes.head_dim, sizes.eps)
        self.k_norm = RmsNorm(sizes.head_dim, sizes.eps)

    def forward(self, x: Tensor, angles: Tensor, allowed: Tensor) -> Tensor:
        """``x (B, T, width)``, ``angles (B, T, head_dim / 2)``, bool ``allowed (B, T, T)``; to its shape."""
        angles = angles[:, None]  # the same for all heads
        q = rotate(self.q_norm(split_heads(self.q_proj(x), self.head_dim)), angles)  # (B, heads, T, head_dim)
        k = rotate(self.k_norm(split_heads(self.k_proj(x), self.head_dim)), angles)  # (B, key heads, T, ...)
        v = split_heads(self.v_proj(x), self.head_dim)
        k = k.repeat_interleave(self.queries_per_key, dim=1)  # (B, heads, T, head_dim)
        v = v.repeat_interleave(self.queries_per_key, dim=1)
        return self.o_proj(attend(q, k, v, allowed[:, None]))


class Mlp(nn.Module):
    """A linear layer gated by SiLU of another, and a third one."""

    def __init__(self, sizes: TextSizes) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(sizes.width, sizes.mlp_width, bias=False)
        self.up_proj = nn.Linear(sizes.width, sizes.mlp_width, bias=False)
        self.down_proj = nn.Linear(sizes.mlp_width, sizes.width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """``(..., width)`` to the same shape."""
        return self.down_proj(F.silu(self.gate_proj(x)) * self.up_proj(x))


class DecoderLayer(nn.Module):
    """Attention and feed-forward layer, each after an RMSNorm and with a residual."""

    def __init__(self, sizes: TextSizes) -> None:
        super().__init__()
        self.input_layernorm = RmsNorm(sizes.width, sizes.eps)
        self.self_attn = SelfAttention(sizes)
        self.post_attention_layernorm = RmsNorm(sizes.width, sizes.eps)
        self.mlp = Mlp(sizes)

    def forward(self, x: Tensor, angles: Tensor, allowed: Tensor) -> Tensor:
        """``x (B, T, width)`` to the same shape; the others are as in ``SelfAttention``."""
        x = x + self.self_attn(self.input_layernorm(x), angles, allowed)
        return x + self.mlp(self.post_attention_layernorm(x))


class Decoder(nn.Module):
    """The table of tokens and the computed layers, with a last norm (N1.5, N1.6) or without (N1.7)."""

    def __init__(self, sizes: TextSizes, num_layers: int, *, last_norm: bool) -> None:
        super().__init__()
        self.embed_tokens = embedding(sizes.vocabulary, sizes.width)
        self.layers = nn.ModuleList(DecoderLayer(sizes) for _ in range(num_layers))
        if last_norm:
            self.norm = RmsNorm(sizes.width, sizes.eps)

    def forward(
        self,
        x: Tensor,
        angles: Tensor,
        attention_mask: Tensor,
        after_layer: Callable[[int, Tensor], Tensor] = lambda _, x: x,
    ) -> Tensor:
        """The hidden state behind the last layer.

        Args:
            x: Embedded tokens and image tokens, ``(B, T, width)``.
            angles: Rotary angles, ``(B, T, head_dim / 2)``.
            attention_mask: Bool ``(B, T)``; no token attends to the others.
            after_layer: Replaces the output of a layer, given its index.

        Returns:
            ``(B, T, width)``.
        """
        num_tokens = x.shape[1]
        causal = torch.ones(num_tokens, num_tokens, dtype=torch.bool, device=x.device).tril()  # (T, T)
        allowed = causal & attention_mask[:, None, :]  # (B, T, T)
        for index, layer in enumerate(self.layers):
            x = after_layer(index, layer(x, angles, allowed))
        return self.norm(x) if hasattr(self, "norm") else x


class LanguageModel(nn.Module):
    """The level of N1.5's and N1.6's names above the decoder."""

    def __init__(self, sizes: TextSizes, num_layers: int) -> None:
        super().__init__()
        self.model = Decoder(sizes, num_layers, last_norm=True)
