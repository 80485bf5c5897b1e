"""Steps 2 and 5 of :meth:`saccade.Policy.act`: what sampling starts from, and normalised actions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from saccade._internal.arrays import Array, ArrayLike, float32
from saccade.errors import InputError, ShapeError
from saccade.head.chunking import Chunking
from saccade.head.context import Context
from saccade.head.head import ActionHead
from saccade.head.intervention import Intervention
from saccade.head.options import noise_or_draw, optional_integer
from saccade.observations import ParsedState
from saccade.policy.encoding import PolicyContext, is_own
from saccade.policy.guidance import check_guides
from saccade.policy.interfaces import Head
from saccade.policy.loading import returned_horizon
from saccade.policy.reading import Batch
from saccade.robots import Normalizer, padded


@dataclass(frozen=True, eq=False)
class Sampling:
    """The options of one call of :meth:`saccade.Policy.sample`, which documents them."""

    noise: ArrayLike | None = None
    seed: Any = None
    num_steps: int | None = None
    integrator: str | None = None
    num_samples: int | None = None
    future_refresh: int | None = None
    intervention: Intervention | Sequence[Intervention] | None = None
    previous_chunk: Any = None
    chunking: Chunking | None = None
    guidance: float | None = None
    without: Context | None = None  # the second context, if guidance needs one


@dataclass(frozen=True, eq=False)
class Start:
    """What of sampling does not depend on the context.

    Attributes:
        state: The normalised state.
        options: The options of the call. The previous chunk is normalised. Noise is drawn if the state is of
            observations and the head is saccade's own.
        rows: Number of observations, or None for a state that was given as an array.
    """

    state: Array
    options: Sampling
    rows: int | None = None


def start_of_batch(batch: Batch[ParsedState], options: Sampling, head: Head, normalizer: Normalizer) -> Start:
    """The start of a call with parsed observations.

    :meth:`saccade.Policy.act` calls it before it encodes images, so that a state, seed, number of samples or
    previous chunk that does not fit is refused at once. It also takes less time while Python's code is in the
    CPU's caches: 0.9 % of a call of the bundled policy on two threads of an Emerald Rapids.
    """
    if options.previous_chunk is not None:
        options = replace(options, previous_chunk=_joined_chunks(options.previous_chunk, batch, normalizer))
    if options.noise is not None and batch.is_single:
        axes = 3 if options.num_samples is None else 4
        options = replace(options, noise=_with_batch_axis(np.asarray(options.noise), axes, batch.parsed[0]))
    start = start_of_state(batch.state, options, head, normalizer)
    options, rows = start.options, len(batch.state)
    if is_own(head, ActionHead):  # others may draw in their own way
        samples = optional_integer("num_samples", options.num_samples)
        noise = noise_or_draw(options.noise, options.seed, head.config, rows, samples)
        options = replace(options, noise=noise, seed=None)
    return Start(start.state, options, rows)


def start_of_state(state: ArrayLike, options: Sampling, head: Head, normalizer: Normalizer) -> Start:
    """The start of a call with a state in the robot's units."""
    if options.previous_chunk is not None:
        options = _continued(options, state, head, normalizer)
    return Start(normalizer.state(state), options)


def sample_from(start: Start, context: PolicyContext | Context, head: Head, embodiment_id: int) -> Array:
    """Normalised actions, as :meth:`saccade.ActionHead.sample` returns them."""
    if start.rows not in (None, context.batch):
        raise InputError(f"observation: expected {context.batch}, as many as in context, got {start.rows}")
    options = start.options
    if options.guidance is not None:
        options = replace(options, without=_second(context, head))
    given = {name: value for name, value in vars(options).items() if value is not None}
    held = context.context if isinstance(context, PolicyContext) else context
    return head.sample(held, start.state, embodiment_id, **given)


def _second(context: PolicyContext | Context, head: Head) -> Context:
    """The second context of a guided call."""
    check_guides(head)
    second = context.without if isinstance(context, PolicyContext) else None
    if second is None:
        raise InputError(
            "guidance: expected a context from encode(observation, without='default') or 'empty', got one "
            "without a second context"
        )
    return second.context


def _joined_chunks(given: Any, batch: Batch[ParsedState], normalizer: Normalizer) -> Any:
    """The previous chunk of each observation, in its format, as one array."""
    keys = tuple(group.key for group in normalizer.action_groups)
    chunks = [given] if batch.is_single else list(given)
    if len(chunks) != len(batch):
        raise InputError(f"previous_chunk: expected {len(batch)}, got {len(chunks)}")
    joined = [
        _with_batch_axis(float32("previous_chunk", parsed.format.read_actions(chunk, keys)), 3, parsed)
        for parsed, chunk in zip(batch, chunks, strict=True)
    ]
    if len({chunk.shape[1:] for chunk in joined}) != 1:
        listed = ", ".join(str(chunk.shape) for chunk in joined)
        raise ShapeError(f"previous_chunk: expected chunks of one length and width, got {listed}")
    return np.concatenate(joined)


def _with_batch_axis(array: Any, axes: int, parsed: ParsedState) -> Any:
    """An array with a batch axis, which it may lack if the observation does."""
    return array[None] if not parsed.is_batched and array.ndim == axes - 1 else array


def _continued(options: Sampling, state: ArrayLike, head: Head, normalizer: Normalizer) -> Sampling:
    """The options with the continued part of the previous chunk, normalised as the head takes it.

    Its actions become the first of the new chunk, so they are normalised as these: each step may have
    statistics of its own.
    """
    previous, chunking = float32("previous_chunk", options.previous_chunk), options.chunking
    if isinstance(chunking, Chunking):
        most = head.config.action_horizon
        horizon = chunking.horizon or returned_horizon(head, normalizer)
        if previous.ndim < 2 or previous.shape[-2] < horizon:
            raise ShapeError(
                f"previous_chunk: expected a chunk of at least {horizon} actions (horizon of chunking), got "
                f"shape {previous.shape}"
            )
        if not chunking.overlap <= horizon <= most:
            raise InputError(
                f"chunking: expected an overlap of at most {horizon} (horizon), and that to be at most "
                f"{most}, which the head denoises, got an overlap of {chunking.overlap}"
            )
        if not chunking.overlap:  # nothing is continued
            return replace(options, previous_chunk=None, chunking=None)
        previous = previous[..., horizon - chunking.overlap : horizon, :]
        chunking = replace(chunking, horizon=chunking.overlap)
    normalised = np.asarray(normalizer.previous_chunk(previous, state))
    return replace(
        options, previous_chunk=padded(normalised, head.config.encoder_action_dim), chunking=chunking
    )
