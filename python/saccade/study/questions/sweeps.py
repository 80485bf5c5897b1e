"""`saccade study n | tvl | vlsa`: policies that differ in one respect, side by side.

Each sweep trains policies, or reads trained ones, in which the number of future tokens (and how they were
trained), the number of vision-language tokens, or the depth of the VL self-attention varies and all else is
fixed. All of them run the same episodes; what they cost is measured at the end, alone and interleaved.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.intervention import Intervention
from saccade.sim import demos, graphics
from saccade.sim.dataset import describe
from saccade.sim.policy import EMBODIMENT_ID
from saccade.sim.rollout import run_episode
from saccade.sim.settings import CONFIG_FILE, PolicyConfig
from saccade.sim.tasks import check_evaluation_seeds
from saccade.study.arguments import UNLIMITED, names, numbers
from saccade.study.cells import Cell, OnDone, Rows, run_cells
from saccade.study.loaded import environment_of, policy_of
from saccade.study.observations import task_names
from saccade.study.section import Section
from saccade.study.statistics import bootstrap, detectable_between_runs, detectable_difference
from saccade.study.sweeps_report import PLAIN, statement_lines, sweep_section
from saccade.study.tables import Provenance
from saccade.study.trained import Run, describe_run, find_runs, read_run

if TYPE_CHECKING:
    from saccade.sim.train import TrainingSettings

EPILOG = """\
Either reads finished runs of `saccade train` (--policies), which must differ in nothing else, or trains them
(--demos) in OUT/policies. Says first what so many runs and episodes can detect. Success is of equal episodes;
latency is measured after all else, in one process, interleaved.

examples:
  saccade study {study} --policies out/policies --out out/study
  saccade study {study} --demos out/demos {option} {values} --training-seeds 0,1 --jobs 2 --out out/study
"""

# What the statement before the runs supposes; with few runs neither can be known beforehand.
SUPPOSED_RATE, SUPPOSED_DEVIATIONS, SUPPOSED_DISCORDANT = 0.7, (0.04, 0.08), (0.1, 0.25)
ROUNDS = 200  # of the timing; each round times every policy once


def held_equal(training: Mapping[str, Any], sweep: Sweep) -> dict[str, Any]:
    """What of a run's settings must be the same in all runs of a sweep."""
    held = {name: value for name, value in training.items() if name not in ("seed", *sweep.varied)}
    if sweep.other_pictures:
        held["demonstrations"] = training["demonstrations"]["tasks"]
    if not training.get("alignment_weight"):
        held.pop("alignment_block", None)  # it means nothing there
    return held


def check_comparable(runs: Sequence[Run], sweep: Sweep) -> None:
    """Raises `InputError` if runs differ in anything but what the sweep varies and the training seed.

    Also if two of them are the same point with the same seed, or have the same name. All that differs is
    listed.
    """
    held = {run.name: held_equal(run.settings, sweep) for run in runs}
    problems = []
    for name in dict.fromkeys(itertools.chain.from_iterable(held.values())):
        values: dict[str, list[str]] = {}
        for who, settings in held.items():
            if name in settings:
                values.setdefault(json.dumps(settings[name], sort_keys=True), []).append(who)
        if len(values) > 1:
            shown = "; ".join(f"{value} ({', '.join(who)})" for value, who in values.items())
            problems.append(f"{name}: {shown}")
    twice = [
        f"{one.name} and {other.name} are the same point with the same seed"
        for one, other in itertools.combinations(runs, 2)
        if (one.point, one.seed) == (other.point, other.seed) or one.name == other.name
    ]
    if problems or twice:
        varied = ", ".join(sweep.varied)
        raise InputError(
            f"policies: expected runs that differ in {varied} and seed only. {'. '.join(problems or twice)}"
        )


@dataclass(frozen=True)
class Planned:
    """A run to be trained.

    Attributes:
        name: Of its directory.
        demonstrations: Directory of `saccade demos`.
        training: How.
    """

    name: str
    demonstrations: str
    training: TrainingSettings


@dataclass(frozen=True)
class Settings:
    """What to compare.

    Attributes:
        policies: Directories of runs; empty if runs are trained.
        planned: Runs to be trained, in `OUT/policies`.
        tasks, seeds: The episodes of every policy, each seed in each task.
    """

    policies: tuple[str, ...]
    planned: tuple[Planned, ...]
    tasks: tuple[str, ...]
    seeds: range


@dataclass(frozen=True)
class Work:
    """All kinds of cells: the statement before, a training, an episode, and what the policies cost.

    Attributes:
        runs: Name to directory.
        planned: Name to what is trained there first.
        varied: What varies.
    """

    runs: Mapping[str, Path]
    planned: Mapping[str, Planned]
    varied: tuple[str, ...]

    def __call__(self, cell: Cell) -> Rows:
        """The rows of a cell, by the first word of its key."""
        kind = str(cell.key[0])
        if kind == "before":
            rows = statement(int(cell.settings["runs"]), int(cell.settings["episodes"]))
        elif kind == "training":
            rows = [self.training(str(cell.key[1]))]
        elif kind == "episode":
            rows = [self.episode(cell)]
        else:
            rows = cost([self.read(name) for name in cell.settings["policies"]])
        return [{"kind": kind, **row} for row in rows]

    def read(self, name: str) -> Run:
        """A run by name."""
        return read_run(self.runs[name], self.varied)

    def training(self, name: str) -> dict[str, Any]:
        """Trains if that is asked for, then says how the training ended."""
        if name in self.planned:
            import torch

            from saccade.sim.train import train

            torch.set_num_threads(1)
            plan = self.planned[name]
            train(Path(plan.demonstrations), self.runs[name], plan.training, lambda progress: None)
        run = self.read(name)
        note = None if run.finished else f"in training, step {run.step} of {run.settings['steps']}"
        loss = run.history[-1]["validation_loss"] if run.finished else None
        return {**describe_run(run), "validation_loss": loss, "steps": run.step, "note": note}

    def episode(self, cell: Cell) -> dict[str, Any]:
        """One episode of one policy; an arm other than `PLAIN` weighs the future keys like another N."""
        _, name, arm, task, seed = cell.key
        run, mass = self.read(str(name)), cell.settings["mass"]
        checkpoint = str(run.directory)
        change = None if mass is None else equal_mass(int(run.point["num_future_tokens"]), int(mass))
        environment = environment_of(checkpoint, str(task))
        episode = run_episode(environment, policy_of(checkpoint), int(seed), intervention=change)
        result = {"arm": arm, "task": task, "seed": seed, "success": episode.success, "steps": episode.steps}
        return {**describe_run(run), **result}


def equal_mass(num_tokens: int, like: int) -> Intervention:
    """Gives `num_tokens` future keys the weight in the softmax that so many others would have.

    Example:
        >>> float(np.exp(equal_mass(8, 32).key_bias["future", None]))
        4.0
    """
    return Intervention(key_bias={"future": math.log(like / num_tokens)})


def statement(runs: int, episodes: int) -> Rows:
    """What can be detected with so many runs a point and episodes a run, under several suppositions."""
    rows: Rows = [
        {
            "comparison": "two trained policies on the same episodes",
            "supposed": f"{100 * share:.0f} % of the episodes go one way in one and the other way in the "
            "other",
            "detectable": detectable_difference(episodes, share),
        }
        for share in SUPPOSED_DISCORDANT
    ]
    rows += [
        {
            "comparison": f"two points of {runs} training runs each",
            "supposed": f"a rate of {100 * SUPPOSED_RATE:.0f} %, which varies by {100 * deviation:.0f} "
            "points between training seeds",
            "detectable": detectable_between_runs(SUPPOSED_RATE, episodes, runs, deviation),
        }
        for deviation in SUPPOSED_DEVIATIONS
    ]
    return rows


def cost(runs: Sequence[Run]) -> Rows:
    """Latency and memory of the head, one thread, interleaved: each round times every policy once.

    Args:
        runs: one of each point; ratios are to the first.
    """
    rng = np.random.default_rng(0)
    heads, inputs = [], []
    for run in runs:
        head = ActionHead.load(run.directory, num_threads=1)
        config = head.config
        tokens = int(PolicyConfig.from_file(run.directory / CONFIG_FILE).backbone.num_tokens)
        features = rng.standard_normal((1, tokens, config.context_dim), dtype=np.float32)
        state = rng.standard_normal((1, config.state_dim), dtype=np.float32)
        noise = rng.standard_normal((1, config.action_horizon, config.encoder_action_dim), dtype=np.float32)
        head.warmup(tokens)
        heads.append(head)
        inputs.append((features, state, noise))
    spent = np.zeros((2, ROUNDS, len(runs)))  # encode and sample, milliseconds
    for turn, (place, head) in itertools.product(range(ROUNDS), list(enumerate(heads))):
        features, state, noise = inputs[place]
        start = time.perf_counter()
        context = head.encode(features)
        between = time.perf_counter()
        head.sample(context, state, EMBODIMENT_ID, noise=noise)
        spent[:, turn, place] = 1e3 * (between - start), 1e3 * (time.perf_counter() - between)
    rows = []
    for place, (run, head) in enumerate(zip(runs, heads, strict=True)):
        context = head.encode(inputs[place][0])
        row = {**describe_run(run), "head_bytes": head.nbytes, "context_bytes": context.nbytes}
        row["num_vl_tokens"] = context.num_vl_tokens
        for part, of_part in zip(("encode", "sample"), spent, strict=True):
            ratio = bootstrap(of_part[:, place] / of_part[:, 0], range(ROUNDS), np.median, draws=500)
            row |= {f"{part}_ms": float(np.median(of_part[:, place])), f"{part}_ratio": ratio.value}
            row |= {f"{part}_ratio_low": ratio.low, f"{part}_ratio_high": ratio.high}
        rows.append(row)
    return rows


@dataclass(frozen=True)
class Sweep:
    """One of the studies.

    Attributes:
        STUDY: Its name.
        title: In the report.
        varied: What makes a point, of the runs' settings or the backbone's sizes.
        setting: The training setting whose values are given on the command line.
        values: Its default values.
        label: A point in a few words.
        other_pictures: Whether runs may have been trained on pictures of other sizes or cameras.
    """

    STUDY: str
    title: str
    varied: tuple[str, ...]
    setting: str
    values: str
    label: Callable[[Mapping[Any, Any]], str]
    other_pictures: bool = False

    @property
    def option(self) -> str:
        """Of the values."""
        return f"--{self.setting.replace('_', '-')}"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declares the arguments."""
        parser.epilog = EPILOG.format(study=self.STUDY, option=self.option, values=self.values)
        parser.add_argument(
            "--policies",
            type=Path,
            action="append",
            metavar="DIR",
            help="directory of finished runs of `saccade train`",
        )
        parser.add_argument(
            "--demos",
            type=Path,
            action="append",
            metavar="DIR",
            help="train on these demonstrations"
            + (
                "; may be given several times, for other image sizes and cameras"
                if self.other_pictures
                else ""
            ),
        )
        parser.add_argument(
            self.option,
            metavar="NUMBER,...",
            default=self.values,
            help=f"values to train (default: {self.values})",
        )
        if "alignment_weight" in self.varied:
            parser.add_argument(
                "--alignment-weights",
                metavar="WEIGHT,...",
                default="0",
                help="weights of the alignment loss to train, each with each N above 0 (default: 0)",
            )
        parser.add_argument(
            "--training-seeds", metavar="NUMBER,...", default="0,1", help="of each point (default: 0,1)"
        )
        parser.add_argument(
            "--steps", type=int, help="optimiser steps of each run (default: of `saccade train`)"
        )
        parser.add_argument(
            "--tasks",
            metavar="NAME,...",
            help="tasks, separated by commas (default: those that all policies know)",
        )
        parser.add_argument(
            "--episodes", type=int, default=25, help="episodes per task and policy (default: 25)"
        )
        parser.add_argument(
            "--seed", type=int, default=0, help="first seed of the episodes; the next count up (default: 0)"
        )

    def settings(self, args: argparse.Namespace) -> Settings:
        """The settings, checked."""
        seeds = check_evaluation_seeds(args.seed, args.episodes)
        policies: tuple[str, ...] = ()
        planned: list[Planned] = []
        if (args.policies is None) == (args.demos is None):
            raise InputError("policies: expected either --policies, to read runs, or --demos, to train them")
        graphics.check()
        if args.policies is not None:
            runs = find_runs(args.policies, self.varied)
            check_comparable(runs, self)
            known = [PolicyConfig.from_file(run.directory / CONFIG_FILE).tasks for run in runs]
            policies = tuple(map(str, args.policies))
        else:
            if len(args.demos) > 1 and not self.other_pictures:
                raise InputError("demos: given several, expected one: all runs see the same pictures")
            known = [tuple(demos.recorded_tasks(directory)) for directory in args.demos]
            planned = self.plan(args)
        tasks = known[0] if args.tasks is None else task_names(args.tasks)
        unknown = [task for task in tasks if not all(task in one for one in known)]
        if unknown:
            raise InputError(f"tasks: not all policies know {', '.join(unknown)}")
        return Settings(policies, tuple(planned), tasks, seeds)

    def plan(self, args: argparse.Namespace) -> list[Planned]:
        """The runs to be trained; what is wrong with one raises here, before anything is trained."""
        from saccade.sim.train import TrainingSettings

        values = numbers(self.option, getattr(args, self.setting), UNLIMITED) or ()
        seeds = numbers("--training-seeds", args.training_seeds, UNLIMITED) or ()
        weights = parse_weights(args.alignment_weights) if "alignment_weight" in self.varied else [0.0]
        steps = TrainingSettings.steps if args.steps is None else args.steps
        if steps < 1:
            raise InputError(f"steps: given {steps}, expected at least 1")
        planned = []
        for directory, value, weight, seed in itertools.product(args.demos, values, weights, seeds):
            if weight and not value:
                continue  # there is no row to align
            changes: dict[str, Any] = {
                self.setting: value,
                "alignment_weight": weight,
                "seed": seed,
                "steps": steps,
            }
            parts = [f"{self.setting.replace('_', '-')}-{value}", f"seed-{seed}"]
            if weight:
                parts.insert(1, f"alignment-{weight:g}")
            if len(args.demos) > 1:
                parts.insert(0, directory.resolve().name)
            planned.append(Planned("-".join(parts), str(directory), TrainingSettings(**changes)))
        return planned

    def run(self, settings: Settings, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
        """States what can be detected, trains or reads, runs the episodes, and at last measures the cost."""
        found = find_runs(map(Path, settings.policies), self.varied) if settings.policies else []
        directories = {run.name: run.directory for run in found}
        directories |= {plan.name: out / "policies" / plan.name for plan in settings.planned}
        work = Work(directories, {plan.name: plan for plan in settings.planned}, self.varied)

        # One directory holds policies that may be compared. Of these only aligned runs have the first.
        training: dict[str, Any] = {"alignment_block": None}
        for one in (*(run.settings for run in found), *map(planned_settings, settings.planned)):
            training |= held_equal(one, self)

        def work_through(cells: Sequence[Cell], expected: int, jobs: int) -> None:
            run_cells(
                self.STUDY,
                cells,
                work,
                out,
                settings={"varied": list(self.varied), "engine": "rust", "training": training},
                backend=backend,
                jobs=jobs,
                on_done=on_done,
                expected=expected,
            )

        episodes = len(settings.tasks) * len(settings.seeds)
        before = {"runs": self.least_runs(found, settings.planned), "episodes": episodes}
        say(statement(**before))
        cells = [Cell(("before",), before)]
        cells += [Cell(("training", run.name), {"step": run.step}) for run in found]
        cells += [Cell(("training", plan.name), planned_settings(plan)) for plan in settings.planned]
        work_through(cells, len(cells) + len(directories) * episodes + 1, jobs)
        runs = [work.read(name) for name in directories]
        check_comparable(runs, self)
        done = sorted((run for run in runs if run.finished), key=order)
        cells += episode_cells(done, settings)
        unfinished = len(runs) - len(done)
        work_through(cells, len(cells) + unfinished * episodes + 1, jobs)
        if not done:
            return
        points = {tuple(run.point.values()): run.name for run in reversed(done)}  # its first run, of each
        costs = {"policies": [points[point] for point in sorted(points)]}
        cells.append(Cell(("cost",), costs))
        # Alone: what else is at work would be measured too.
        work_through(cells, len(cells) + unfinished * episodes, 1)

    def least_runs(self, found: Sequence[Run], planned: Sequence[Planned]) -> int:
        """How many runs the smallest point has."""
        points: list[tuple[Any, ...]] = [tuple(run.point.values()) for run in found]
        points += [
            (plan.demonstrations, getattr(plan.training, self.setting), plan.training.alignment_weight)
            for plan in planned
        ]
        return min(map(points.count, points))

    def section(self, table: pd.DataFrame, provenance: Provenance) -> Section:
        """The study's part of the report."""
        return sweep_section(self, table)


def planned_settings(plan: Planned) -> dict[str, Any]:
    """What `settings.json` of a planned run will hold."""
    directory = Path(plan.demonstrations)
    return {**asdict(plan.training), "demonstrations": describe(directory, demos.recorded_tasks(directory))}


def order(run: Run) -> tuple[float, ...]:
    """By point, then by seed."""
    return (*run.point.values(), run.seed)


def episode_cells(runs: Sequence[Run], settings: Settings) -> list[Cell]:
    """Every policy in every episode, as it is; then with its future keys weighing like another N."""
    counts = {int(run.point.get("num_future_tokens", 0)) for run in runs} - {0}
    arms: list[tuple[str, int | None]] = [(PLAIN, None)]
    arms += [(f"mass of {count}", count) for count in sorted({*sorted(counts)[:1], *sorted(counts)[-1:]})]
    cells = []
    for (arm, mass), run in itertools.product(arms, runs):
        if mass is not None and run.point["num_future_tokens"] in (0, mass):
            continue
        described = {"checkpoint": run.checkpoint_sha256, "mass": mass}
        cells += [
            Cell(("episode", run.name, arm, task, seed), described)
            for task, seed in itertools.product(settings.tasks, settings.seeds)
        ]
    return cells


def parse_weights(text: str) -> list[float]:
    """Weights out of a list with commas.

    Raises:
        InputError: one is no number of at least 0.
    """
    try:
        found = [float(word) for word in names("--alignment-weights", text)]
    except ValueError:
        found = [-1.0]
    if not all(0 <= weight < math.inf for weight in found):
        raise InputError(f"alignment-weights: given {text!r}, expected numbers of at least 0, with commas")
    return found


def say(rows: Rows) -> None:
    """The statement, for people, before the first run."""
    print("What these runs can detect, with 80 % power at the 5 % level:", file=sys.stderr)
    for line in statement_lines(rows):
        print(f"- {line}", file=sys.stderr)


def label_n(point: Mapping[Any, Any]) -> str:
    """A point of `N`."""
    weight = float(point["alignment_weight"])
    return f"N = {int(point['num_future_tokens'])}" + (f", aligned ({weight:g})" if weight else "")


def label_tvl(point: Mapping[Any, Any]) -> str:
    """A point of `TVL`."""
    size, cameras, patch = (int(point[name]) for name in ("image_size", "num_cameras", "patch_size"))
    return f"{cameras} cameras, {size} px, patches of {patch} px"


def label_vlsa(point: Mapping[Any, Any]) -> str:
    """A point of `VLSA`."""
    return f"{int(point['vl_num_layers'])} layers"


N = Sweep(
    "n",
    "Number of future tokens",
    ("num_future_tokens", "alignment_weight"),
    setting="num_future_tokens",
    values="0,8,32",
    label=label_n,
)
TVL = Sweep(
    "tvl",
    "Number of vision-language tokens",
    ("image_size", "num_cameras", "patch_size"),
    setting="patch_size",
    values="8,16,32",
    label=label_tvl,
    other_pictures=True,
)
VLSA = Sweep(
    "vlsa",
    "Depth of the VL self-attention",
    ("vl_num_layers",),
    setting="vl_num_layers",
    values="0,1,4",
    label=label_vlsa,
)
