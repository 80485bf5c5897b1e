"""The GR00T action heads as one torch module that reads from top to bottom: N1, N1.5, N1.6, N1.7 and a fork.

They are one head with other sizes and switches. Module names follow the checkpoint, so that `state_dict()`
has the released tensor names. Shapes in comments:
B is the batch, R the rows of the query sequence (one state row, N future rows, T action rows), S the
vision-language tokens.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade._arrays import integer
from saccade.chunking import Chunking
from saccade.config import HeadConfig
from saccade.errors import InputError
from saccade.integrator import INTEGRATORS, check_integrator
from saccade.intervention import Intervention, Tokens
from saccade.reference import loading, tables
from saccade.reference.checks import check_shape
from saccade.reference.intervene import BlockChange, Mask, Run, is_cross, removal_bias, token_mask
from saccade.trace import Trace

NORM_EPS = 1e-5  # every LayerNorm but the last
OUTPUT_NORM_EPS = 1e-6  # the last one
TABLE_STD = 0.02  # initial scale of learned tokens, positions and category-specific weights
SLOWEST_RAMP = 1e-9  # a ramp of this rate is a straight line to nine digits, and a slower one could underflow
UNCHANGED = BlockChange()

MASK_TOKEN = "mask_token"  # N1.6: what stands in for a state that is left out in training
DROPOUT_PROB = "dropout_prob_by_embodiment"  # of the state, in a fine-tune of N1.7
LOG_SIGMA = "task_log_sigma."  # the fork: learned weights of its decoders' losses


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
        """Lets the rows of `x` read those of `context`.

        Args:
            x: `(B, Q, width)`.
            context: `(B, S, context_dim)`.
            logit_bias: added to the scaled scores, broadcast to `(B, heads, Q, S)`; minus infinity removes a
                key. A query with no key left gets zeros from the attention.
            stop_gradient: `(Q, S)` bool; where true, the query takes this key and its value as constants in
                the backward pass.
            return_weights: also return the probabilities.

        Returns:
            `(B, Q, width)`, and the probabilities `(B, heads, Q, S)` or None.
        """
        q = self.split_heads(self.to_q(x))  # (B, heads, Q, head_dim)
        k = self.split_heads(self.to_k(context))  # (B, heads, S, head_dim)
        v = self.split_heads(self.to_v(context))  # (B, heads, S, head_dim)
        if logit_bias is None and stop_gradient is None and not return_weights:
            weights, values = None, F.scaled_dot_product_attention(q, k, v)  # the same sums, faster to train
        else:
            weights = attention_weights(q, k, logit_bias, stop_gradient)  # (B, heads, Q, S)
            values = attention_values(weights, v, stop_gradient)  # (B, heads, Q, head_dim)
        return self.to_out[0](values.transpose(1, 2).flatten(2)), weights  # (B, Q, width)

    def split_heads(self, x: Tensor) -> Tensor:
        """`(B, S, heads * head_dim)` to `(B, heads, S, head_dim)`."""
        return x.unflatten(-1, (self.num_heads, self.head_dim)).transpose(1, 2)


def attention_weights(
    q: Tensor, k: Tensor, logit_bias: Tensor | None, stop_gradient: Tensor | None = None
) -> Tensor:
    """softmax(q k^T / sqrt(head_dim) + bias), and zeros where no key is left.

    Args:
        q: `(B, heads, Q, head_dim)`.
        k: `(B, heads, S, head_dim)`.
        logit_bias: broadcast to `(B, heads, Q, S)`, or None.
        stop_gradient: `(Q, S)` bool, True where the key is a constant; or None.

    Returns:
        `(B, heads, Q, S)`.
    """
    logits = q @ k.transpose(-1, -2)  # (B, heads, Q, S)
    if stop_gradient is not None:
        logits = torch.where(stop_gradient, q @ k.detach().transpose(-1, -2), logits)
    logits = logits / math.sqrt(q.shape[-1])
    if logit_bias is None:
        return torch.softmax(logits, dim=-1)
    logits = logits + logit_bias.to(logits.dtype)
    nothing_left = torch.isneginf(logits).all(dim=-1, keepdim=True)  # (B, heads, Q, 1)
    # Filled before the softmax too: a row of nan would poison the gradient even where its value is replaced.
    return torch.softmax(logits.masked_fill(nothing_left, 0.0), dim=-1).masked_fill(nothing_left, 0.0)


def attention_values(weights: Tensor, v: Tensor, stop_gradient: Tensor | None) -> Tensor:
    """The probabilities' mean of the values.

    Args:
        weights: `(B, heads, Q, S)`.
        v: `(B, heads, S, head_dim)`.
        stop_gradient: `(Q, S)` bool, True where the value is a constant; or None.

    Returns:
        `(B, heads, Q, head_dim)`.
    """
    if stop_gradient is None:
        return weights @ v
    constant = v.detach()
    # The second product is zero. It carries the gradient to `v`, and the first one that to the weights.
    return weights @ constant + weights.masked_fill(stop_gradient, 0.0) @ (v - constant)


class GeluLinear(nn.Module):
    """Linear, then GELU in its tanh form."""

    def __init__(self, in_features: int, out_features: int) -> None:
        super().__init__()
        self.proj = nn.Linear(in_features, out_features)

    def forward(self, x: Tensor) -> Tensor:
        """`(..., in_features)` to `(..., out_features)`."""
        return F.gelu(self.proj(x), approximate="tanh")


class FeedForward(nn.Module):
    """width -> 4 width -> width; place 1 of the list holds dropout in the released code."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.net = nn.ModuleList([GeluLinear(width, 4 * width), nn.Identity(), nn.Linear(4 * width, width)])

    def forward(self, x: Tensor) -> Tensor:
        """`(..., width)` to the same shape."""
        for layer in self.net:
            x = layer(x)
        return x


class VlBlock(nn.Module):
    """Self-attention among the vision-language tokens, norm first, no mask, no positions."""

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        width = config.context_dim
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn1 = Attention(width, width, config.vl_num_heads, config.vl_head_dim)
        self.norm3 = nn.LayerNorm(width, eps=NORM_EPS)
        self.ff = FeedForward(width)

    def forward(self, x: Tensor, logit_bias: Tensor | None = None) -> Tensor:
        """`x (B, S, context_dim)`, a bias as in `Attention`; returns `(B, S, context_dim)`."""
        y = self.norm1(x)
        attended, _ = self.attn1(y, y, logit_bias=logit_bias)
        x = x + attended
        return x + self.ff(self.norm3(x))


class VlSelfAttention(nn.Module):
    """The blocks that mix the vision-language tokens once per observation."""

    def __init__(self, config: HeadConfig) -> None:
        super().__init__()
        self.transformer_blocks = nn.ModuleList(VlBlock(config) for _ in range(config.vl_num_layers))

    def forward(self, x: Tensor, logit_bias: Tensor | None = None) -> Tensor:
        """`x (B, S, context_dim)`, a bias as in `Attention`; returns `(B, S, context_dim)`."""
        for block in self.transformer_blocks:
            x = block(x, logit_bias)
        return x


class AdaptiveNorm(nn.Module):
    """LayerNorm whose scale and shift come from the time embedding: scale first, then shift."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, 2 * width)

    def forward(self, x: Tensor, temb: Tensor) -> Tensor:
        """`x (B, R, width)`, `temb (B, width)`; returns `(B, R, width)`."""
        scale, shift = self.linear(F.silu(temb))[:, None].chunk(2, dim=-1)  # (B, 1, width) each
        return plain_norm(x, NORM_EPS) * (1 + scale) + shift


def plain_norm(x: Tensor, eps: float) -> Tensor:
    """LayerNorm over the last axis without scale and shift."""
    return F.layer_norm(x, x.shape[-1:], eps=eps)


class DiTBlock(nn.Module):
    """One attention (to the context, or among the rows) and one feed-forward, without gates."""

    def __init__(self, config: HeadConfig, is_cross: bool) -> None:
        super().__init__()
        self.is_cross = is_cross
        context_dim = config.context_dim if is_cross else config.width
        self.norm1 = AdaptiveNorm(config.width)
        self.attn1 = Attention(config.width, context_dim, config.num_heads, config.head_dim)
        self.ff = FeedForward(config.width)

    def forward(self, rows: Tensor, vl_embs: Tensor, temb: Tensor, change: BlockChange = UNCHANGED) -> Tensor:
        """`rows (B, R, width)`, `vl_embs (B, S, context_dim)`, `temb (B, width)`; returns `(B, R, width)`.

        What `change` does after the block is left to the caller.
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
        return rows + self.ff(plain_norm(rows, NORM_EPS))  # this norm does not see the time


class TimestepEmbedder(nn.Module):
    """256 sinusoids -> width -> width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear_1 = nn.Linear(tables.TIMESTEP_CHANNELS, width)
        self.linear_2 = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """`(B, 256)` to `(B, width)`."""
        return self.linear_2(F.silu(self.linear_1(x)))


class TimestepEncoder(nn.Module):
    """The time embedding that steers the adaptive norms."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.timestep_embedder = TimestepEmbedder(width)

    def forward(self, timestep: Tensor) -> Tensor:
        """Buckets `(B,)` to `(B, width)`."""
        dtype = self.timestep_embedder.linear_1.weight.dtype
        return self.timestep_embedder(tables.timestep_table(timestep).to(dtype))


class DiffusionTransformer(nn.Module):
    """Blocks 0, 2, 4, ... read the vision-language tokens, blocks 1, 3, 5, ... the rows themselves."""

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
        """`rows (B, R, width)`, `vl_embs (B, S, context_dim)`, `timestep (B,)`; to `(B, R, hidden_dim)`.

        `changes` has one entry a block.
        """
        temb = self.timestep_encoder(timestep)  # (B, width)
        for block, change in zip(self.transformer_blocks, changes, strict=True):
            rows = change.after(block(rows, vl_embs, temb, change))
        return self.output(rows, temb)

    def output(self, rows: Tensor, temb: Tensor) -> Tensor:
        """The last norm and projection; here the shift comes first, other than in the blocks."""
        shift, scale = self.proj_out_1(F.silu(temb))[:, None].chunk(2, dim=-1)  # (B, 1, width) each
        return self.proj_out_2(plain_norm(rows, OUTPUT_NORM_EPS) * (1 + scale) + shift)  # (B, R, hidden_dim)


class CategoryLinear(nn.Module):
    """One linear layer per embodiment; weights are stored `(category, in, out)`, not transposed."""

    def __init__(self, num_categories: int, in_features: int, out_features: int) -> None:
        super().__init__()
        self.W = nn.Parameter(TABLE_STD * torch.randn(num_categories, in_features, out_features))
        self.b = nn.Parameter(torch.zeros(num_categories, out_features))

    def forward(self, x: Tensor, embodiment_id: int | Tensor) -> Tensor:
        """`x (B, rows, in_features)`, an int or `(B,)`; returns `(B, rows, out_features)`."""
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
        """`(B, rows, in_features)` to `(B, rows, out_features)`."""
        return self.layer2(F.relu(self.layer1(x, embodiment_id)), embodiment_id)


class ActionEncoder(nn.Module):
    """Noisy actions and the time bucket to action rows."""

    def __init__(self, num_categories: int, action_dim: int, width: int) -> None:
        super().__init__()
        self.width = width
        self.W1 = CategoryLinear(num_categories, action_dim, width)
        self.W2 = CategoryLinear(num_categories, 2 * width, width)
        self.W3 = CategoryLinear(num_categories, width, width)

    def forward(self, actions: Tensor, timestep: Tensor, embodiment_id: int | Tensor) -> Tensor:
        """`actions (B, T, action_dim)`, `timestep (B,)`; returns `(B, T, width)`."""
        a = self.W1(actions, embodiment_id)  # (B, T, width)
        tau = tables.action_time_table(timestep, self.width).to(a.dtype)  # (B, width)
        z = torch.cat((a, tau[:, None].expand_as(a)), dim=-1)  # (B, T, 2 width)
        return self.W3(F.silu(self.W2(z, embodiment_id)), embodiment_id)


@dataclass(frozen=True)
class TimeDistribution:
    """How training draws the flow time: `scale * (1 - b)` with `b ~ Beta(alpha, beta)`.

    This form, that of the later releases, stays within [0, scale]; most times are near 0, where the actions
    are mostly noise.
    """

    alpha: float = 1.5
    beta: float = 1.0
    scale: float = 0.999

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> "TimeDistribution":
        """Reads `noise_beta_alpha`, `noise_beta_beta`, `noise_s`; the released values where absent."""
        head = config.get("action_head_cfg", config)
        return cls(
            alpha=float(head.get("noise_beta_alpha", cls.alpha)),
            beta=float(head.get("noise_beta_beta", cls.beta)),
            scale=float(head.get("noise_s", cls.scale)),
        )


class ActionHead(nn.Module):
    """A GR00T action head in torch.

    Runs in the dtype of its parameters (`.double()` for float64) and is differentiable throughout; inputs are
    converted to that dtype, and may be NumPy arrays. Wrap calls in `torch.no_grad()` where no gradient is
    wanted. A new head has the released code's initial distribution. There is no dropout, and no state is left
    out or made noisy in training.

    Args:
        config: sizes and switches.
        time_distribution: how `sample_time` draws.
        unused: names of parameters to hold that only the released training uses, `task_log_sigma.NAME`,
            `mask_token` and `dropout_prob_by_embodiment`, so that a checkpoint stays whole.

    Example:
        >>> from saccade.reference import random_weights
        >>> head = random_weights.random_head(random_weights.small_config(), seed=0, dtype=torch.float64)
        >>> inputs = random_weights.random_inputs(head.config, seed=1, batch=2, num_vl_tokens=7)
        >>> vl_embs = head.encode(inputs["backbone_features"])
        >>> head.sample(vl_embs, inputs["state"], 2, noise=inputs["noise"]).shape
        torch.Size([2, 16, 32])

        What the action rows read of the 32 future rows in block 1 of the first Euler step:

        >>> trace = head.trace(vl_embs, inputs["state"], 2, noise=inputs["noise"])
        >>> trace.attention[0, 1][:, :, trace.rows["action"], trace.rows["future"]].shape
        torch.Size([2, 2, 16, 32])
    """

    def __init__(
        self,
        config: HeadConfig,
        *,
        time_distribution: TimeDistribution | None = None,
        unused: Iterable[str] = (),
    ) -> None:
        super().__init__()
        self.config = config
        self.time_distribution = time_distribution or TimeDistribution()
        categories, hidden, width = config.num_embodiments, config.hidden_dim, config.width
        self.model = DiffusionTransformer(config)
        self.state_encoder = CategoryMlp(categories, config.state_history * config.state_dim, hidden, width)
        self.action_encoder = ActionEncoder(categories, config.encoder_action_dim, width)
        for name, decoded in config.decoders:
            self.add_module(name, CategoryMlp(categories, hidden, hidden, decoded))
        if config.version == "n1.5":  # where they are, even if there are none
            self.future_tokens = token_table(config.num_future_tokens, width)
        if config.use_vlln:
            self.vlln = nn.LayerNorm(config.context_dim, eps=NORM_EPS)
        if config.vl_num_layers > 0:
            self.vl_self_attention = VlSelfAttention(config)
        if config.add_pos_embed:
            self.position_embedding = token_table(config.max_positions, width)
        for name in unused:
            self.hold_unused(name)

    @classmethod
    def load(
        cls,
        source: str | PathLike[str],
        *,
        config: Mapping[str, Any] | str | PathLike[str] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> "ActionHead":
        """Builds the head from a checkpoint.

        Args:
            source: a directory or a file in any layout that :meth:`saccade.ActionHead.load` reads, or the id
                of a repository in the local Hugging Face cache.
            config: the checkpoint's config or the head's own, as a dict or a path. By default `config.json`
                beside the file, or else the `config` entry of the one file's metadata.
            dtype: of the parameters; narrower ones are widened exactly.

        Raises:
            FileNotFoundError: a path that is not there.
            CheckpointError: no config; or tensors missing, unknown or of the wrong shape (all are listed).
        """
        checkpoint = loading.described(source, config)
        whole = checkpoint["head_config"]
        with torch.device("meta"):  # no memory and no time spent on an initialisation that is replaced
            head = cls(
                HeadConfig.from_dict(whole),
                time_distribution=TimeDistribution.from_dict(whole),
                unused=filter(is_unused, loading.tensor_names(checkpoint)),
            )
        shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
        head.load_state_dict(loading.read_tensors(checkpoint, shapes, dtype), assign=True)
        return head

    def hold_unused(self, name: str) -> None:
        """Adds a parameter that only the released training uses, as that code starts it."""
        if name == MASK_TOKEN:
            self.mask_token = nn.Parameter(TABLE_STD * torch.randn(1, 1, self.config.width))
        elif name == DROPOUT_PROB:
            self.register_buffer(DROPOUT_PROB, torch.zeros(self.config.num_embodiments))
        else:
            if not hasattr(self, "task_log_sigma"):
                self.task_log_sigma = nn.ParameterDict()
            self.task_log_sigma[name.removeprefix(LOG_SIGMA)] = nn.Parameter(torch.zeros(()))

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the parameters, in which everything is computed."""
        return self.model.proj_out_2.weight.dtype

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.model.proj_out_2.weight.device

    @property
    def learned_tokens(self) -> Tensor:
        """The future tokens, `(N, width)`; only N1.5 has any."""
        if self.config.version == "n1.5":
            return self.future_tokens.weight
        return torch.empty(0, self.config.width, dtype=self.dtype, device=self.device)

    def encode(self, backbone_features: Tensor | np.ndarray, *, drop_vl: Mask = None) -> Tensor:
        """Normalises and mixes the backbone's features, once per observation.

        Here every token reads every other one: the masks of N1.6 and N1.7 are for the blocks that follow.

        Args:
            backbone_features: `(B, S, context_dim)`.
            drop_vl: bool `(B, S)`, True where a token is removed, as if it had not been there. Its place is
                kept, with zeros, so `velocity`, `sample` and `trace` must be given `drop_vl` too.

        Returns:
            `vl_embs (B, S, context_dim)`; the features themselves where the head has neither `vlln` nor VL
            self-attention.
        """
        features = self.as_input(backbone_features)
        check_shape("backbone_features", features, (None, None, self.config.context_dim))
        removed = token_mask("drop_vl", drop_vl, features)
        if self.config.use_vlln:
            features = self.vlln(features)
        if self.config.vl_num_layers > 0:
            bias = None if removed is None else removal_bias(removed, self.dtype)
            features = self.vl_self_attention(features, bias)
        return features if removed is None else features.masked_fill(removed[..., None], 0.0)

    def velocity(
        self,
        vl_embs: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        actions: Tensor | np.ndarray,
        timestep: int | Tensor | np.ndarray,
        *,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
    ) -> Tensor:
        """The flow's velocity at noisy actions.

        Args:
            vl_embs: `(B, S, context_dim)`, from `encode`.
            state: `(B, state_dim)` or `(B, history, state_dim)`, normalised and padded.
            embodiment_id: an int, or `(B,)`.
            actions: `(B, T, encoder_action_dim)`.
            timestep: time bucket, an int or `(B,)`.
            drop_vl, attention_mask, image_mask, intervention, stop_gradient: as in `trace`; this is step 0 of
                1.

        Returns:
            `(B, T, action_dim)`.

        Raises:
            ShapeError: an array of another shape.
            InputError: an embodiment, or a place of an intervention, that the head does not have.
        """
        vl_embs = self.as_input(vl_embs)
        check_shape("vl_embs", vl_embs, (None, None, self.config.context_dim))
        run = Run(
            self.config,
            vl_embs,
            num_steps=1,
            intervention=intervention,
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            stop_gradient=stop_gradient,
        )
        return self.velocity_in(run, 0, vl_embs, state, embodiment_id, actions, timestep)

    def velocity_in(
        self,
        run: Run,
        evaluation: int,
        vl_embs: Tensor,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        actions: Tensor | np.ndarray,
        timestep: int | Tensor | np.ndarray,
    ) -> Tensor:
        """`velocity` number `evaluation` of a run, of which only those rows run that the run says."""
        config, horizon = self.config, self.config.action_horizon
        actions, state = self.as_input(actions), self.as_input(state)
        batch = vl_embs.shape[0]
        check_shape("actions", actions, (batch, horizon, config.encoder_action_dim))
        state = state[:, None] if state.ndim == 2 else state
        check_shape("state", state, (batch, config.state_history, config.state_dim))
        state = state.flatten(1)[:, None]  # (B, 1, history * state_dim)
        embodiment_id = self.as_embodiment(embodiment_id, batch)
        timestep = torch.as_tensor(timestep, device=self.device).expand(batch)  # (B,)

        state_row = self.state_encoder(state, embodiment_id)  # (B, 1, width)
        tokens = self.learned_tokens if run.future_tokens is None else run.future_tokens  # (N, width)
        future_rows = tokens.expand(batch, -1, -1)  # (B, N, width)
        action_rows = self.action_encoder(actions, timestep, embodiment_id)  # (B, T, width)
        if config.add_pos_embed:
            action_rows = action_rows + self.position_embedding.weight[:horizon]
        rows = torch.cat((state_row, future_rows, action_rows), dim=1)  # (B, R, width)

        changes = [run.change(evaluation, block) for block in range(config.num_layers)]
        hidden = self.model(rows[:, run.first_row(evaluation) :], vl_embs, timestep, changes)[
            :, -horizon:
        ]  # (B, T, hidden_dim)
        decoded = [self.get_submodule(name)(hidden, embodiment_id) for name, _ in config.decoders]
        return torch.cat(decoded, dim=-1)  # (B, T, action_dim)

    def sample(
        self,
        vl_embs: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        num_steps: int | None = None,
        integrator: str | None = None,
        future_refresh: int | None = None,
        previous_chunk: Tensor | np.ndarray | None = None,
        chunking: Chunking | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
    ) -> Tensor:
        """Follows the flow from noise (time 0) to actions (time 1) in equal Euler steps.

        Args:
            vl_embs, state, embodiment_id: as in `velocity`.
            noise: `(B, T, encoder_action_dim)`, standard normal.
            num_steps: default as the config says.
            integrator: "euler" (default), or "midpoint", whose steps evaluate the velocity twice.
            future_refresh: the rows of state and future tokens run at every so many evaluations of the
                velocity only, from the first one on. At the others self-attention reads them as it last did.
                Default: at all.
            previous_chunk: the chunk that is being carried out, `(B, T, action_dim)` or `(B, T,
                encoder_action_dim)`, normalised as it left the head; with `chunking`, whose `horizon` is the
                least number of its actions.
            chunking: how this chunk goes on from the previous one. The flow that is followed is slowed down
                by `velocity_strength`, in both evaluations of a midpoint step.
            drop_vl, attention_mask, image_mask, intervention, stop_gradient: as in `trace`. All evaluations
                of a step are that step. A patch of rows at a step at which they do not always run is an
                error.

        Returns:
            Actions `(B, T, action_dim)`, normalised.
        """
        vl_embs = self.as_input(vl_embs)
        run = self.run_of(
            vl_embs,
            num_steps,
            in_step=INTEGRATORS[check_integrator(integrator)],
            future_refresh=1 if future_refresh is None else integer("future_refresh", future_refresh),
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            intervention=intervention,
            stop_gradient=stop_gradient,
        )
        start, strength = self.as_input(noise), None
        if (previous_chunk is None) != (chunking is None):
            raise InputError("previous_chunk, chunking: one of them, expected both or neither")
        if previous_chunk is not None and chunking is not None:
            start = self.continued(start, self.as_input(previous_chunk), chunking)
            strength = self.as_input(velocity_strength(chunking, self.config.action_horizon))[:, None]
        return self.follow(run, vl_embs, state, embodiment_id, start, strength)

    def trace(
        self,
        vl_embs: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        num_steps: int | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
        record: Iterable[str] = ("attention",),
        blocks: Sequence[int] | int | None = None,
        steps: Sequence[int] | int | None = None,
    ) -> Trace[Tensor]:
        """`sample`, and what happened inside; all of it is part of the graph of gradients.

        The gradient with some edges stopped is the sum over all paths from the result back to an input that
        use none of them. With `[("state", "future"), ("action", "future")]` it is what does not pass through
        future rows, and the total less that is what does.

        Args:
            vl_embs, state, embodiment_id, noise, num_steps: as in `sample`.
            drop_vl: bool `(B, S)`, as given to `encode`: no row reads these tokens.
            attention_mask: bool `(B, S)`, True where a token is attended; default everywhere. A head that
                ignores padding takes an all-true one only.
            image_mask: bool `(B, S)`, True where a token is of an image. N1.6 and N1.7 need it: their
                cross-attention blocks read attended text and attended images in turn.
            intervention: one or several :class:`saccade.Intervention`.
            stop_gradient: pairs (reader, source) as in `Intervention.cut`, in all blocks, steps and heads.
                The result stays as it is (to rounding), but in the backward pass the reader's rows take the
                source's keys and values as constants.
            record: what is kept, any of "attention" and "hidden".
            blocks: where it is kept; default in all blocks.
            steps: when it is kept; default at all Euler steps.

        Returns:
            Attention probabilities, rows after the blocks, and the actions: those of `sample`, to rounding.

        Raises:
            ShapeError, DtypeError: an array that does not fit.
            InputError: a value out of range, an intervention that does not fit the head.
        """
        vl_embs = self.as_input(vl_embs)
        run = self.run_of(
            vl_embs,
            num_steps,
            intervention=intervention,
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            stop_gradient=stop_gradient,
            record=record,
            blocks=blocks,
            steps=steps,
        )
        actions = self.follow(run, vl_embs, state, embodiment_id, self.as_input(noise))
        return Trace(attention=run.attention, hidden=run.hidden, rows=run.rows, actions=actions)

    def run_of(self, vl_embs: Tensor, num_steps: int | None, **options: Any) -> Run:
        """The run of so many Euler steps, with the other arguments of `Run`."""
        config = self.config
        num_steps = config.num_steps if num_steps is None else integer("num_steps", num_steps)
        if not 1 <= num_steps <= config.num_timestep_buckets:
            raise InputError(f"num_steps: {num_steps}, expected 1 to {config.num_timestep_buckets}")
        check_shape("vl_embs", vl_embs, (None, None, config.context_dim))
        return Run(config, vl_embs, num_steps=num_steps, **options)

    def follow(
        self,
        run: Run,
        vl_embs: Tensor,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        start: Tensor,
        strength: Tensor | None = None,
    ) -> Tensor:
        """The steps of `sample` from `start (B, T, encoder_action_dim)`; to `(B, T, action_dim)`.

        `strength (T, 1)` multiplies the velocity. A head that decodes fewer dimensions than it encodes keeps
        the others at 0.
        """
        config = self.config
        check_shape("noise", start, (len(vl_embs), config.action_horizon, config.encoder_action_dim))
        rest = (0, config.encoder_action_dim - config.action_dim)

        def velocity(evaluation: int, actions: Tensor) -> Tensor:
            time = evaluation / (run.num_steps * run.in_step)
            bucket = int(time * config.num_timestep_buckets)
            direction = self.velocity_in(run, evaluation, vl_embs, state, embodiment_id, actions, bucket)
            return F.pad(direction if strength is None else strength * direction, rest)

        actions = F.pad(start[..., : config.action_dim], rest)
        for step in range(run.num_steps):
            direction = velocity(step * run.in_step, actions)
            if run.in_step == 2:  # the midpoint rule
                direction = velocity(2 * step + 1, actions + direction / (2 * run.num_steps))
            actions = actions + direction / run.num_steps
        return actions[..., : config.action_dim]

    def continued(self, start: Tensor, previous: Tensor, chunking: Chunking) -> Tensor:
        """`start (B, T, encoder_action_dim)` with the tail of the previous chunk as its first actions."""
        config = self.config
        horizon = config.action_horizon if chunking.horizon is None else chunking.horizon
        if not chunking.overlap <= horizon <= config.action_horizon:
            raise InputError(
                f"chunking: overlap {chunking.overlap}, horizon {horizon}, expected overlap <= horizon <= "
                f"{config.action_horizon}"
            )
        dims = config.action_dim if previous.shape[-1] == config.action_dim else config.encoder_action_dim
        rows = previous.shape[1] if previous.ndim == 3 else None
        rows = rows if rows in range(horizon, config.action_horizon) else config.action_horizon
        check_shape("previous_chunk", previous, (len(start), rows, dims))
        previous = F.pad(previous, (0, config.encoder_action_dim - dims))
        tail = previous[:, horizon - chunking.overlap : horizon]  # (B, overlap, encoder_action_dim)
        return torch.cat((tail, start[:, chunking.overlap :]), dim=1)

    def forward(
        self,
        backbone_features: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        num_steps: int | None = None,
        integrator: str | None = None,
        future_refresh: int | None = None,
        previous_chunk: Tensor | np.ndarray | None = None,
        chunking: Chunking | None = None,
        drop_vl: Mask = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        stop_gradient: Sequence[tuple[Tokens, Tokens]] = (),
    ) -> Tensor:
        """`encode`, then `sample`."""
        return self.sample(
            self.encode(backbone_features, drop_vl=drop_vl),
            state,
            embodiment_id,
            noise=noise,
            num_steps=num_steps,
            integrator=integrator,
            future_refresh=future_refresh,
            previous_chunk=previous_chunk,
            chunking=chunking,
            drop_vl=drop_vl,
            attention_mask=attention_mask,
            image_mask=image_mask,
            intervention=intervention,
            stop_gradient=stop_gradient,
        )

    def sample_time(self, batch: int, generator: torch.Generator | None = None) -> Tensor:
        """Draws flow times for training.

        Args:
            batch: how many.
            generator: default torch's own.

        Returns:
            `(batch,)`, in [0, scale].
        """
        # torch's Beta takes no generator, so the generator seeds NumPy's.
        seed = int(torch.randint(2**63 - 1, (), generator=generator))
        law = self.time_distribution
        drawn = np.random.default_rng(seed).beta(law.alpha, law.beta, size=batch)
        return torch.as_tensor(law.scale * (1.0 - drawn), dtype=self.dtype, device=self.device)

    def loss(
        self,
        backbone_features: Tensor | np.ndarray,
        state: Tensor | np.ndarray,
        embodiment_id: int | Tensor | np.ndarray,
        actions: Tensor | np.ndarray,
        *,
        noise: Tensor | np.ndarray,
        time: Tensor | np.ndarray,
        action_mask: Tensor | np.ndarray | None = None,
        attention_mask: Mask = None,
        image_mask: Mask = None,
    ) -> Tensor:
        """Flow-matching loss: on the way from noise to actions the velocity should be `actions - noise`.

        Dimensions that the head encodes and does not decode are 0, as in `sample`, and all decoders weigh the
        same: a fork that learns the weights of its decoders (`task_log_sigma`) trains them differently.

        Args:
            backbone_features: `(B, S, context_dim)`.
            state, embodiment_id: as in `velocity`.
            actions: the demonstrated chunk, `(B, T, action_dim)`, normalised.
            noise: the same shape, standard normal.
            time: `(B,)`, from `sample_time`.
            action_mask: broadcast to `actions`; weights of the mean of squared errors. Default: all the same.
            attention_mask, image_mask: as in `trace`.

        Returns:
            A scalar.
        """
        actions, noise, time = self.as_input(actions), self.as_input(noise), self.as_input(time)
        t = time[:, None, None]  # (B, 1, 1)
        noisy = (1 - t) * noise + t * actions  # (B, T, action_dim)
        bucket = torch.floor(time * self.config.num_timestep_buckets).long()  # (B,)
        predicted = self.velocity(
            self.encode(backbone_features),
            state,
            embodiment_id,
            F.pad(noisy, (0, self.config.encoder_action_dim - self.config.action_dim)),
            bucket,
            attention_mask=attention_mask,
            image_mask=image_mask,
        )
        error = (predicted - (actions - noise)).square()  # (B, T, action_dim)
        if action_mask is None:
            return error.mean()
        mask = self.as_input(action_mask).expand_as(error)
        return (error * mask).sum() / mask.sum()

    def as_input(self, array: Tensor | np.ndarray) -> Tensor:
        """The array as a tensor in the head's dtype, on its device."""
        if isinstance(array, Tensor):
            return array.to(dtype=self.dtype, device=self.device)
        return torch.tensor(array, dtype=self.dtype, device=self.device)  # a copy: the array may be read-only

    def as_embodiment(self, embodiment_id: int | Tensor | np.ndarray, batch: int) -> int | Tensor:
        """One id stays an int (one matrix product for the whole batch), several become a long tensor."""
        ids = embodiment_id if isinstance(embodiment_id, Tensor) else torch.tensor(embodiment_id)
        if ids.ndim > 0:
            check_shape("embodiment_id", ids, (batch,))
        if ids.is_floating_point() or ids.dtype == torch.bool:
            raise InputError(f"embodiment_id: {ids.dtype}, expected integers")
        if ids.numel() and not 0 <= int(ids.min()) <= int(ids.max()) < self.config.num_embodiments:
            raise InputError(
                f"embodiment_id: {ids.tolist()}, expected 0 to {self.config.num_embodiments - 1}"
            )
        return int(ids) if ids.ndim == 0 else ids.to(dtype=torch.long, device=self.device)


def velocity_strength(chunking: Chunking, action_horizon: int) -> np.ndarray:
    """How fast each action of a chunk follows the flow where it goes on from the previous chunk.

    Args:
        chunking: frozen actions stay as they are, the rest of the overlap is ever less held back.
        action_horizon: actions in a chunk.

    Returns:
        `(action_horizon,)` float64: 0 at the f frozen actions; then, up to the overlap o, at action j
        (1 - exp(-a r)) / (1 - exp(-a)) with r = (j - f + 1) / (o - f + 1) and a = `ramp_rate`; then 1.
    """
    frozen, overlap = chunking.frozen, chunking.overlap
    strength = np.ones(action_horizon)
    strength[:frozen] = 0.0
    r = np.arange(1, overlap - frozen + 1) / (overlap - frozen + 1)
    rate = max(chunking.ramp_rate, SLOWEST_RAMP)
    strength[frozen:overlap] = np.expm1(-rate * r) / np.expm1(-rate)
    return strength


def is_unused(name: str) -> bool:
    """Whether a checkpoint may have a parameter of this name that only the released training uses."""
    return name in (MASK_TOKEN, DROPOUT_PROB) or name.startswith(LOG_SIGMA)


def token_table(num_rows: int, width: int) -> nn.Embedding:
    """Learned rows, `(num_rows, width)`; zero rows are allowed."""
    return nn.Embedding(num_rows, width, _weight=TABLE_STD * torch.randn(num_rows, width))
