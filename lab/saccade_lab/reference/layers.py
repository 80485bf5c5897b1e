"""The layers of the head, as torch modules whose names follow the checkpoint.

Shapes in comments: B is the batch, R the rows of the query sequence (H state rows, N future rows, T action
rows), S the vision-language tokens.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade.head.config import HeadConfig
from saccade_lab.reference import tables
from saccade_lab.reference.attention import Attention
from saccade_lab.reference.intervene import BlockChange
from saccade_lab.reference.masks import is_cross

NORM_EPS = 1e-5  # every LayerNorm except the last
OUTPUT_NORM_EPS = 1e-6  # the last one
TABLE_STD = 0.02  # initial standard deviation of learned tokens, positions and category-specific weights
UNCHANGED = BlockChange()


class GeluLinear(nn.Module):
    """Linear, then GELU with the tanh approximation."""

    def __init__(self, in_features: int, out_features: int) -> None:
        super().__init__()
        self.proj = nn.Linear(in_features, out_features)

    def forward(self, x: Tensor) -> Tensor:
        """``(..., in_features)`` to ``(..., out_features)``."""
        return F.gelu(self.proj(x), approximate="tanh")


class FeedForward(nn.Module):
    """width -> 4 width -> width. Index 1 of the list is dropout in the released code."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.net = nn.ModuleList([GeluLinear(width, 4 * width), nn.Identity(), nn.Linear(4 * width, width)])

    def forward(self, x: Tensor) -> Tensor:
        """``(..., width)`` to the same shape."""
        for layer in self.net:
            x = layer(x)
        return x


class VlBlock(nn.Module):
    """Self-attention among the vision-language tokens: pre-norm, without mask and positions."""

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        width = config.context_dim
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn1 = Attention(width, width, config.vl_num_heads, config.vl_head_dim)
        self.norm3 = nn.LayerNorm(width, eps=NORM_EPS)
        self.ff = FeedForward(width)

    def forward(self, x: Tensor, logit_bias: Tensor | None = None) -> Tensor:
        """``x (B, S, context_dim)`` to the same shape; the bias is as in ``Attention``."""
        y = self.norm1(x)
        attended, _ = self.attn1(y, y, logit_bias=logit_bias)
        x = x + attended
        return x + self.ff(self.norm3(x))


class VlSelfAttention(nn.Module):
    """The self-attention blocks of the vision-language tokens, computed once per observation."""

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        self.transformer_blocks = nn.ModuleList(VlBlock(config) for _ in range(config.vl_num_layers))

    def forward(self, x: Tensor, logit_bias: Tensor | None = None) -> Tensor:
        """``x (B, S, context_dim)`` to the same shape; the bias is as in ``Attention``."""
        for block in self.transformer_blocks:
            x = block(x, logit_bias)
        return x


class AdaptiveNorm(nn.Module):
    """LayerNorm with scale and shift from the time embedding, in this order."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, 2 * width)

    def forward(self, x: Tensor, temb: Tensor) -> Tensor:
        """``x (B, R, width)``, ``temb (B, width)``; returns ``(B, R, width)``."""
        scale, shift = self.linear(F.silu(temb))[:, None].chunk(2, dim=-1)  # (B, 1, width) each
        return plain_norm(x, NORM_EPS) * (1 + scale) + shift


def plain_norm(x: Tensor, eps: float) -> Tensor:
    """LayerNorm over the last axis without scale and shift."""
    return F.layer_norm(x, x.shape[-1:], eps=eps)


class DiTBlock(nn.Module):
    """Attention (to the vision-language tokens, or among the rows) and a feed-forward layer."""

    def __init__(self, config: HeadConfig, is_cross: bool) -> None:
        super().__init__()
        self.is_cross = is_cross
        context_dim = config.context_dim if is_cross else config.width
        self.norm1 = AdaptiveNorm(config.width)
        self.attn1 = Attention(config.width, context_dim, config.num_heads, config.head_dim)
        self.ff = FeedForward(config.width)

    def forward(self, rows: Tensor, vl_embs: Tensor, temb: Tensor, change: BlockChange = UNCHANGED) -> Tensor:
        """``rows (B, R, width)``, ``vl_embs (B, S, context_dim)``, ``timestep (B,)``; to ``(B, R, hidden)``.

        The caller applies what ``change`` does after the block.
        """
        y = self.norm1(rows, temb)
        attended, weights = self.attn1(
            y,
            vl_embs if self.is_cross else change.all_rows(y),
            logit_bias=change.logit_bias,
            stop_gradient=change.stop_gradient,
            return_weights=change.keep_attention is not None,
        )
        if change.keep_attention is not None:
            change.keep_attention(weights)
        rows = rows + attended
        return rows + self.ff(plain_norm(rows, NORM_EPS))  # this norm does not depend on the time


class TimestepEmbedder(nn.Module):
    """256 sinusoids -> width -> width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(tables.TIMESTEP_CHANNELS, width)
        self.linear_2 = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, 256)`` to ``(B, width)``."""
        return self.linear_2(F.silu(self.linear_1(x)))


class TimestepEncoder(nn.Module):
    """The time embedding of the adaptive norms."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.timestep_embedder = TimestepEmbedder(width)

    def forward(self, timestep: Tensor) -> Tensor:
        """Buckets ``(B,)`` to ``(B, width)``."""
        dtype = self.timestep_embedder.linear_1.weight.dtype
        return self.timestep_embedder(tables.timestep_table(timestep).to(dtype))


class DiffusionTransformer(nn.Module):
    """Even blocks attend to the vision-language tokens, odd blocks are self-attention of the rows."""

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        self.timestep_encoder = TimestepEncoder(config.width)
        self.transformer_blocks = nn.ModuleList(
            DiTBlock(config, is_cross=is_cross(config, block)) for block in range(config.num_layers)
        )
        self.proj_out_1 = nn.Linear(config.width, 2 * config.width)
        self.proj_out_2 = nn.Linear(config.width, config.hidden_dim)

    def forward(
        self, rows: Tensor, vl_embs: Tensor, timestep: Tensor, changes: Iterable[BlockChange]
    ) -> Tensor:
        """``rows (B, R, width)``, ``vl_embs (B, S, context_dim)``, ``temb (B, width)``; to ``rows``' shape.

        ``changes`` has one entry for each block.
        """
        temb = self.timestep_encoder(timestep)  # (B, width)
        for block, change in zip(self.transformer_blocks, changes, strict=True):
            rows = change.after(block(rows, vl_embs, temb, change))
        return self.output(rows, temb)

    def output(self, rows: Tensor, temb: Tensor) -> Tensor:
        """The last norm and projection. Here the shift comes first, unlike in the blocks."""
        shift, scale = self.proj_out_1(F.silu(temb))[:, None].chunk(2, dim=-1)  # (B, 1, width) each
        return self.proj_out_2(plain_norm(rows, OUTPUT_NORM_EPS) * (1 + scale) + shift)  # (B, R, hidden_dim)


class CategoryLinear(nn.Module):
    """One linear layer per embodiment. Weights are stored as ``(category, in, out)``, not transposed."""

    def __init__(self, num_categories: int, in_features: int, out_features: int) -> None:
        super().__init__()
        self.W = nn.Parameter(torch.randn(num_categories, in_features, out_features).mul_(TABLE_STD))
        self.b = nn.Parameter(torch.zeros(num_categories, out_features))

    def forward(self, x: Tensor, embodiment_id: int | Tensor) -> Tensor:
        """``x (B, rows, in_features)``, an int or ``(B,)``; returns ``(B, rows, out_features)``."""
        if isinstance(embodiment_id, int):
            return x @ self.W[embodiment_id] + self.b[embodiment_id]
        return torch.bmm(x, self.W[embodiment_id]) + self.b[embodiment_id][:, None]


class CategoryMlp(nn.Module):
    """Two category-specific layers with ReLU between them."""

    def __init__(self, num_categories: int, in_features: int, hidden_dim: int, out_features: int) -> None:
        super().__init__()
        self.layer1 = CategoryLinear(num_categories, in_features, hidden_dim)
        self.layer2 = CategoryLinear(num_categories, hidden_dim, out_features)

    def forward(self, x: Tensor, embodiment_id: int | Tensor) -> Tensor:
        """``(B, rows, in_features)`` to ``(B, rows, out_features)``."""
        return self.layer2(F.relu(self.layer1(x, embodiment_id)), embodiment_id)


class ActionEncoder(nn.Module):
    """Encodes noisy actions and the time bucket as action rows."""

    def __init__(self, num_categories: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.W1 = CategoryLinear(num_categories, action_dim, width)
        self.W2 = CategoryLinear(num_categories, 2 * width, width)
        self.W3 = CategoryLinear(num_categories, width, width)

    def forward(self, actions: Tensor, timestep: Tensor, embodiment_id: int | Tensor) -> Tensor:
        """``actions (B, T, action_dim)``, ``timestep (B,)``; returns ``(B, T, width)``."""
        a = self.W1(actions, embodiment_id)  # (B, T, width)
        tau = tables.action_time_table(timestep, self.width).to(a.dtype)  # (B, width)
        z = torch.cat((a, tau[:, None].expand_as(a)), dim=-1)  # (B, T, 2 width)
        return self.W3(F.silu(self.W2(z, embodiment_id)), embodiment_id)


def token_table(num_rows: int, width: int) -> nn.Embedding:
    """Learned rows, ``(num_rows, width)``. There may be none."""
    return nn.Embedding(num_rows, width, _weight=torch.randn(num_rows, width).mul_(TABLE_STD))
