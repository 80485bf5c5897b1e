"""How much of the layout a linear probe finds in the rows of a trained policy, block by block."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from saccade.head.intervention import ROW_GROUPS
from saccade_lab.study.cell import Rows
from saccade_lab.study.linear_probes import FOLDS, PROPRIO, VL, Frames, Input, join, probe

if TYPE_CHECKING:
    from saccade.head.head import ActionHead
    from saccade_lab.study.simulator import Recorded

#: The stage, for all trained policies.
PROBES = "probes"
#: What a probe predicts: where things are.
POSITIONS = ("object", "goal")
DIMENSIONS = 64  # that a probe reads


def measure(checkpoint: str, tasks: Sequence[str], seeds: range) -> Rows:
    """Probes of the rows at the first Euler step, and of what the head is given, for comparison.

    Args:
        checkpoint: Directory of the policy.
        tasks, seeds: The episodes, of the unchanged policy.

    Returns:
        A row for each group of rows and each block, `group`, `block` and `r2`: R² of a linear probe of the
        positions of object and goal (the mean of the two) that reads the mean of the group's rows after the
        block, on episodes that it was not fitted to, of the variance within a task. Block -1 are inputs of
        the head: the state (`proprioception`) and all image tokens after VL self-attention (`vl_embs`).
        Nothing with fewer episodes than `FOLDS`, or if nothing moves.
    """
    from saccade_lab.study.simulator import Simulator

    source = Simulator(checkpoint, tuple(tasks), seeds)
    head = source.head()
    frames = [frames_of_means(head, source.recorded(task, seed), ROW_GROUPS) for task, seed in source.units]
    found = r2_of_positions(frames, [tasks.index(task) for task, _ in source.units])
    return [{"group": rows, "block": block, "r2": r2} for (rows, block, _), r2 in found.items()]


def frames_of_means(head: ActionHead, recorded: Recorded, groups: Collection[str]) -> Frames:
    """What probes of an episode read and predict.

    Args:
        head: Head of the policy.
        recorded: The episode.
        groups: Groups of rows, of `ROW_GROUPS`.

    Returns:
        The mean of the rows of each group after each block at the first Euler step, for a group of a single
        row that row; the inputs that `probe` compares others with; and the positions.
    """
    from saccade_lab.study.questions.probes import frames_of

    frames = frames_of(head, recorded, 0)
    means = {(rows, block) for rows, block, tokens in frames.inputs if tokens == "mean"}
    inputs = {
        source: values
        for source, values in frames.inputs.items()
        if source in (PROPRIO, VL)
        or (source[0] in groups and (source[2] == "mean" or source[:2] not in means))
    }
    return replace(frames, inputs=inputs, targets={name: frames.targets[name] for name in POSITIONS})


def r2_of_positions(frames: Sequence[Frames], numbers: Sequence[int]) -> Mapping[Input, float]:
    """The mean R² over the positions that move, of each input.

    Args:
        frames: Those of each episode.
        numbers: The task number of each episode.

    Returns:
        By input; empty with fewer episodes than `FOLDS`, or if nothing moves.
    """
    if len(frames) < FOLDS:
        return {}
    rows = probe(join(frames, numbers), DIMENSIONS)
    found: dict[Input, list[float]] = {}
    for row in rows:
        found.setdefault((row["rows"], row["block"], row["tokens"]), []).append(row["r2"])
    return {source: float(np.mean(values)) for source, values in found.items()}
