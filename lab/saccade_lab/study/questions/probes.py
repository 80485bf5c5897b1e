"""``saccade study probes``: what linear probes read from the head's rows, block by block.

Episodes of the policy in closed loop are traced. From the rows after each block, ridge regressions are fitted
to what the simulator knows (positions of object, goal and hand, opening of the gripper), judged on episodes
that they were not fitted to, and compared with probes of the image tokens that the head reads.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pandas as pd

from saccade._internal.flags import add_integer
from saccade.errors import InputError
from saccade.head.head import ActionHead
from saccade.head.intervention import ROW_GROUPS
from saccade_lab.flags import add_rollout_arguments
from saccade_lab.study.arguments import simulator_of
from saccade_lab.study.cell import Cell, Rows, digest
from saccade_lab.study.linear_probes import (
    FOLDS,
    PROPRIO,
    VL,
    FloatArray,
    Frames,
    Input,
    join,
    load_frames,
    probe,
    save_frames,
)
from saccade_lab.study.questions.probes_section import ALL_TASKS, section
from saccade_lab.study.section import Section
from saccade_lab.study.study import Study
from saccade_lab.study.table import Provenance

if TYPE_CHECKING:
    from saccade_lab.study.simulator import Recorded, Simulator

TARGETS = ("object", "goal", "hand", "gripper")

EPILOG = """\
Runs the policy in closed loop, traces it at every observation, and fits linear probes (ridge regressions on
principal components) to the positions of object, goal and hand and to the opening of the gripper. Every probe
is judged on episodes that it was not fitted to; R^2 is of the variance within a task.

examples:
  saccade study probes --out out/study
  saccade study probes --checkpoint out/policy --tasks push two-goals --episodes 40 --step 3 --out out/study
"""


@dataclass(frozen=True)
class Probes(Study):
    """What can be read linearly from the rows after each block.

    Attributes:
        source: The episodes.
        step: The Euler step at which rows are taken. At step 0 the action rows start from noise, so all
            information that is found in them was read from other rows or tokens.
        dimensions: Principal components that a probe reads at most.
        frames: Directory of the traced episodes, which ``begin`` sets.
        recorded: Whether all episodes are recorded, so that probes can be fitted.
    """

    source: Simulator
    step: int = 0
    dimensions: int = 64
    frames: Path | None = None
    recorded: bool = False
    name: ClassVar[str] = "probes"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=20)
        add_integer(parser, "--step", minimum=0, default=0, help="Euler step at which rows are taken")
        add_integer(parser, "--dimensions", default=64, help="principal components that a probe reads")

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Probes:
        """See ``Study``."""
        source = simulator_of(args)
        if len(source.seeds) < FOLDS:
            raise InputError(
                f"--episodes: given {len(source.seeds)}, expected at least {FOLDS}, one for each fold"
            )
        if args.step >= source.config.num_steps:
            raise InputError(f"--step: given {args.step}, expected 0 to {source.config.num_steps - 1}")
        return cls(source, args.step, args.dimensions)

    def begin(self, out: Path) -> Probes:
        """See ``Study``."""
        return replace(self, frames=out / self.name / f"frames-{digest(self.settings())}")

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        return {**self.source.describe(), "step": self.step}

    @property
    def scopes(self) -> dict[str, list[str]]:
        """The sets of tasks that probes are fitted to: each task, and all tasks together."""
        scopes = {task: [task] for task in self.source.tasks}
        if len(self.source.tasks) > 1:
            scopes[ALL_TASKS] = list(self.source.tasks)
        return scopes

    @property
    def num_cells(self) -> int:
        """See ``Study``."""
        return len(self.source.units) + len(self.scopes)

    def cells(self) -> Sequence[Cell]:
        """The episodes and, when these are done, the probes of each scope."""
        episodes = [Cell(("episode", task, seed)) for task, seed in self.source.units]
        if not self.recorded:
            return episodes
        seeds = [self.source.seeds.start, len(self.source.seeds)]
        return episodes + [
            Cell(("probe", scope), {"tasks": tasks, "seeds": seeds, "dimensions": self.dimensions})
            for scope, tasks in self.scopes.items()
        ]

    def then(self, table: pd.DataFrame) -> Probes | None:
        """See ``Study``."""
        return None if self.recorded else replace(self, recorded=True)

    def measure(self, cell: Cell) -> Rows:
        """An episode, whose frames are written to a file, or all probes of a scope."""
        if cell.key[0] == "episode":
            _, task, seed = cell.key
            return [self.record(str(task), int(seed))]
        scope = str(cell.key[1])
        tasks = self.scopes[scope]
        parts, numbers = [], []
        for task in tasks:
            for seed in self.source.seeds:
                if not self.path(task, seed).exists():  # someone may have kept only the table
                    self.record(task, seed)
                parts.append(load_frames(self.path(task, seed)))
                numbers.append(tasks.index(task))
        found = probe(join(parts, numbers), self.dimensions)
        return [{"kind": "probe", "task": scope, **row} for row in found]

    def path(self, task: str, seed: int) -> Path:
        """Path of an episode's frames."""
        assert self.frames is not None
        return self.frames / f"{task}-{seed}.npz"

    def record(self, task: str, seed: int) -> dict[str, Any]:
        """Runs an episode and writes its frames."""
        recorded = self.source.recorded(task, seed)
        save_frames(frames_of(self.source.head(), recorded, self.step), self.path(task, seed))
        return {
            "kind": "episode",
            "task": task,
            "seed": seed,
            "success": recorded.episode.success,
            "frames": len(recorded.observation),
        }

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        return section(table, provenance)


def frames_of(head: ActionHead, recorded: Recorded, step: int) -> Frames:
    """The observations of one episode, traced at one Euler step.

    Args:
        head: Head of the policy.
        recorded: The episode.
        step: The Euler step at which rows are taken.
    """
    parts: dict[Input, list[FloatArray]] = {}

    def add(rows: str, block: int, tokens: FloatArray) -> None:
        """All tokens, and if there are several their mean."""
        parts.setdefault((rows, block, "all"), []).append(tokens.ravel())
        if len(tokens) > 1:
            parts.setdefault((rows, block, "mean"), []).append(tokens.mean(axis=0))

    for observation in recorded.observation.rows():
        context = observation.encode(head)
        trace = observation.trace(head, context, record=("hidden",), steps=[step])
        add(PROPRIO[0], -1, observation.state)
        # Image tokens only: instructions differ in length, and a probe reads as many tokens in every episode.
        assert observation.image_mask is not None
        images = observation.image_mask[0]
        add("features", -1, observation.backbone_features[0, images])
        add(VL[0], -1, np.asarray(context.vl_embs)[0, images])
        for (_, block), hidden in trace.hidden.items():
            for group in ROW_GROUPS:
                tokens = np.asarray(hidden)[0, trace.rows[group]]
                if len(tokens):
                    add(group, block, tokens)
    targets = {name: getattr(recorded.privileged, name) for name in TARGETS}
    inputs = {source: np.stack(values) for source, values in parts.items()}
    zeros = np.zeros(len(recorded.observation), np.int64)
    return Frames(zeros, zeros, inputs, targets)
