"""Linear probes: ridge regressions from rows of the head to known targets, judged on held-out episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal.files import write_atomically
from saccade.linalg import PCA, Ridge, Standardizer
from saccade_lab.study.folds import grouped_folds, stratified_folds
from saccade_lab.study.statistics import CONFIDENCE, Estimate

FOLDS, INNER_FOLDS = 5, 4
#: Inputs of a probe are scaled to a mean variance of 1, so that these penalties suit inputs of any width.
PENALTIES = tuple(float(penalty) for penalty in np.logspace(-2, 5, 8))
RESAMPLES = 2000  # of the bootstrap
#: A target that moves less than this between frames of a task is not probed, metres (gripper: opening).
LEAST_SPREAD = 1e-3

FloatArray: TypeAlias = npt.NDArray[Any]  # of float32 or float64
#: What a probe reads: the rows, the block after which they were taken (-1: before the first), and whether
#: the mean of the tokens is read or all of them, one after the other.
Input: TypeAlias = tuple[str, int, str]
#: A target's name, and whether it is the true one or the shuffled control.
Target: TypeAlias = tuple[str, str]
PROPRIO: Input = ("proprioception", -1, "all")
VL: Input = ("vl_embs", -1, "all")


@dataclass(frozen=True)
class Frames:
    """Observations of several episodes; the first axis of every array is the observation.

    Attributes:
        episodes: ``(frames,)``, number of the episode.
        tasks: ``(frames,)``, number of the task.
        inputs: What probes read, each ``(frames, dimensions)``.
        targets: What they predict, by name, each ``(frames, coordinates)``.
    """

    episodes: npt.NDArray[np.int64]
    tasks: npt.NDArray[np.int64]
    inputs: Mapping[Input, FloatArray]
    targets: Mapping[str, FloatArray]


def shuffled_targets(frames: Frames) -> dict[str, FloatArray]:
    """Gives every episode the targets of another episode of its task.

    The order within an episode is kept, so that what follows from the time alone can still be found. An
    episode that is longer than the other one repeats the last targets.
    """
    rng = np.random.default_rng(0)
    taken = np.empty(len(frames.episodes), np.int64)
    rows_of = {episode: np.flatnonzero(frames.episodes == episode) for episode in np.unique(frames.episodes)}
    for task in np.unique(frames.tasks):
        order = rng.permutation(np.unique(frames.episodes[frames.tasks == task]))
        for episode, other in zip(order, np.roll(order, 1), strict=True):
            numbers = np.minimum(np.arange(len(rows_of[episode])), len(rows_of[other]) - 1)
            taken[rows_of[episode]] = rows_of[other][numbers]
    return {name: values[taken] for name, values in frames.targets.items()}


def held_out_errors(
    values: FloatArray, targets: Mapping[Target, FloatArray], frames: Frames, dimensions: int
) -> dict[Target, tuple[FloatArray, FloatArray]]:
    """Squared errors of linear probes, each on episodes that it was not fitted to.

    In each fold everything is fitted to the training episodes. The mean of the task is subtracted from inputs
    and targets, so that the difference between tasks does not count. Inputs are then standardised and reduced
    to at most ``dimensions`` principal components. A ridge regression for each target follows; its penalty is
    the best of ``PENALTIES`` in a cross-validation among the training episodes.

    Args:
        values: ``(frames, inputs)``, what the probes read.
        targets: Each ``(frames, coordinates)``.
        frames: Provides episodes and tasks.
        dimensions: Principal components that a probe reads at most.

    Returns:
        For each target two arrays ``(frames,)``: the squared error of the probe, and that of predicting the
        mean of the training frames of the task. Both are summed over the coordinates.
    """
    found = {name: (np.zeros(len(values)), np.zeros(len(values))) for name in targets}
    asked = np.concatenate(list(targets.values()), axis=1, dtype=np.float64)  # (frames, all coordinates)
    owners = np.repeat(np.arange(len(targets)), [target.shape[1] for target in targets.values()])
    for train, test in stratified_folds(frames.tasks, frames.episodes, FOLDS, seed=0):
        inputs = values - task_means(values, frames.tasks, train)
        expected = asked - task_means(asked, frames.tasks, train)
        scaler = Standardizer(inputs[train])
        standard = scaler.transform(inputs[train])
        reduction = PCA(standard, min(dimensions, len(train) - 1, values.shape[1]))
        known = reduction.transform(standard)
        scale = np.sqrt(np.mean(np.square(known))) or 1.0  # rows that encode only the task are all zeros now
        known, new = known / scale, reduction.transform(scaler.transform(inputs[test])) / scale
        best = best_penalties(known, expected[train], owners, frames.episodes[train])
        for_each = Ridge(known, expected[train], PENALTIES).predict(new)  # (penalties, frames, coordinates)
        predicted = for_each[best[owners], :, np.arange(len(owners))].T
        for owner, (errors, spreads) in enumerate(found.values()):
            errors[test] = np.square(predicted - expected[test])[:, owners == owner].sum(axis=1)
            spreads[test] = np.square(expected[test])[:, owners == owner].sum(axis=1)
    return found


def best_penalties(
    values: FloatArray,
    targets: FloatArray,
    owners: npt.NDArray[np.int64],
    episodes: npt.NDArray[np.int64],
) -> npt.NDArray[np.int64]:
    """Which of ``PENALTIES`` has the least error in a cross-validation by episode, for each target.

    Args:
        values: ``(frames, dimensions)``.
        targets: ``(frames, coordinates)`` of all targets.
        owners: ``(coordinates,)``, the target of each.
        episodes: ``(frames,)``.

    Returns:
        ``(targets,)``, positions in ``PENALTIES``.
    """
    errors = np.zeros((len(PENALTIES), targets.shape[1]))
    for train, test in grouped_folds(episodes, INNER_FOLDS):
        predicted = Ridge(values[train], targets[train], PENALTIES).predict(values[test])
        errors += np.square(predicted - targets[test]).sum(axis=1)
    by_target = np.stack([errors[:, owners == owner].sum(axis=1) for owner in np.unique(owners)])
    best: npt.NDArray[np.int64] = by_target.argmin(axis=1)
    return best


def task_means(values: FloatArray, tasks: npt.NDArray[np.int64], chosen: npt.NDArray[np.int64]) -> FloatArray:
    """For every frame the mean of its task over the chosen frames, shaped like ``values``."""
    means = np.zeros_like(values)
    for task in np.unique(tasks):
        means[tasks == task] = values[chosen[tasks[chosen] == task]].mean(axis=0)
    return means


def within_tasks(values: FloatArray, tasks: npt.NDArray[np.int64]) -> float:
    """Root of the mean squared distance from the mean of the task."""
    apart = values - task_means(values, tasks, np.arange(len(tasks)))
    return float(np.sqrt(np.square(apart).sum(axis=1).mean()))


def per_episode(values: FloatArray, episodes: npt.NDArray[np.int64]) -> FloatArray:
    """Sums over the frames of each episode, in the order of the episode numbers."""
    _, inverse = np.unique(episodes, return_inverse=True)
    return np.bincount(inverse, weights=values)


def explained(
    errors: FloatArray, spreads: FloatArray, draws: npt.NDArray[np.int64]
) -> tuple[float, FloatArray]:
    """R^2 of all episodes together, and of each bootstrap resample.

    Args:
        errors, spreads: Results of ``held_out_errors``, summed by episode, ``(episodes,)``.
        draws: How often each resample contains each episode, ``(resamples, episodes)``.

    Returns:
        1 - errors / spreads, and ``(resamples,)`` of the same.
    """
    # Sums instead of products of matrices, whose last bits depend on the number of threads.
    drawn = 1 - (draws * errors).sum(axis=1) / (draws * spreads).sum(axis=1)
    return float(1 - errors.sum() / spreads.sum()), drawn


def estimate(value: float, drawn: FloatArray) -> Estimate:
    """A number with the percentile interval of its bootstrap resamples."""
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def probe(frames: Frames, dimensions: int) -> list[dict[str, Any]]:
    """All probes of a scope, with intervals over its episodes.

    All probes use the same bootstrap resamples, so differences are paired.

    Args:
        frames: Frames of the scope. Other inputs are compared with the inputs ``PROPRIO`` and ``VL``.
        dimensions: See ``held_out_errors``.

    Returns:
        A row per target and input, for targets that vary.
    """
    numbers, counts = np.unique(frames.episodes, return_counts=True)
    rng = np.random.default_rng(0)
    draws = rng.multinomial(len(numbers), np.full(len(numbers), 1 / len(numbers)), size=RESAMPLES)
    spreads = {name: within_tasks(values, frames.tasks) for name, values in frames.targets.items()}
    moving = [name for name, spread in spreads.items() if spread >= LEAST_SPREAD]
    if not moving:
        return []
    shuffled = shuffled_targets(frames)
    asked = {(name, "true"): frames.targets[name] for name in moving}
    asked |= {(name, "shuffled"): shuffled[name] for name in moving}
    found: dict[tuple[Input, Target], tuple[float, FloatArray]] = {}
    for source, values in frames.inputs.items():
        for target, (errors, usual) in held_out_errors(values, asked, frames, dimensions).items():
            sums = per_episode(errors, frames.episodes), per_episode(usual, frames.episodes)
            found[source, target] = explained(*sums, draws)
    rows = []
    for name in moving:
        for source in frames.inputs:
            value, drawn = found[source, (name, "true")]
            estimates = {
                "r2": estimate(value, drawn),
                "shuffled": estimate(*found[source, (name, "shuffled")]),
            }
            for label, other in (("over_proprio", PROPRIO), ("over_vl", VL)):
                base, base_drawn = found[other, (name, "true")]
                estimates[label] = estimate(value - base, drawn - base_drawn)
            row: dict[str, Any] = dict(zip(("rows", "block", "tokens"), source, strict=True))
            row |= {"target": name, "spread": spreads[name]}
            for label, one in estimates.items():
                row |= {label: one.value, f"{label}_low": one.low, f"{label}_high": one.high}
            rows.append({**row, "episodes": len(numbers), "frames": int(counts.sum())})
    return rows


def join(parts: Sequence[Frames], tasks: Sequence[int]) -> Frames:
    """Joins episodes; each part is one episode, of the task with that number."""
    lengths = [len(part.episodes) for part in parts]
    return Frames(
        np.repeat(np.arange(len(parts)), lengths),
        np.repeat(np.asarray(tasks, np.int64), lengths),
        {source: np.concatenate([part.inputs[source] for part in parts]) for source in parts[0].inputs},
        {name: np.concatenate([part.targets[name] for part in parts]) for name in parts[0].targets},
    )


def save_frames(frames: Frames, path: Path) -> None:
    """Writes one episode."""
    arrays = {
        "/".join(("inputs", rows, str(block), tokens)): values
        for (rows, block, tokens), values in frames.inputs.items()
    }
    arrays |= {f"targets/{name}": values for name, values in frames.targets.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def load_frames(path: Path) -> Frames:
    """Reads what ``save_frames`` wrote."""
    inputs: dict[Input, FloatArray] = {}
    targets: dict[str, FloatArray] = {}
    with np.load(path, allow_pickle=False) as arrays:
        for key in arrays.files:
            kind, *name = key.split("/")
            if kind == "inputs":
                inputs[name[0], int(name[1]), name[2]] = arrays[key]
            else:
                targets[name[0]] = arrays[key]
    zeros = np.zeros(len(next(iter(targets.values()))), np.int64)
    return Frames(zeros, zeros, inputs, targets)
