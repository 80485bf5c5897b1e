"""The pieces as a careful user of torch would write them; every engine of modules or graphs runs these.

They contain every optimisation that keeps the computation exact, so that engines are compared and not ways to
write the model: keys and values are cached between Euler steps, time-only values are precomputed, unused rows
of the last block are skipped, and linear layers with the same input are merged. Weights are those of
`saccade_lab.reference.ActionHead`.

Shapes: B observations, S samples of each, R rows of a sequence, E the width, C the features' width, T_vl
features.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from saccade_lab.reference import ActionHead, tables
from saccade_lab.reference.backbone import attention as backbone_attention
from saccade_lab.reference.backbone.rotary import rotate

Modules = Any  # reference modules, whose attributes torch does not type


def joined(*layers: nn.Linear) -> nn.Linear:
    """One linear layer with the concatenated outputs of all the layers."""
    linear = nn.Linear(layers[0].in_features, sum(layer.out_features for layer in layers), device="meta")
    linear.weight = nn.Parameter(torch.cat([layer.weight for layer in layers]), requires_grad=False)
    linear.bias = nn.Parameter(torch.cat([layer.bias for layer in layers]), requires_grad=False)
    return linear


def split_heads(x: Tensor, num_heads: int) -> Tensor:
    """`(B, L, heads * head_dim)` to `(B, heads, L, head_dim)`."""
    return x.unflatten(-1, (num_heads, -1)).transpose(1, 2)


def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """`(B, heads, Q, head_dim)` and the like to `(B, Q, heads * head_dim)`."""
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)


class Linears(nn.Module):
    """Linear layers of one size, with enough weights to exceed the caches."""

    def __init__(self, weights: list[Tensor]) -> None:
        super().__init__()
        self.weights = nn.ParameterList(frozen(weight) for weight in weights)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        """`(B, rows, inputs)` to one `(B, rows, outputs)` per layer."""
        return tuple(F.linear(x, weight) for weight in self.weights)


class Project(nn.Module):
    """Features to keys and values of cross-attentions."""

    def __init__(self, attentions: list[Modules]) -> None:
        super().__init__()
        self.num_heads = attentions[0].num_heads
        self.to_kv = nn.ModuleList(joined(each.to_k, each.to_v) for each in attentions)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """`(B, T_vl, C)` to keys, values of the first, of the second, ...: `(B, heads, T_vl, head_dim)`."""
        return self.of([features] * len(self.to_kv))

    def of(self, features: list[Tensor]) -> tuple[Tensor, ...]:
        """The same of each attention's own features."""
        held: list[Tensor] = []
        for layer, own in zip(self.to_kv, features, strict=True):
            held += [split_heads(half, self.num_heads) for half in layer(own).chunk(2, dim=-1)]
        return tuple(held)


class CrossAttentions(nn.Module):
    """Cross-attentions of the same rows, with cached keys and values."""

    def __init__(self, attentions: list[Modules]) -> None:
        super().__init__()
        self.num_heads = attentions[0].num_heads
        self.to_q = nn.ModuleList(each.to_q for each in attentions)
        self.to_out = nn.ModuleList(each.to_out[0] for each in attentions)

    def forward(self, rows: Tensor, *held: Tensor) -> tuple[Tensor, ...]:
        """`(B, S R, E)` to one result of the same shape per attention."""
        results = []
        for index, (to_q, to_out) in enumerate(zip(self.to_q, self.to_out, strict=True)):
            q = split_heads(to_q(rows), self.num_heads)
            results.append(to_out(attend(q, held[2 * index], held[2 * index + 1])))
        return tuple(results)


class Block(nn.Module):
    """A DiT block; the scale (one added to it) and shift of its time are given."""

    def __init__(self, block: Modules, *, only_last: int | None = None) -> None:
        super().__init__()
        self.is_cross = block.is_cross
        self.num_heads = block.attn1.num_heads
        self.only_last = only_last
        if self.is_cross:
            self.to_q = block.attn1.to_q
        elif only_last is None:
            self.to_qkv = joined(block.attn1.to_q, block.attn1.to_k, block.attn1.to_v)
        else:
            self.to_q = block.attn1.to_q
            self.to_kv = joined(block.attn1.to_k, block.attn1.to_v)
        self.to_out = block.attn1.to_out[0]
        self.up, self.down = block.ff.net[0].proj, block.ff.net[2]

    def forward(self, rows: Tensor, modulation: Tensor, samples: int, *held: Tensor) -> Tensor:
        """`rows (B S, R, E)`, `modulation (2, E)`; the rows again, the last `only_last` of them if given."""
        y = F.layer_norm(rows, rows.shape[-1:], eps=1e-5) * modulation[0] + modulation[1]
        if self.is_cross:
            # The samples of one observation are more rows that read the same keys.
            q = self.to_q(y).reshape(y.shape[0] // samples, samples * y.shape[1], y.shape[2])
            attended = attend(split_heads(q, self.num_heads), held[0], held[1]).reshape(y.shape)
        elif self.only_last is None:
            q, k, v = (split_heads(part, self.num_heads) for part in self.to_qkv(y).chunk(3, dim=-1))
            attended = attend(q, k, v)
        else:
            k, v = (split_heads(part, self.num_heads) for part in self.to_kv(y).chunk(2, dim=-1))
            rows = rows[:, -self.only_last :]
            attended = attend(split_heads(self.to_q(y[:, -self.only_last :]), self.num_heads), k, v)
        rows = rows + self.to_out(attended)
        y = F.layer_norm(rows, rows.shape[-1:], eps=1e-5)
        return rows + self.down(F.gelu(self.up(y), approximate="tanh"))


class Blocks(nn.Module):
    """DiT blocks with cached keys and values, all rows in every block."""

    def __init__(self, blocks: list[Modules]) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(Block(block) for block in blocks)

    def forward(self, rows: Tensor, modulations: Tensor, *held: Tensor) -> tuple[Tensor, ...]:
        """`rows (B, R, E)`, `modulations (blocks, 2, E)`; the rows after the last block."""
        for index, block in enumerate(self.blocks):
            own = held[index : index + 2] if block.is_cross else ()  # blocks 0, 2, ... are the cross blocks
            rows = block(rows, modulations[index], 1, *own)
        return (rows,)


class Encode(nn.Module):
    """Backbone features to the keys and values of all cross blocks."""

    def __init__(self, head: ActionHead) -> None:
        super().__init__()
        modules: Modules = head
        self.norm = modules.vlln if head.config.use_vlln else nn.Identity()
        blocks = modules.vl_self_attention.transformer_blocks if head.config.use_vlln else []
        self.blocks = nn.ModuleList(VlBlock(block) for block in blocks)
        self.project = Project([block.attn1 for block in modules.model.transformer_blocks if block.is_cross])

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """`(B, T_vl, C)` to the result of `Project`."""
        held: tuple[Tensor, ...] = self.project(self.context(features))
        return held

    def context(self, features: Tensor) -> Tensor:
        """What the cross blocks attend to, of the same shape."""
        x: Tensor = self.norm(features)
        for block in self.blocks:
            x = block(x)
        return x


class VlBlock(nn.Module):
    """A block of the VL self-attention."""

    def __init__(self, block: Modules) -> None:
        super().__init__()
        self.num_heads = block.attn1.num_heads
        self.norm1, self.norm3 = block.norm1, block.norm3
        self.to_qkv = joined(block.attn1.to_q, block.attn1.to_k, block.attn1.to_v)
        self.to_out = block.attn1.to_out[0]
        self.up, self.down = block.ff.net[0].proj, block.ff.net[2]

    def forward(self, x: Tensor) -> Tensor:
        """`(B, T_vl, C)` to the same shape."""
        q, k, v = (split_heads(part, self.num_heads) for part in self.to_qkv(self.norm1(x)).chunk(3, dim=-1))
        x = x + self.to_out(attend(q, k, v))
        return x + self.down(F.gelu(self.up(self.norm3(x)), approximate="tanh"))


def decoder_layer(layer: Modules, x: Tensor, angles: Tensor, head_dim: int) -> Tensor:
    """A layer of Qwen3 for one prompt without padding: `(1, T, width)`, `(T, head_dim / 2)`."""
    attention, y = layer.self_attn, layer.input_layernorm(x)
    q, k, v = (
        backbone_attention.split_heads(projection(y), head_dim)
        for projection in (attention.q_proj, attention.k_proj, attention.v_proj)
    )
    q, k = rotate(attention.q_norm(q), angles), rotate(attention.k_norm(k), angles)
    k, v = (each.repeat_interleave(attention.queries_per_key, dim=1) for each in (k, v))
    attended = F.scaled_dot_product_attention(q, k, v, is_causal=True)
    x = x + attention.o_proj(attended.transpose(1, 2).flatten(2))
    return x + layer.mlp(layer.post_attention_layernorm(x))


class State(nn.Module):
    """The state row, once a chunk."""

    def __init__(self, head: ActionHead, embodiment: int) -> None:
        super().__init__()
        modules: Modules = head
        self.first = of_category(modules.state_encoder.layer1, embodiment)
        self.second = of_category(modules.state_encoder.layer2, embodiment)

    def forward(self, state: Tensor) -> tuple[Tensor, ...]:
        """`(B S, 1, state_dim)` to `(B S, 1, E)`."""
        return (self.second(F.relu(self.first(state))),)


class Step(nn.Module):
    """The velocity at one Euler step, with cached keys and values."""

    def __init__(self, head: ActionHead, embodiment: int, samples: int) -> None:
        super().__init__()
        modules: Modules = head
        config, encoder = head.config, modules.action_encoder
        self.samples, self.horizon = samples, config.action_horizon
        half = encoder.W2.W[embodiment][: config.width]  # what multiplies the action, not the time
        self.into = nn.Linear(config.encoder_action_dim, config.width, bias=False, device="meta")
        self.into.weight = frozen((encoder.W1.W[embodiment].double() @ half.double()).float().T)
        self.out_of = of_category(encoder.W3, embodiment)
        self.future = frozen(head.learned_tokens)
        self.positions = frozen(modules.position_embedding.weight[: config.action_horizon])
        last = config.num_layers - 1
        self.blocks = nn.ModuleList(
            Block(block, only_last=self.horizon if index == last and not block.is_cross else None)
            for index, block in enumerate(modules.model.transformer_blocks)
        )
        self.project = modules.model.proj_out_2
        self.decode_1 = of_category(modules.action_decoder.layer1, embodiment)
        self.decode_2 = of_category(modules.action_decoder.layer2, embodiment)

    def forward(
        self, actions: Tensor, state_row: Tensor, time: Tensor, modulations: Tensor, *held: Tensor
    ) -> tuple[Tensor, ...]:
        """`actions (B S, T, A)`, `state_row (B S, 1, E)`; `time (E,)` and `modulations (blocks + 1, 2, E)` as
        `times` gives them; the velocity `(B S, T, A)`.
        """
        action_rows = self.out_of(F.silu(self.into(actions) + time)) + self.positions
        parts = [state_row, action_rows.to(state_row.dtype)]
        if len(self.future):  # N1.7 has none
            parts.insert(1, self.future.expand(actions.shape[0], -1, -1).to(state_row.dtype))
        rows = torch.cat(parts, dim=1)
        for index, block in enumerate(self.blocks):
            own = held[index : index + 2] if block.is_cross else ()
            rows = block(rows, modulations[index], self.samples, *own)
        rows = F.layer_norm(rows[:, -self.horizon :], rows.shape[-1:], eps=1e-6)
        hidden = self.project(rows * modulations[-1, 0] + modulations[-1, 1])
        return (self.decode_2(F.relu(self.decode_1(hidden))),)


def times(head: ActionHead, embodiment: int, num_steps: int) -> list[tuple[Tensor, Tensor]]:
    """What depends on the time alone, one pair an Euler step: what the action encoder adds `(E,)`, and scale
    (one added) and shift of every block and of the output `(blocks + 1, 2, E)`.
    """
    modules: Modules = head
    config, encoder = head.config, modules.action_encoder
    result = []
    for step in range(num_steps):
        bucket = torch.tensor([int(step / num_steps * config.num_timestep_buckets)])
        temb = modules.model.timestep_encoder(bucket)
        pairs = [
            block.norm1.linear(F.silu(temb)).chunk(2, dim=-1) for block in modules.model.transformer_blocks
        ]
        shift, scale = modules.model.proj_out_1(F.silu(temb)).chunk(2, dim=-1)  # here the shift comes first
        pairs.append((scale, shift))
        w2, width = encoder.W2.W[embodiment], config.width
        tau = tables.action_time_table(bucket, width)[0]
        added = encoder.W1.b[embodiment] @ w2[:width] + tau @ w2[width:] + encoder.W2.b[embodiment]
        result.append((added, torch.stack([torch.stack((1 + a[0], b[0])) for a, b in pairs])))
    return result


def of_category(layer: Modules, embodiment: int) -> nn.Linear:
    """One embodiment's slice of a category-specific layer."""
    inputs, outputs = layer.W.shape[1:]
    linear = nn.Linear(inputs, outputs, device="meta")
    linear.weight = frozen(layer.W[embodiment].T)
    linear.bias = frozen(layer.b[embodiment])
    return linear


def frozen(tensor: Tensor) -> nn.Parameter:
    """A copy in newly allocated memory, without gradient."""
    return nn.Parameter(tensor.detach().clone(memory_format=torch.contiguous_format), requires_grad=False)
