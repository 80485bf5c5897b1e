"""Predicts the chunks of one recorded episode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError, ShapeError
from saccade.evaluation.recordings import Recordings, actions_of, length_of, observation_at
from saccade.policy.loading import returned_horizon

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


@dataclass(frozen=True)
class Shapes:
    """What the arrays of :class:`Predicted` have in common in a run.

    Attributes:
        stride, horizon: Steps between two chunks, and actions in one.
        action, head_action, state: Widths of an action, of a normalised one, and of a state.
    """

    stride: int
    horizon: int
    action: int
    head_action: int
    state: int

    @classmethod
    def of(cls, policy: Policy, stride: int) -> Shapes:
        """Those of a policy; raises as :func:`horizon_of`."""
        robot = policy.normalizer
        return cls(stride, horizon_of(policy), robot.action_width, robot.head_action_width, robot.state_width)

    def check(self, one: Predicted) -> None:
        """Checks an episode that was read from a file.

        Raises:
            ShapeError: An array has another shape or type, or the steps are others; the message names it.
        """
        length = len(one.recorded) if np.ndim(one.recorded) else 0
        steps = np.arange(0, length, self.stride)
        chunks = len(steps)
        expected = {
            "recorded": (max(length, 1), self.action),  # an episode has a step
            "predicted": (chunks, SAMPLES, self.horizon, self.action),
            "normalized_recorded": (chunks, self.horizon, self.head_action),
            "normalized": (chunks, SAMPLES, self.horizon, self.head_action),
            "state": (chunks, self.state),
            "seconds": (),
        }
        for name, shape in expected.items():
            given = np.asarray(getattr(one, name))
            if given.shape != shape or given.dtype.kind != "f":
                raise ShapeError(
                    f"{name}: expected floating numbers of shape {shape}, got {given.dtype} of {given.shape}"
                )
        if not np.array_equal(one.steps, steps):
            raise ShapeError(f"steps: expected every {self.stride}th of {length} steps, got others")


def noise_of(policy: Policy, seed: int, episode: int, step: int, samples: int = SAMPLES) -> Float32Array:
    """The noise of the samples of one observation, ``(samples, horizon, width)`` of the head."""
    rng = np.random.default_rng((seed, episode, step))
    return rng.standard_normal((samples, *noise_shape(policy)), dtype=np.float32)


def noise_shape(policy: Policy) -> tuple[int, int]:
    """The shape of the head's noise for a chunk, ``(horizon, width)``."""
    config = policy.head.config
    return config.action_horizon, config.encoder_action_dim


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
    return returned_horizon(policy.head, policy.normalizer)


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
