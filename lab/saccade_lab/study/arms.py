"""Studies of arms: every arm changes the head in one way and runs on the same observations and noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.head.intervention import Intervention
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.source import Source, changed, unchanged
from saccade_lab.study.study import Study

NO_TOKENS = "the checkpoint has no future tokens"
ROUNDING = 1e-3  # a change of an action that an exact identity may make


@dataclass(frozen=True)
class Arm:
    """One change inside the head, which applies during a whole episode.

    Attributes:
        name: Name in the table and on the command line.
        label: Name in figures. Default: ``name``.
        about: Description for the report.
        intervention: Function from the learned future tokens ``(N, width)`` and the random numbers of the
            episode to the intervention, or to None for no change.
        needs_future: Whether it requires future tokens.
        settings: Further JSON values that its results depend on. Change them together with ``intervention``,
            so that cells measured earlier are measured again.

    Example:
        An arm of your own:

        >>> doubled = Arm(
        ...     "future-doubled", intervention=lambda tokens, rng: Intervention(future_tokens=2 * tokens)
        ... )
    """

    name: str
    label: str = ""
    about: str = ""
    intervention: Callable[[Float32Array, np.random.Generator], Intervention | None] = lambda tokens, rng: (
        None
    )
    needs_future: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.name)

    def why_not(self, num_future_tokens: int) -> str | None:
        """The reason why a head with N future tokens cannot be measured, or None."""
        if self.needs_future and num_future_tokens == 0:
            return NO_TOKENS
        return None


@dataclass(frozen=True)
class Metric:
    """A number that says how the chunks of an arm differ from the unchanged ones.

    Attributes:
        name: Its column in the table.
        function: Function from the unchanged chunks and those of the arm, both `(observations, draws,
            horizon, action_dim)` float32 from equal noise, to a number.

    Example:
        How far the first action of a chunk moves:

        >>> first = Metric("first_action", lambda before, after: np.abs(after - before)[:, :, 0].mean())
    """

    name: str
    function: Callable[[Float32Array, Float32Array], Any]


METRICS = (
    Metric("chunk_change", lambda before, after: np.abs(after - before).mean()),
    Metric("chunk_change_max", lambda before, after: np.abs(after - before).max()),
)


@dataclass(frozen=True)
class ArmStudy(Study):
    """A study that measures every arm on every episode of a source.

    Attributes:
        source: Checkpoint and observations.
        arms: The arms. The baseline is always measured as well.
        metrics: The measured columns of the table.

    Raises:
        InputError: Two arms or two metrics have the same name.
    """

    source: Source
    arms: Sequence[Arm]
    metrics: Sequence[Metric] = METRICS
    baseline: ClassVar[Arm]
    control: ClassVar[str]

    def __post_init__(self) -> None:
        for what, given in (("arms", self.arms), ("metrics", self.metrics)):
            names = [one.name for one in given]
            if len(set(names)) != len(names):
                raise InputError(f"{what}: given {', '.join(names)}, expected distinct names")

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        own = [metric.name for metric in self.metrics if metric not in METRICS]
        return {**self.source.describe(), **({"metrics": own} if own else {})}

    @property
    def all_arms(self) -> dict[str, Arm]:
        """The baseline and the others, by name."""
        return {arm.name: arm for arm in (self.baseline, *self.arms)}

    def cells(self) -> Sequence[Cell]:
        """An episode of one arm each; arms of one episode follow each other, to share what it recorded."""
        return [
            Cell((*unit, arm.name), arm.settings)
            for unit in self.source.units
            for arm in self.all_arms.values()
        ]

    def measure(self, cell: Cell) -> Rows:
        """A row with the outcome and the metrics, or with a note why the arm cannot be measured."""
        task, seed, name = str(cell.key[0]), int(cell.key[1]), str(cell.key[2])
        source, arm = self.source, self.all_arms[name]
        row: dict[str, Any] = {"task": task, "seed": seed, "arm": name, **source.labels(task, seed)}
        tokens = source.future_tokens
        note = arm.why_not(len(tokens))
        if note is not None:
            return [{**row, "success": None, "note": note}]
        intervention = arm.intervention(tokens, source.rng(task, seed))
        before = unchanged(source, task, seed).actions
        try:
            after = changed(source, task, seed, intervention)
        except (
            InputError
        ) as error:  # a change that this head cannot have, such as one in blocks that it lacks
            return [{**row, "success": None, "note": str(error)}]
        row |= source.outcome(task, seed, intervention)
        row |= {metric.name: float(metric.function(before, after)) for metric in self.metrics}
        if not source.closed_loop:
            row["noise_change"] = between_draws(before)
        return [{**row, "note": None}]


def between_draws(chunks: Float32Array) -> float | None:
    """The mean absolute difference of an action between two chunks of one observation from different noise.

    Args:
        chunks: ``(1, draws, horizon, action_dim)``.
    """
    drawn = chunks[0]
    if len(drawn) < 2:
        return None
    one, two = np.triu_indices(len(drawn), k=1)
    return float(np.abs(drawn[one] - drawn[two]).mean())
