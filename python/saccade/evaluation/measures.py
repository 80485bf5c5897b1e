"""Errors of predicted actions: Isaac-GR00T's rule, by key, by step of the horizon, and of baselines.

``docs/evaluate.md`` has the rules. Every number is a mean over episodes of a number of each episode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.bootstrap import bootstrap_ratio
from saccade.evaluation.layout import Layout
from saccade.evaluation.prediction import Predicted

Actions = npt.NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Errors:
    """Mean errors over episodes.

    Attributes:
        mse, mae: Mean squared and mean absolute error in the robot's units.
        normalized_mse, normalized_mae: The same of normalised actions; NaN where they are not computed.
        intervals: The 95 % interval of each of these, ``(low, high)``; NaN with one episode.
    """

    mse: float
    mae: float
    normalized_mse: float = math.nan
    normalized_mae: float = math.nan
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def executed(predicted: Predicted, stride: int, sample: int = 0) -> Actions:
    """The first ``stride`` actions of each chunk, one after the other: ``(length, width)``."""
    chunks = predicted.predicted[:, sample, :stride]
    return chunks.reshape(-1, chunks.shape[-1])[: len(predicted.recorded)]


def squared(predicted: Actions, recorded: Actions) -> Any:
    """The mean squared difference, in the type that the released code gets from these arrays."""
    return np.mean((recorded - predicted) ** 2)


def absolute(predicted: Actions, recorded: Actions) -> Any:
    """The mean absolute difference, likewise."""
    return np.mean(np.abs(recorded - predicted))


@dataclass(frozen=True, eq=False)
class EpisodeErrors:
    """Errors of one episode: ``(mse, mae, normalized_mse, normalized_mae)`` of each kind."""

    all: tuple[Any, ...]
    by_key: Mapping[str, tuple[Any, ...]]
    by_step: tuple[tuple[Any, ...], ...]  # NaN for steps that the episode does not have


def episode_errors(predicted: Predicted, stride: int, layout: Layout) -> EpisodeErrors:
    """The errors of one episode."""
    path, truth = executed(predicted, stride), predicted.recorded
    apart = (predicted.normalized[:, 0] - predicted.normalized_recorded).astype(np.float64)
    taken = apart[:, :stride]
    by_key = {
        key: (
            squared(path[:, where], truth[:, where]),
            absolute(path[:, where], truth[:, where]),
            *_moments(taken[..., layout.head_keys[key]]),
        )
        for key, where in layout.keys.items()
    }
    by_step = []
    for step in range(predicted.horizon):
        places = predicted.steps + step
        known = places < len(truth)
        if not known.any():
            by_step.append((math.nan,) * 4)
            continue
        one, other = predicted.predicted[known, 0, step], truth[places[known]]
        by_step.append((squared(one, other), absolute(one, other), *_moments(apart[:, step])))
    return EpisodeErrors(
        (squared(path, truth), absolute(path, truth), *_moments(taken)), by_key, tuple(by_step)
    )


def _moments(apart: npt.NDArray[np.float64]) -> tuple[float, float]:
    """Mean square and mean absolute value of the numbers that are not beyond the end of the episode."""
    known = apart[~np.isnan(apart)]
    return float(np.mean(known**2)), float(np.mean(np.abs(known)))


def averaged(episodes: Sequence[tuple[Any, ...]]) -> Errors:
    """The mean over episodes of their numbers, and its intervals. Episodes with NaN are left out."""
    names = ("mse", "mae", "normalized_mse", "normalized_mae")[: len(episodes[0])]
    values, intervals = {}, {}
    for name, column in zip(names, zip(*episodes, strict=True), strict=True):
        kept = np.array([value for value in column if not math.isnan(value)])
        values[name] = float(np.mean(kept)) if len(kept) else math.nan
        if len(kept):
            found = bootstrap_ratio(kept, np.ones(len(kept)), range(len(kept)))
            intervals[name] = (found.low, found.high)
    return Errors(**values, intervals=intervals)


def baselines(
    predicted: Sequence[Predicted], stride: int, layout: Layout
) -> tuple[dict[str, Errors], dict[str, str]]:
    """The errors of ``hold``, ``mean`` and ``noise``; and what ``hold`` repeats, by key."""
    held, choice = _held(predicted, stride, layout)
    mean = np.mean(np.concatenate([one.recorded for one in predicted]).astype(np.float64), axis=0)
    found: dict[str, list[tuple[Any, ...]]] = {"hold": [], "mean": [], "noise": []}
    for one, still in zip(predicted, held, strict=True):
        constant = np.broadcast_to(mean.astype(one.recorded.dtype), one.recorded.shape)
        other, first = executed(one, stride, 1), executed(one, stride)
        for name, path, truth in (
            ("hold", still, one.recorded),
            ("mean", constant, one.recorded),
            ("noise", other, first),
        ):
            found[name].append((squared(path, truth), absolute(path, truth)))
    return {name: averaged(episodes) for name, episodes in found.items()}, choice


def _held(
    predicted: Sequence[Predicted], stride: int, layout: Layout
) -> tuple[list[Actions], dict[str, str]]:
    """Actions that hold the robot still, for each episode; and by key whether they are its state or zero."""
    held: list[Actions] = [np.zeros_like(one.recorded) for one in predicted]
    choice = {}
    for key, where in layout.keys.items():
        choice[key] = "zero"
        state = layout.holds[key]
        if state is None:
            continue
        repeated = [
            np.repeat(one.state[:, state], stride, axis=0)[: len(one.recorded)].astype(one.recorded.dtype)
            for one in predicted
        ]
        truths = [one.recorded[:, where] for one in predicted]
        near = np.mean([squared(still, truth) for still, truth in zip(repeated, truths, strict=True)])
        if near < np.mean([squared(np.zeros_like(truth), truth) for truth in truths]):
            choice[key] = "state"
            for one, still in zip(held, repeated, strict=True):
                one[:, where] = still
    return held, choice


def table(predicted: Sequence[Predicted], stride: int, layout: Layout) -> list[dict[str, Any]]:
    """A row for each episode, step of an observation and key: the errors of the actions that count."""
    rows = []
    for one in predicted:
        for place, step in enumerate(one.steps.tolist()):
            truth = one.recorded[step : step + stride]
            path = one.predicted[place, 0, : len(truth)]
            apart = (one.normalized[place, 0] - one.normalized_recorded[place])[: len(truth)].astype(
                np.float64
            )
            for key, where in layout.keys.items():
                square, mean = _moments(apart[:, layout.head_keys[key]])
                rows.append(
                    {
                        "episode": one.episode,
                        "step": step,
                        "key": key,
                        "actions": len(truth),
                        "mse": float(squared(path[:, where], truth[:, where])),
                        "mae": float(absolute(path[:, where], truth[:, where])),
                        "normalized_mse": square,
                        "normalized_mae": mean,
                    }
                )
    return rows
