"""Does guidance make a policy listen? Demonstrations, policies, closed loop and tables of the study.

    python studies/guidance/guidance.py demos --out OUT --jobs -1    record, and choose the demonstrations
    python studies/guidance/guidance.py train --out OUT              train the policies, one after the other
    python studies/guidance/guidance.py judge --out OUT --jobs -1    run the episodes of all arms
    python studies/guidance/guidance.py report --out OUT             print the tables of README.md

`report --out studies/guidance` reads the results of README.md.
Every part resumes where it stopped. README.md in this folder has the plan.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from saccade._internal.arrays import Float32Array
from saccade._internal.flags import add_processes
from saccade.errors import InputError
from saccade_lab.parallel.arguments import workers_of
from saccade_lab.sim import demos
from saccade_lab.sim.environment_cache import cached_environment
from saccade_lab.sim.policy import Chunk, Interventions, Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.sim.scenarios import NamedBall
from saccade_lab.sim.settings import GROUPS
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.run import run_cells
from saccade_lab.study.section import points, rate
from saccade_lab.study.simulator import policy_of
from saccade_lab.study.statistics import holm, paired_difference, verdict, wilson
from saccade_lab.study.table import read_study, truths
from saccade_lab.training.settings import TrainingSettings

TASKS = ("touch-yellow", "touch-blue")
RECORDED, CHOSEN = 400, 200  # demonstrations of each task: all of them, and of the confounded recording
ON_THE_RIGHT = 180  # of a task's confounded demonstrations have the named ball on the right

#: Trained from random weights, and from the weights of a policy that follows instructions.
FROM_RANDOM = TrainingSettings(steps=16_000, absent_share=0.0)
TUNED = TrainingSettings(steps=4000, learning_rate=3e-4, absent_share=0.0)
#: Instead of the plan's steps with `train --large-steps`, for a GPU: fewer of them, four times as large.
LARGE = {"steps": 3000, "batch_size": 64}
EPISODES = 300  # of each task; the named ball is on the right in one of the two tasks of a seed
BLOCK = 10  # seeds of a cell
WEIGHTS = (0.0, 1.5, 2.0, 3.0, 5.0)
PRIMARY = 2.0  # the weight of the tests
WITHOUT = ("default", "empty")

COLUMNS = (
    "scenes",
    "without",
    "w",
    "success, %",
    "wrong ball, %",
    "follows, %",
    "minus w = 1",
    "verdict",
    "right ball by task",
)


@dataclass(frozen=True)
class Trained:
    """A policy of the plan.

    Attributes:
        kind: One of ``KINDS``.
        language_dropout: The share of dropped instructions.
        seed: Of the training.
    """

    kind: str
    language_dropout: float
    seed: int

    @property
    def name(self) -> str:
        """Its name, and that of its folder."""
        return f"{self.kind}-dropout-{round(100 * self.language_dropout)}-seed-{self.seed}"

    @property
    def recording(self) -> str:
        """The folder of its demonstrations."""
        return "all" if self.kind == "balanced" else "confounded"


KINDS = ("balanced", "tuned", "confounded")
SHARES = (0.0, 0.1)
START = Trained("balanced", 0.0, 0)  # of those that are tuned
POLICIES = (
    START,
    *(Trained("tuned", share, 0) for share in SHARES),
    *(Trained("confounded", share, 0) for share in SHARES),
    *(Trained("tuned", share, seed) for seed in (1, 2) for share in SHARES),
)
TESTED = tuple(one.name for one in POLICIES if (one.kind, one.seed) == ("tuned", 0))
#: Weight and ``without`` of every arm, the unchanged policy and those of the tests first.
ARMS: tuple[tuple[float, str | None], ...] = (
    (1.0, None),
    *((PRIMARY, without) for without in WITHOUT),
    *((weight, without) for without in WITHOUT for weight in WEIGHTS if weight != PRIMARY),
)
NUM_TESTS = len(TESTED) * len(WITHOUT)


def record(out: Path, args: argparse.Namespace) -> None:
    """Records demonstrations, and chooses those of each recording."""
    everything = out / "demos" / "all"
    counts = dict.fromkeys(TASKS, RECORDED)
    demos.record_tasks(counts, everything, demos.RecordingSettings(), lambda task: None, workers_of(args))
    for task in TASKS:
        chosen = out / "demos" / "confounded" / task
        chosen.mkdir(parents=True, exist_ok=True)
        for path in (*choose(everything, task, ON_THE_RIGHT), everything / task / "recording.json"):
            shutil.copyfile(path, chosen / path.name)


def choose(recorded: Path, task: str, on_the_right: int) -> list[Path]:
    """``CHOSEN`` demonstrations of a task, so many of them with the named ball on the right.

    Raises:
        InputError: Too few were recorded.
    """
    missing = {True: on_the_right, False: CHOSEN - on_the_right}
    found = []
    for seed, demonstration in demos.episodes(recorded, task, images=False):
        yellow, blue = demonstration.targets[0, 0], demonstration.targets[0, 3]
        is_right = bool(yellow > blue) == (task == "touch-yellow")
        if missing[is_right]:
            missing[is_right] -= 1
            found.append(recorded / task / f"{seed}.npz")
    if any(missing.values()):
        raise InputError(f"{recorded / task}: expected {on_the_right} on the right, {missing} are missing")
    return found


def train_all(out: Path, names: Sequence[str], device: str, *, large: bool) -> None:
    """Trains the policies of these names in the order of the plan."""
    import torch

    from saccade_lab.training.train import train

    torch.set_num_threads(1)
    for policy in POLICIES:
        if policy.name not in names:
            continue
        is_tuned = policy.kind == "tuned"
        settings = replace(
            TUNED if is_tuned else FROM_RANDOM, seed=policy.seed, language_dropout=policy.language_dropout
        )
        if large:
            settings = replace(settings, learning_rate=2 * settings.learning_rate, **LARGE)
        began = time.monotonic()
        train(
            out / "demos" / policy.recording,
            out / policy.name,
            settings,
            lambda progress: None,
            start=out / START.name if is_tuned else None,
            device=device,
        )
        print(f"{policy.name}: {time.monotonic() - began:.0f} s", flush=True)


class Guided(Policy):
    """A policy under one arm."""

    def __init__(self, policy: Policy, weight: float, without: str | None) -> None:
        super().__init__(policy.whole, policy.config, policy.checkpoint, policy.engine)
        self.guidance = {} if without is None else {"guidance": weight, "without": without}

    def act(
        self, seen: Mapping[str, Any], *, noise: Float32Array, intervention: Interventions = None
    ) -> Chunk:
        """See ``Policy``. The whole time is that of the sampling."""
        start = time.perf_counter()
        answer = self.whole.act(
            self.observation(seen), noise=noise, intervention=intervention, **self.guidance
        )
        spent = {"backbone": 0.0, "encode": 0.0, "sample": 1e3 * (time.perf_counter() - start)}
        return Chunk(np.clip(np.concatenate([answer[name][0] for name in GROUPS], axis=-1), -1.0, 1.0), spent)


@dataclass(frozen=True)
class Judge:
    """Runs the episodes of a cell: a policy under an arm, a task and a block of seeds."""

    out: Path

    def __call__(self, cell: Cell) -> Rows:
        """A row for each seed."""
        arm, name, task, first = cell.key
        weight, without = ARMS[int(arm)]
        policy = policy_of(str(self.out / str(name)))
        environment = cached_environment((str(name), str(task)), lambda: environment_for(policy, str(task)))
        scenario = environment.scenario
        assert isinstance(scenario, NamedBall)
        rows = []
        for seed in range(int(first), int(first) + BLOCK):
            episode = run_episode(environment, Guided(policy, weight, without), seed)
            rows.append(
                {
                    "policy": name,
                    "task": task,
                    "seed": seed,
                    "weight": weight,
                    "without": without or "",
                    "agrees": scenario.is_right,
                    "success": episode.success,
                    "wrong": scenario.touched == 1 - scenario.named,
                    "steps": episode.steps,
                }
            )
        return rows


def judge(out: Path, names: Sequence[str], args: argparse.Namespace) -> None:
    """Runs every episode that has not been run, of those of these policies that are trained; tests first."""
    trained = [one for one in POLICIES if one.name in names and (out / one.name / "config.json").is_file()]
    hashes = {one.name: policy_of(str(out / one.name)).checkpoint_sha256() for one in trained}
    cells = [
        Cell((arm, one.name, task, first), {"sha256": hashes[one.name]})
        for repeated in (False, True)
        for arm in range(len(ARMS))
        for one in trained
        if (one.seed > 0) == repeated
        for first in range(0, EPISODES, BLOCK)
        for task in TASKS
    ]
    run_cells("guidance", cells, Judge(out.absolute()), out, settings={}, workers=workers_of(args))


def rows_of(table: pd.DataFrame, policy: str, agrees: bool) -> Iterator[tuple[Any, Any, pd.DataFrame]]:
    """The episodes of every arm, in the order of their seeds."""
    part = table[(table["policy"] == policy) & (table["agrees"] == agrees)]
    for weight, without in ARMS:
        meaning = part["without"].isna() if without is None else part["without"] == without
        arm = part[(part["weight"] == weight) & meaning]
        yield weight, without, arm.sort_values(["seed", "task"])


def report(out: Path) -> None:
    """Prints a table for each policy, and the tests."""
    table, _ = read_study(out, "guidance")
    table = table.assign(success=truths(table["success"]), wrong=truths(table["wrong"]))
    tests: list[tuple[str, float]] = []
    for policy in table["policy"].unique():
        print(f"\n{policy}\n\n| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
        for agrees in (False, True):
            arms = list(rows_of(table, policy, agrees))
            plain = arms[0][2]
            for weight, without, arm in arms:
                if len(plain) != EPISODES or len(arm) != EPISODES:
                    continue  # not run to its end
                wins, wrong = arm["success"], arm["wrong"]
                touched = int(wins.sum() + wrong.sum())
                pair = paired_difference(wins.tolist(), plain["success"].tolist())
                cells = [
                    "as demonstrated" if agrees else "the other way",
                    without or "",
                    f"{weight:g}",
                    rate(wilson(int(wins.sum()), len(arm))),
                    rate(wilson(int(wrong.sum()), len(arm))),
                    rate(wilson(int(wins.sum()), touched)),
                    "" if without is None else points(pair.difference),
                    "" if without is None else verdict(pair.difference),
                    ", ".join(
                        f"{task} {part['success'].sum()} of {len(part)}" for task, part in arm.groupby("task")
                    ),
                ]
                print(f"| {' | '.join(cells)} |")
                if not agrees and weight == PRIMARY and policy in TESTED:
                    tests.append((f"{policy}, without {without}", pair.p_value))
    # A test whose policy is not trained yet, or whose episodes are missing, counts as one that found nothing.
    corrected = holm([p for _, p in tests] + [1.0] * (NUM_TESTS - len(tests)))
    for (name, p), after in zip(tests, corrected, strict=False):
        print(f"\n{name}, w = {PRIMARY:g} against 1, the other way: p {p:.2g}, after Holm {after:.2g}")


def main() -> None:
    """Runs one part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("part", choices=("demos", "train", "judge", "report"))
    parser.add_argument("--out", type=Path, default=Path("out/guidance"))
    names = [one.name for one in POLICIES]
    parser.add_argument(
        "--policies",
        nargs="+",
        choices=names,
        default=names,
        help="train or judge only these",
        metavar="NAME",
    )
    parser.add_argument("--large-steps", action="store_true", help=f"train by {LARGE}")
    parser.add_argument("--device", default="cpu", help="torch's name of the device to train on")
    add_processes(parser, "episodes")
    args = parser.parse_args()
    if args.part == "demos":
        record(args.out, args)
    elif args.part == "train":
        train_all(args.out, args.policies, args.device, large=args.large_steps)
    elif args.part == "judge":
        judge(args.out, args.policies, args)
    else:
        report(args.out)


if __name__ == "__main__":
    main()
