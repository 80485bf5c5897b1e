"""``saccade.evaluate``: predicts recorded actions, and compares."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from saccade._internal.arrays import integer
from saccade.errors import InputError
from saccade.evaluation.layout import Layout
from saccade.evaluation.prediction import horizon_of, noise_shape, predict_episode
from saccade.evaluation.recordings import Recordings, chosen_episodes, fitted
from saccade.evaluation.report import Evaluation, summarised

if TYPE_CHECKING:
    from saccade.policy.policy import Policy


def evaluate(
    policy: Policy,
    data: Recordings,
    *,
    episodes: Sequence[int] | None = None,
    stride: int | None = None,
    seed: int = 0,
    num_steps: int | None = None,
    integrator: str | None = None,
    future_refresh: int | None = None,
    on_episode: Callable[[int], None] | None = None,
) -> Evaluation:
    """Compares predicted with recorded actions in open loop, as Isaac-GR00T does.

    The rules, and how the numbers are related to Isaac-GR00T's, are in ``docs/evaluate.md``.

    Args:
        policy: A whole policy.
        data: Recorded episodes: :func:`saccade.datasets.open`, or anything with the same members.
        episodes: Places of episodes in the data set. Default: all.
        stride: Steps between two predictions, at most the horizon. Default: the horizon.
        seed: Seed of the noise. A chunk is that of ``policy.act(..., seed=(seed, episode, step))``.
        num_steps, integrator, future_refresh: As in :meth:`saccade.Policy.sample`.
        on_episode: Called after each episode with the number of episodes that are done.

    Raises:
        InputError, ShapeError, DtypeError: An option is out of range, or a recording does not fit the policy;
            the message then names episode and step.

    Example:
        >>> import saccade
        >>> def error_of(policy: saccade.Policy, data: "saccade.datasets.Dataset") -> float:
        ...     return saccade.evaluate(policy, data, stride=8).mse
    """
    data = fitted(policy, data)
    chosen = chosen_episodes(data, episodes)
    step = checked_stride(policy, stride)
    seed = integer("seed", seed, least=0)
    given = {"num_steps": num_steps, "integrator": integrator, "future_refresh": future_refresh}
    sampling: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    predictions = []
    for place in chosen:
        predictions.append(
            predict_episode(
                policy, data, place, stride=step, seed=seed, sampling=sampling, clock=time.perf_counter
            )
        )
        if on_episode is not None:
            on_episode(len(predictions))
    return summarised(predictions, Layout.of(policy.normalizer), step, seed, noise_shape(policy))


def checked_stride(policy: Policy, stride: int | None) -> int:
    """The stride; None gives the horizon.

    Raises:
        InputError: It is longer than the horizon.
    """
    horizon = horizon_of(policy)
    if stride is None:
        return horizon
    if integer("stride", stride) > horizon:
        raise InputError(f"stride: expected at most {horizon}, the actions in a chunk, got {stride}")
    return stride
