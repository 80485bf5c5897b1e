"""Derivatives of the actions in torch: by the rows of blocks, and along paths from the VL tokens."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeAlias

import torch
from torch import Tensor

from saccade_lab.reference import ActionHead
from saccade_lab.study.paths import ALL_PATHS, DETOUR, DIRECT, PATHS, READ

LEAVING_FUTURE = (("state", "future"), ("action", "future"))
READ_BY_OTHERS = (("state", "vl"), ("action", "vl"))
#: Of the rows before the first block and after each, both ``(rows,)``: the norm of the derivative by a row,
#: and that times the length of the row.
Sensitivity: TypeAlias = Sequence[tuple[Tensor, Tensor]]
NO_MASKS: Mapping[str, Tensor] = MappingProxyType({})


def conditions(count: int, embodiment_id: int, masks: Mapping[str, Tensor]) -> dict[str, Any]:
    """Arguments of ``ActionHead.sample`` for ``count`` copies of one observation."""
    return {"embodiment_id": embodiment_id, **{name: mask.expand(count, -1) for name, mask in masks.items()}}


def path_derivatives(
    head: ActionHead,
    vl_embs: Tensor,
    state: Tensor,
    noise: Tensor,
    cotangents: Tensor,
    embodiment_id: int = 0,
    masks: Mapping[str, Tensor] = NO_MASKS,
) -> dict[str, Tensor]:
    """Derivatives of projections of the actions by the vision-language tokens, for each path.

    Args:
        head: Head that computes, in its dtype.
        vl_embs: Tokens of one observation, ``(1, T_vl, context_dim)``.
        state: ``(1, state_dim)`` or ``(1, history, state_dim)``.
        noise: ``(1, T, action_dim)``.
        cotangents: ``(projections, T, action_dim)``; a projection is the sum of the product with the actions.
        embodiment_id: Embodiment of the robot.
        masks: Masks for ``sample`` by name: ``drop_vl``, ``attention_mask``, ``image_mask``, ``(1, T_vl)``
            bool.

    Returns:
        Each path of ``PATHS`` and their sum ``ALL_PATHS``, ``(projections, T_vl, context_dim)``.
    """

    def derivative(stopped: Sequence[tuple[str, str]]) -> Tensor:
        return vl_derivative(head, vl_embs, state, noise, cotangents, embodiment_id, masks, stopped)

    whole, direct, read = derivative(()), derivative(LEAVING_FUTURE), derivative(READ_BY_OTHERS)
    return {DIRECT: direct, READ: read, DETOUR: whole - direct - read, ALL_PATHS: whole}


def vl_derivative(
    head: ActionHead,
    vl_embs: Tensor,
    state: Tensor,
    noise: Tensor,
    cotangents: Tensor,
    embodiment_id: int = 0,
    masks: Mapping[str, Tensor] = NO_MASKS,
    stopped: Sequence[tuple[str, str]] = (),
) -> Tensor:
    """Derivatives of projections of the actions by the vision-language tokens.

    Args:
        head, vl_embs, state, noise, cotangents, embodiment_id, masks: As in ``path_derivatives``.
        stopped: Pairs (reader, source) through which no derivative passes.

    Returns:
        ``(projections, T_vl, context_dim)``.
    """
    count = len(cotangents)
    leaf = vl_embs.detach().repeat(count, 1, 1).requires_grad_()
    actions = head.sample(
        leaf,
        state.expand(count, *state.shape[1:]),
        noise=noise.expand(count, -1, -1),
        stop_gradient=stopped,
        **conditions(count, embodiment_id, masks),
    )
    # Rows of a batch do not interact: each copy of the tokens gets the derivative of its own projection.
    return torch.autograd.grad((actions * cotangents).sum(), leaf)[0]


@dataclass(frozen=True)
class Shares:
    """The contributions of the paths to a derivative.

    Attributes:
        length: Frobenius norm of each path divided by the norm of the whole. Lengths do not add up.
        share: Projection of each path on the whole. Shares add up to 1 and may be negative.
        cosine: Between two paths; NaN if one is zero.
    """

    length: dict[str, float]
    share: dict[str, float]
    cosine: dict[tuple[str, str], float]


def shares(parts: Mapping[str, Tensor]) -> Shares:
    """The shares of derivatives from ``path_derivatives``.

    With independent standard normal cotangents, the mean product of two projected derivatives is the
    Frobenius product of the two.
    """

    def product(one: str, two: str) -> float:
        return float((parts[one] * parts[two]).sum())

    length = {name: math.sqrt(product(name, name)) for name in parts}

    def cosine(one: str, two: str) -> float:
        scale = length[one] * length[two]
        return product(one, two) / scale if scale > 0 else math.nan

    return Shares(
        length={name: length[name] / length[ALL_PATHS] for name in PATHS},
        share={name: product(name, ALL_PATHS) / length[ALL_PATHS] ** 2 for name in PATHS},
        cosine={pair: cosine(*pair) for pair in itertools.combinations(PATHS, 2)},
    )


class Nudges:
    """Zeros that are added to the rows of every block, to take derivatives by the rows.

    The same zeros are added at every Euler step, so a derivative is that of a change at all steps, such as a
    change of a learned token.

    Args:
        head: Its blocks get hooks.
        batch: Batch size of the calls.
    """

    def __init__(self, head: ActionHead, batch: int) -> None:
        config = head.config
        rows = config.num_rows
        self._blocks = list(head.model.transformer_blocks)
        self._zeros = [
            torch.zeros(batch, rows, config.width, dtype=head.dtype, requires_grad=True)
            for _ in range(len(self._blocks) + 1)
        ]  # before the first block, then after each
        self._squares = [torch.zeros(batch, rows, dtype=head.dtype) for _ in self._zeros]
        self._steps = 0

    @contextlib.contextmanager
    def applied(self) -> Iterator[None]:
        """Adds them in all calls of the head in the context."""

        def nudge(place: int, rows: Tensor) -> Tensor:
            self._squares[place] += rows.detach().square().sum(dim=-1)
            return rows + self._zeros[place]

        def before(block: Any, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
            self._steps += 1
            return (nudge(0, inputs[0]), *inputs[1:])

        def after(place: int, block: Any, inputs: Any, rows: Tensor) -> Tensor:
            return nudge(place, rows)

        handles = [self._blocks[0].register_forward_pre_hook(before)]
        for place, block in enumerate(self._blocks, start=1):
            handles.append(block.register_forward_hook(functools.partial(after, place)))
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    def derivatives(self, scalar: Tensor) -> list[Tensor]:
        """Derivatives of a scalar computed in ``applied``, by place: ``(batch, rows, width)``."""
        return list(torch.autograd.grad(scalar, self._zeros))

    def lengths(self) -> list[Tensor]:
        """Lengths of the rows, by place: root mean square over batch and steps, ``(rows,)``."""
        return [(square.mean(dim=0) / self._steps).sqrt() for square in self._squares]


def action_sensitivity(
    head: ActionHead,
    vl_embs: Tensor,
    state: Tensor,
    noise: Tensor,
    cotangents: Tensor,
    embodiment_id: int = 0,
    masks: Mapping[str, Tensor] = NO_MASKS,
) -> Sensitivity:
    """How the sampled actions depend on the rows before the first block and after each.

    Arguments as in ``path_derivatives``.

    Returns:
        By place, ``(rows,)`` each: the Frobenius norm of the derivative by each row, and the same times the
        length of the row, which is the change if the row changed by its own length. Every block normalises
        its inputs, so the norm alone depends on the length of a row as much as on its use.
    """
    count = len(cotangents)
    nudges = Nudges(head, count)
    with nudges.applied():
        actions = head.sample(
            vl_embs.expand(count, -1, -1),
            state.expand(count, *state.shape[1:]),
            noise=noise.expand(count, -1, -1),
            **conditions(count, embodiment_id, masks),
        )
    found = nudges.derivatives((actions * cotangents).sum())
    norms = [derivative.square().sum(dim=-1).mean(dim=0).sqrt() for derivative in found]  # (rows,) each
    return [(norm, norm * length) for norm, length in zip(norms, nudges.lengths(), strict=True)]


def loss_sensitivity(
    head: ActionHead,
    features: Tensor,
    state: Tensor,
    actions: Tensor,
    mask: Tensor,
    generator: torch.Generator,
    draws: int,
) -> Sensitivity:
    """How the flow-matching loss of one observation, averaged over times and noises, depends on the rows.

    The robot is the head's first embodiment.

    Args:
        head: Head that computes, in its dtype.
        features: Backbone features, ``(1, T_vl, context_dim)``.
        state: ``(1, state_dim)``.
        actions: The demonstrated chunk, ``(1, T, action_dim)``, normalised.
        mask: Weights of the actions, ``(1, T, 1)``.
        generator: Generator of times and noise.
        draws: Number of times and noises.

    Returns:
        As ``action_sensitivity``, of the loss.
    """
    nudges = Nudges(head, draws)
    with nudges.applied():
        loss = head.loss(
            features.expand(draws, -1, -1),
            state.expand(draws, -1),
            0,
            actions.expand(draws, -1, -1),
            noise=torch.randn(draws, *actions.shape[1:], generator=generator, dtype=head.dtype),
            time=head.sample_time(draws, generator),
            action_mask=mask,
        )
    norms = [derivative.sum(dim=0).norm(dim=-1) for derivative in nudges.derivatives(loss)]
    return [(norm, norm * length) for norm, length in zip(norms, nudges.lengths(), strict=True)]


def pooled(measured: Sequence[Sensitivity]) -> Sensitivity:
    """``action_sensitivity`` of several projections, from that of each."""

    def pool(values: Sequence[Tensor]) -> Tensor:
        return torch.stack(list(values)).square().mean(dim=0).sqrt()

    return [
        (pool([norm for norm, _ in pairs]), pool([relative for _, relative in pairs]))
        for pairs in zip(*measured, strict=True)
    ]


def row_groups(head: ActionHead) -> dict[str, slice]:
    """Slices of the groups of rows."""
    states = head.config.num_state_rows
    actions = states + head.config.num_future_tokens
    return {"state": slice(0, states), "future": slice(states, actions), "action": slice(actions, None)}
