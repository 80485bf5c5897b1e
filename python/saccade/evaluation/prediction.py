"""Predicts the chunks of one recorded episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.evaluation.recordings import Recordings, actions_of, length_of, observation_at

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

BATCH = 8  # observations that are computed together
SAMPLES = 2  # of each observation: the prediction, and one with other noise


@dataclass(frozen=True, eq=False)
class Predicted:
    """The chunks that were predicted in one episode.

    Attributes:
        episode: Its place in the data set.
        steps: The steps of the observations, ``(chunks,)``.
        recorded: The recorded actions, ``(length, width)``, in the robot's units.
        predicted: ``(chunks, 2, horizon, width)``, in the robot's units: the prediction, and another sample.
        normalized_recorded: ``(chunks, horizon, head_width)``, NaN beyond the end of the episode.
        normalized: The predictions likewise, ``(chunks, 2, horizon, head_width)``.
        state: The newest state of each observation, ``(chunks, state_width)``.
        seconds: How long it took.
    """

    episode: int
    steps: npt.NDArray[np.int64]
    recorded: npt.NDArray[np.floating[Any]]
    predicted: Float32Array
    normalized_recorded: Float32Array
    normalized: Float32Array
    state: Float32Array
    seconds: float

    @property
    def horizon(self) -> int:
        """Number of actions in a chunk."""
        return int(self.predicted.shape[2])


def noise_of(policy: Policy, seed: int, episode: int, step: int, samples: int = SAMPLES) -> Float32Array:
    """The noise of the samples of one observation, ``(samples, horizon, width)`` of the head."""
    config = policy.head.config
    shape = (samples, config.action_horizon, config.encoder_action_dim)
    return np.random.default_rng((seed, episode, step)).standard_normal(shape, dtype=np.float32)


def horizon_of(policy: Policy) -> int:
    """Number of actions in a chunk of the policy.

    Raises:
        InputError: The chunk leaves steps out, or does not begin at the observed step.
    """
    indices = policy.requirements.action_indices
    if indices is not None and indices != tuple(range(len(indices))):
        raise InputError(
            "policy: expected action_indices 0, 1, 2, ..., an action for each step from the observed one on, "
            f"got {list(indices)!r:.80}"
        )
    most = policy.head.config.action_horizon
    return min(policy.normalizer.action_horizon or most, most)


def predict_episode(
    policy: Policy,
    data: Recordings,
    episode: int,
    *,
    stride: int,
    seed: int,
    sampling: Mapping[str, Any],
    clock: Callable[[], float],
) -> Predicted:
    """Predicts a chunk at every ``stride``-th step of an episode.

    Raises:
        SaccadeError: The recording does not fit the policy; the message names episode and step.
    """
    start = clock()
    length, horizon = length_of(data, episode), horizon_of(policy)
    recorded = actions_of(policy, data, episode, horizon)
    steps = np.arange(0, length, stride)
    predicted, states = [], []
    for first in range(0, len(steps), BATCH):
        batch = [int(step) for step in steps[first : first + BATCH]]
        parsed = [observation_at(policy, data, episode, step) for step in batch]
        state = np.concatenate([one.state for one in parsed])
        noise = np.stack([noise_of(policy, seed, episode, step) for step in batch])
        context = policy.encode(parsed)
        actions = policy.sample(context, state, noise=noise, num_samples=SAMPLES, **sampling)
        predicted.append(np.asarray(actions, np.float32))
        states.append(state)
    chunks, history = np.concatenate(predicted), np.concatenate(states)
    normalized_recorded = np.full(
        (len(steps), horizon, policy.normalizer.head_action_width), np.nan, np.float32
    )
    for row, step in enumerate(steps):
        kept = recorded[step : step + horizon].astype(np.float32)
        normalized_recorded[row, : len(kept)] = _normalized(policy, kept[None], history[row][None])[0]
    return Predicted(
        episode=episode,
        steps=steps,
        recorded=recorded,
        predicted=chunks,
        normalized_recorded=normalized_recorded,
        normalized=_normalized(policy, chunks, history),
        state=history[:, -1],
        seconds=clock() - start,
    )


def _normalized(policy: Policy, actions: Float32Array, state: Float32Array) -> Float32Array:
    """Actions as the head was trained on them, without padding."""
    normalized = np.asarray(policy.normalizer.normalize_actions(actions, state))
    return np.ascontiguousarray(normalized[..., : policy.normalizer.head_action_width])
