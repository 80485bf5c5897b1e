"""`saccade study n | tvl | vlsa`: policies that differ in one respect, side by side.

Each sweep trains policies, or reads trained ones, in which the number of future tokens (and how they were
trained), the number of vision-language tokens, or the depth of the VL self-attention varies and all else is
fixed. All of them run the same episodes; what they cost is measured at the end, alone and interleaved.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.intervention import Intervention
from saccade.sim import demos, graphics
from saccade.sim.dataset import describe
from saccade.sim.policy import EMBODIMENT_ID
from saccade.sim.rollout import run_episode
from saccade.sim.settings import CONFIG_FILE, TENSOR_FILE, PolicyConfig
from saccade.sim.tasks import check_evaluation_seeds
from saccade.study import figures
from saccade.study.arguments import names, numbers
from saccade.study.cells import Cell, OnDone, Rows, run_cells
from saccade.study.cuts import scaled
from saccade.study.loaded import environment_of, policy_of
from saccade.study.observations import task_names
from saccade.study.report import Figure, Grid, Section, effect, number, rate
from saccade.study.statistics import (
    CONFIDENCE,
    Estimate,
    bootstrap,
    detectable_between_runs,
    detectable_difference,
    tango,
    wilson,
)
from saccade.study.tables import Provenance

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
UNLIMITED = 1 << 31

SETTINGS_FILE = "settings.json"
PLAIN = "plain"
# What the statement before the runs supposes; with few runs neither can be known beforehand.
SUPPOSED_RATE, SUPPOSED_DEVIATIONS, SUPPOSED_DISCORDANT = 0.7, (0.04, 0.08), (0.1, 0.25)
FEWEST_EPISODES = 10  # for an interval from drawing them
ROUNDS = 200  # of the timing; each round times every policy once


@dataclass(frozen=True)
class Run:
    """A trained policy, or one in training.

    Attributes:
        name: Of its directory.
        directory: Where it is.
        settings: Of `settings.json`.
        history: Of `history.json`.
        point: What the sweep varies: names and values.
    """

    name: str
    directory: Path
    settings: Mapping[str, Any]
    history: Sequence[Mapping[str, float]]
    point: Mapping[str, float]

    @property
    def seed(self) -> int:
        """Of the training."""
        return int(self.settings["seed"])

    @property
    def step(self) -> int:
        """How far the training came."""
        return int(self.history[-1]["step"]) if self.history else 0

    @property
    def checkpoint_sha256(self) -> str:
        """Of config and tensors, as `Policy.checkpoint_sha256` has it."""
        digest = hashlib.sha256()
        for name in (CONFIG_FILE, TENSOR_FILE):
            digest.update((self.directory / name).read_bytes())
        return digest.hexdigest()

    @property
    def finished(self) -> bool:
        """Whether it came to its end."""
        return self.step == int(self.settings["steps"])


def read_run(directory: Path, varied: Sequence[str]) -> Run:
    """A run of `saccade train`.

    Raises:
        FileNotFoundError: there is none.
        InputError: its files are not what `saccade train` writes.
    """
    if not (directory / SETTINGS_FILE).is_file():
        raise FileNotFoundError(
            f"{directory / SETTINGS_FILE}: no such file; expected a run of `saccade train`"
        )
    try:
        settings = json.loads((directory / SETTINGS_FILE).read_text(encoding="utf-8"))
        history_file = directory / "history.json"
        history = json.loads(history_file.read_text(encoding="utf-8")) if history_file.exists() else []
        backbone = PolicyConfig.from_file(directory / CONFIG_FILE).backbone
        known = {**settings, **vars(backbone), "num_vl_tokens": backbone.num_tokens}
        return Run(directory.name, directory, settings, history, {name: known[name] for name in varied})
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{directory}: not written by `saccade train`: {error}") from None


def find_runs(directories: Iterable[Path], varied: Sequence[str]) -> list[Run]:
    """All runs in directories of runs, by what varies and then by seed.

    A run that has not written its policy yet is passed over.

    Raises:
        FileNotFoundError: a directory is not there, or there is no run in any of them.
    """
    found = []
    for directory in directories:
        if not directory.is_dir():
            raise FileNotFoundError(f"{directory}: no such directory of policies")
        written = sorted(path.parent for path in directory.glob(f"*/{SETTINGS_FILE}"))
        found += [read_run(path, varied) for path in written if (path / TENSOR_FILE).is_file()]
    if not found:
        raise FileNotFoundError(f"{', '.join(map(str, directories))}: no runs of `saccade train` there")
    return sorted(found, key=lambda run: (*run.point.values(), run.seed))


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


def describe_run(run: Run) -> dict[str, Any]:
    """The columns that name a policy."""
    return {
        "policy": run.name,
        **run.point,
        "training_seed": run.seed,
        "checkpoint_sha256": run.checkpoint_sha256,
    }


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


def statement_lines(rows: Iterable[Mapping[Any, Any]]) -> list[str]:
    """A sentence for each supposition."""
    lines = []
    for row in rows:
        least = row.get("detectable", math.nan)
        found = f"a difference of {100 * least:.0f} points" if np.isfinite(least) else "no difference at all"
        lines.append(f"{row['comparison']}: {found}, if {row['supposed']}")
    return lines


def between_runs(first: Sequence[float], second: Sequence[float], episodes: int) -> Estimate:
    """Second less first mean rate of trained policies, with an interval for training them anew.

    Student's t interval over the runs, both sides with the same variance between runs. It is at least what
    the episodes drawn make it, so that runs that happen to agree do not give a narrow interval.

    Args:
        first, second: success rates of the runs.
        episodes: that each rate is of.

    Returns:
        With NaN bounds where a side has one run only, or where the variance is zero.
    """
    value = float(np.mean(second) - np.mean(first))
    if min(len(first), len(second)) < 2:
        return Estimate(value, math.nan, math.nan)
    freedom = len(first) + len(second) - 2
    variance = 0.0
    for rates in (first, second):
        mean = float(np.mean(rates))
        by_episodes = mean * (1 - mean) / episodes
        variance += (len(rates) - 1) / freedom * max(float(np.var(rates, ddof=1)), by_episodes)
    if variance == 0:  # all runs succeeded always, or never
        return Estimate(value, math.nan, math.nan)
    error = math.sqrt(variance * (1 / len(first) + 1 / len(second)))
    half = float(stats.t.ppf((1 + CONFIDENCE) / 2, freedom)) * error
    return Estimate(value, max(value - half, -1.0), min(value + half, 1.0))


def same_policies(first: pd.DataFrame, second: pd.DataFrame) -> Estimate:
    """Second less first success of the policies that there are, on the same episodes.

    The mean over a point's runs, episode by episode; see `mean_difference`.
    """
    one, other = (rows.groupby(["task", "seed"])["success"].mean() for rows in (first, second))
    difference = (other - one).dropna()
    return mean_difference(difference.to_numpy(), list(difference.index))


def mean_difference(differences: npt.NDArray[np.float64], episodes: Sequence[Any]) -> Estimate:
    """The mean of differences of success, with an interval from drawing episodes.

    Where few episodes differ, drawing them gives an interval that is too narrow, and none at all where all
    agree. So it also holds Tango's interval for as many pairs with these gains and losses, and there is none
    (NaN) with fewer than `FEWEST_EPISODES`.
    """
    count = len(set(episodes))
    if count < FEWEST_EPISODES:
        return Estimate(float(np.mean(differences)) if count else math.nan, math.nan, math.nan)
    drawn = bootstrap(differences, episodes)
    # An episode counts once, however many policies ran it; so gains and losses may be parts of one.
    by_episode = pd.Series(differences).groupby([str(episode) for episode in episodes]).mean()
    scored = tango(by_episode.clip(lower=0).sum(), -by_episode.clip(upper=0).sum(), count)
    return Estimate(drawn.value, min(drawn.low, scored.low), max(drawn.high, scored.high))


def sweep_section(sweep: Sweep, table: pd.DataFrame) -> Section:
    """A sweep's part of the report."""
    kinds = {kind: rows.dropna(axis=1, how="all") for kind, rows in table.groupby("kind")}
    before = statement_lines(kinds["before"].to_dict("records"))
    summary = [
        "Policies that differ in what is compared and in their training seed only; all of them run the same "
        "episodes. Said before the runs: " + "; ".join(before) + ".",
        "Two intervals stand side by side. 'These policies' is about the policies that were trained, from "
        "the episodes; 'trained anew' is about the point, from its runs (Student's t, with no less variance "
        "than the episodes make). With two runs a point the latter is wide, and it should be: one lucky run "
        "is not a finding.",
    ]
    trained = kinds.get("training", pd.DataFrame())
    unfinished = []
    if "note" in trained:
        in_training = trained[trained["note"].notna()]
        unfinished = [
            f"{name}: not measured, {note}."
            for name, note in zip(in_training["policy"], in_training["note"], strict=True)
        ]
    episodes = kinds.get("episode", pd.DataFrame())
    if episodes.empty:
        return Section(sweep.title, summary, concluded=unfinished or ["Not measured: no episode is done."])
    episodes = episodes.assign(
        success=episodes["success"].astype(bool).astype(float),
        point=[sweep.label(row) for row in episodes.to_dict("records")],
    )
    whole, partial = whole_runs(episodes[episodes["arm"] == PLAIN])
    if not whole:
        return Section(sweep.title, summary, concluded=partial + unfinished)
    episodes = episodes[episodes["policy"].isin(whole)]
    plain = episodes[episodes["arm"] == PLAIN]
    points = point_order(plain, sweep)
    pictures = [
        Figure(
            "success",
            "Success of every policy, with Wilson's 95 % interval.",
            policy_picture(plain, points),
        )
    ]
    grids = [policy_grid(plain, trained, points), difference_grid(plain, sweep)]
    if (episodes["arm"] != PLAIN).any():
        grids.append(mass_grid(episodes, points))
    if "cost" in kinds:
        grids.append(cost_grid(kinds["cost"], sweep))
    lines = conclusions(plain, sweep) + mass_conclusions(episodes, points) + partial + unfinished
    return Section(sweep.title, summary, pictures, grids, lines, NOT_SHOWN)


NOT_SHOWN = (
    "Intervals hold for each comparison by itself: of twenty comparisons of equal policies one is expected "
    "to exclude zero.",
    "Policies this small, trained this shortly on these tasks, are not the released model: a number of "
    "tokens that does not matter here may matter there.",
    "The validation loss is of single velocities on the demonstrations' observations. It need not rank "
    "policies as closed loop does.",
    "The control of equal mass changes trained policies after the fact. A policy trained with another mass "
    "might use it.",
)


def point_order(plain: pd.DataFrame, sweep: Sweep) -> list[str]:
    """The points' labels in the order of their values."""
    return list(dict.fromkeys(plain.sort_values(list(sweep.varied))["point"]))


def policies_of(rows: pd.DataFrame) -> list[str]:
    """By training seed."""
    return list(dict.fromkeys(rows.sort_values("training_seed")["policy"]))


def wilson_of(rows: pd.DataFrame) -> Estimate:
    """The success rate of one policy's episodes."""
    return wilson(int(rows["success"].sum()), len(rows))


def run_rates(rows: pd.DataFrame) -> list[float]:
    """The success rate of each of a point's runs."""
    return [float(rows.loc[rows["policy"] == name, "success"].mean()) for name in policies_of(rows)]


def policy_picture(plain: pd.DataFrame, points: Sequence[str]) -> Any:
    """Success of every policy."""
    labels, values = [], []
    for point in points:
        of_point = plain[plain["point"] == point]
        for name in policies_of(of_point):
            rows = of_point[of_point["policy"] == name]
            labels.append(f"{point}, seed {int(rows['training_seed'].iloc[0])}")
            values.append(wilson_of(rows))
    return figures.estimates(labels, values, "success rate")


def policy_grid(plain: pd.DataFrame, trained: pd.DataFrame, points: Sequence[str]) -> Grid:
    """Every policy: validation loss, success over all and by task."""
    tasks = list(dict.fromkeys(plain["task"]))
    losses = dict(zip(trained["policy"], trained["validation_loss"], strict=True))
    lines = []
    for point in points:
        of_point = plain[plain["point"] == point]
        for name in policies_of(of_point):
            rows = of_point[of_point["policy"] == name]
            by_task = [rows.loc[rows["task"] == task, "success"] for task in tasks]
            counts = [f"{int(found.sum())}/{len(found)}" for found in by_task]
            seed = str(int(rows["training_seed"].iloc[0]))
            lines.append([point, seed, f"{losses[name]:.3f}", rate(wilson_of(rows)), *counts])
    columns = ("policy", "training seed", "validation loss", "success, %", *tasks)
    return Grid("Every policy: success with Wilson's 95 % interval, then by task.", columns, lines)


def compared(plain: pd.DataFrame, sweep: Sweep) -> list[tuple[str, str]]:
    """Pairs of points that differ in one respect."""
    values = plain.drop_duplicates("point").sort_values(list(sweep.varied))
    points = [(str(row["point"]), [row[name] for name in sweep.varied]) for row in values.to_dict("records")]
    return [
        (first, second)
        for (first, one), (second, other) in itertools.combinations(points, 2)
        if sum(a != b for a, b in zip(one, other, strict=True)) == 1
    ]


def differences(plain: pd.DataFrame, sweep: Sweep) -> list[tuple[str, str, Estimate, Estimate]]:
    """Pairs of points, and how the second differs: these policies, and trained anew."""
    found = []
    for first, second in compared(plain, sweep):
        one, other = plain[plain["point"] == first], plain[plain["point"] == second]
        episodes = len(one) // len(policies_of(one))
        anew = between_runs(run_rates(one), run_rates(other), episodes)
        found.append((first, second, same_policies(one, other), anew))
    return found


def difference_grid(plain: pd.DataFrame, sweep: Sweep) -> Grid:
    """Differences between points, in percentage points of success."""
    lines = [
        [second, first, number(scaled(these), digits=0), number(scaled(anew), digits=0)]
        for first, second, these, anew in differences(plain, sweep)
    ]
    return Grid(
        "Difference of success, percentage points, with 95 % intervals.",
        ("policies", "less", "these policies", "trained anew"),
        lines,
    )


def mass_differences(episodes: pd.DataFrame, points: Sequence[str]) -> list[tuple[str, str, Estimate]]:
    """For each point and control of equal mass, how success differs from the same policies as they are."""
    keys = ["policy", "task", "seed"]
    found = []
    for point in points:
        of_point = episodes[episodes["point"] == point]
        plain = of_point[of_point["arm"] == PLAIN].set_index(keys)["success"]
        for arm in sorted(set(of_point["arm"]) - {PLAIN}):
            weighed = of_point[of_point["arm"] == arm].set_index(keys)["success"]
            change = (weighed - plain).dropna()
            drawn = [(task, seed) for _, task, seed in change.index]
            found.append((point, str(arm), mean_difference(change.to_numpy(), drawn)))
    return found


def mass_grid(episodes: pd.DataFrame, points: Sequence[str]) -> Grid:
    """The controls of equal mass."""
    lines = [
        [point, arm, number(scaled(one), digits=0)] for point, arm, one in mass_differences(episodes, points)
    ]
    return Grid(
        "Control: the future keys together weigh in the softmax as so many tokens would. Difference of "
        "success to the same policies as they are, percentage points, with 95 % intervals over episodes.",
        ("policies", "future keys with the", "difference"),
        lines,
    )


def cost_grid(cost: pd.DataFrame, sweep: Sweep) -> Grid:
    """Latency and memory."""
    lines = []
    for row in cost.sort_values(list(sweep.varied)).to_dict("records"):
        ratios = [
            number(
                Estimate(row[f"{part}_ratio"], row[f"{part}_ratio_low"], row[f"{part}_ratio_high"]), digits=2
            )
            for part in ("encode", "sample")
        ]
        lines.append(
            [
                sweep.label(row),
                f"{row['encode_ms']:.2f}",
                ratios[0],
                f"{row['sample_ms']:.2f}",
                ratios[1],
                f"{row['head_bytes'] / 1e6:.2f}",
                f"{row['context_bytes'] / 1e3:.1f}",
            ]
        )
    return Grid(
        f"What the head costs on one thread, median of {ROUNDS} interleaved rounds; ratios to the first, "
        "with 95 % intervals.",
        ("policies", "encode, ms", "ratio", "sample, ms", "ratio", "weights, MB", "context, kB"),
        lines,
    )


def conclusions(plain: pd.DataFrame, sweep: Sweep) -> list[str]:
    """What the intervals allow to be said of every pair of points that differ in one respect."""
    found = differences(plain, sweep)
    if not found:
        points = ", ".join(point_order(plain, sweep))
        return [f"Only {points} was measured: nothing to compare."]
    lines = []
    for first, second, these, anew in found:
        runs = [len(policies_of(plain[plain["point"] == point])) for point in (first, second)]
        trained = (
            f"trained anew: no interval, with {runs[0]} and {runs[1]} runs"
            if math.isnan(anew.low)
            else f"trained anew ({runs[0]} and {runs[1]} runs): {effect('success', anew)}"
        )
        lines.append(f"{second} against {first}. These policies: {effect('success', these)}; {trained}.")
    return lines


def whole_runs(plain: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Policies that ran every episode that any of them ran, and a line for each of those that did not."""
    ran = {
        str(name): set(zip(rows["task"], rows["seed"], strict=True))
        for name, rows in plain.groupby("policy", sort=False)
    }
    every = set().union(*ran.values())
    whole = [name for name, episodes in ran.items() if episodes == every]
    partial = [
        f"{name}: left out, {len(episodes)} of {len(every)} episodes are done."
        for name, episodes in ran.items()
        if episodes != every
    ]
    return whole, partial


def mass_conclusions(episodes: pd.DataFrame, points: Sequence[str]) -> list[str]:
    """What the control of equal mass says."""
    return [
        f"{point}, future keys with the {arm}: {effect('success', one)}."
        for point, arm, one in mass_differences(episodes, points)
    ]


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
