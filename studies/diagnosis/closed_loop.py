"""Does closed loop confirm the verdicts? Success of the trial's copies with and without each input.

    python studies/diagnosis/closed_loop.py WORK studies/diagnosis/blind-trial-2.json OUT [--jobs 2]

Runs the bundled policy, and the first copy of each kind in WORK, whose labels the JSON file has since the
trial was opened. OUT receives a row for each episode, and the table of README.md is printed. A run that was
stopped goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from saccade._internal.flags import add_processes
from saccade_lab.parallel.arguments import workers_of
from saccade_lab.sim.environment_cache import cached_environment
from saccade_lab.sim.policy import Chunk, Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.run import run_cells
from saccade_lab.study.section import points, rate
from saccade_lab.study.simulator import policy_of
from saccade_lab.study.statistics import paired_difference, wilson

SEEDS = range(600, 612)
CAMERAS = ("left", "right", "top")
#: Inputs as `saccade diagnose` names them, and how closed loop is without each.
ARMS = ("unchanged", "instruction", *(f"camera.{name}" for name in CAMERAS), "state")


class Frozen(Policy):
    """A policy that sees the first state of an episode throughout."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy.whole, policy.config, policy.checkpoint, policy.engine)
        self._first: Any = None

    def act(self, seen: Mapping[str, Any], **options: Any) -> Chunk:
        """See ``Policy``."""
        if self._first is None:
            self._first = np.array(seen["proprio"])
        return super().act({**seen, "proprio": self._first}, **options)


@dataclass(frozen=True)
class Run:
    """Runs the episodes of a task for one policy without one input."""

    folders: Mapping[str, str]

    def __call__(self, cell: Cell) -> Rows:
        """A row for each seed."""
        label, arm, task = map(str, cell.key)
        policy = policy_of(self.folders[label])
        blanked = (arm.removeprefix("camera."),) if arm.startswith("camera.") else ()
        environment = cached_environment(
            (label, task, blanked), lambda: environment_for(policy, task, blanked=blanked)
        )
        tasks = policy.config.tasks
        other = tasks[(tasks.index(task) + 1) % len(tasks)] if arm == "instruction" else None
        rows = []
        for seed in SEEDS:
            one = Frozen(policy) if arm == "state" else policy
            episode = run_episode(environment, one, seed, instruction_from=other)
            rows.append(
                {"policy": label, "without": arm, "task": task, "seed": seed, "success": episode.success}
            )
        return rows


def main() -> None:
    """Runs the episodes and prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path)
    parser.add_argument("trial", type=Path)
    parser.add_argument("out", type=Path)
    add_processes(parser, "episodes")
    args = parser.parse_args()
    trial = json.loads(args.trial.read_text(encoding="utf-8"))["checkpoints"]
    folders = {"bundled": str(saccade.demo_checkpoint())}
    for name, one in trial.items():
        folders.setdefault(one["label"], str((args.work / name).absolute()))
    tasks = policy_of(folders["bundled"]).config.tasks
    hashes = {label: policy_of(folder).checkpoint_sha256() for label, folder in folders.items()}
    cells = [
        Cell((label, arm, task), {"sha256": hashes[label]})
        for label in folders
        for arm in ARMS
        for task in tasks
    ]
    table = run_cells("closed-loop", cells, Run(folders), args.out, settings={}, workers=workers_of(args))
    print("| policy | without | success, % | minus unchanged |\n|---|---|---|---|")
    for label in folders:
        arms = {
            arm: part.sort_values(["task", "seed"])["success"].astype(bool).tolist()
            for arm, part in table[table["policy"] == label].groupby("without")
        }
        for arm in ARMS:
            wins = arms[arm]
            found = paired_difference(wins, arms["unchanged"]).difference
            minus = "" if arm == "unchanged" else points(found)
            print(f"| {label} | {arm} | {rate(wilson(sum(wins), len(wins)))} | {minus} |")


if __name__ == "__main__":
    main()
