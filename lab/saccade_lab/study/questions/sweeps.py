"""``saccade study n | tvl | vlsa``: trained policies that differ in one respect.

Each sweep trains policies, or reads trained ones, in which the number of future tokens (with or without the
alignment loss), the number of vision-language tokens, or the depth of the VL self-attention varies and
everything else is fixed. All policies run the same episodes. What they cost is measured last, alternately.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import pandas as pd

from saccade._internal.flags import add_integer, add_list, add_seed
from saccade.errors import InputError
from saccade.head.intervention import Intervention
from saccade_lab.files import path_text
from saccade_lab.flags import add_episodes, add_tasks, check_tasks
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.questions.sweeps_cost import cost
from saccade_lab.study.questions.sweeps_results import PLAIN, Varied
from saccade_lab.study.questions.sweeps_section import detectable_lines, section
from saccade_lab.study.runs import Planned, Run, describe_run, find_runs, read_run
from saccade_lab.study.section import Section
from saccade_lab.study.statistics import detectable_between_runs, detectable_difference
from saccade_lab.study.study import Study
from saccade_lab.study.table import Provenance

if TYPE_CHECKING:
    pass

EPILOG = """\
Reads finished runs of `saccade train` (--policies), which must differ in nothing else, or trains them
(--demos) in OUT/policies. It first says what this number of runs and episodes can detect. Success is measured
on the same episodes for all policies; latency is measured at the end, in one process, alternately.

examples:
  saccade study {study} --policies out/policies --out out/study
  saccade study {study} --demos out/demos {flag} {values} --training-seeds 0,1 --jobs 2 --out out/study
"""

TRAINING, EPISODES, COST = range(3)  # the stages
# Assumptions of what can be detected; with few runs neither can be known beforehand.
SUPPOSED_RATE, SUPPOSED_DEVIATIONS, SUPPOSED_DISCORDANT = 0.7, (0.04, 0.08), (0.1, 0.25)


@dataclass(frozen=True)
class Sweep(Study):
    """Trained policies that differ in one respect, compared on the same episodes and in their cost.

    Its stages: training, episodes of the finished policies, cost.

    Attributes:
        runs: Directory of each run, by name.
        planned: The runs that are trained, by name.
        tasks, seeds: The episodes of every policy: each seed in each task.
        stage: ``TRAINING``, ``EPISODES`` or ``COST``.
        varied: The settings that define a point of the sweep.
        setting: The training setting whose values are given on the command line.
        values: Its default values.
        other_pictures: Whether runs may be trained on pictures of different sizes or cameras.
    """

    runs: Mapping[str, Path]
    planned: Mapping[str, Planned]
    tasks: tuple[str, ...]
    seeds: range
    stage: int = TRAINING
    varied: ClassVar[Varied]
    setting: ClassVar[str]
    values: ClassVar[tuple[int, ...]]
    other_pictures: ClassVar[bool] = False

    @classmethod
    def flag(cls) -> str:
        """The flag of the values."""
        return f"--{cls.setting.replace('_', '-')}"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        values = ",".join(map(str, cls.values))
        parser.epilog = EPILOG.format(study=cls.name, flag=cls.flag(), values=values)
        for flag, text in (
            ("--policies", "directories of finished runs of `saccade train`"),
            (
                "--demos",
                "train on these demonstrations"
                + ("; several for other image sizes and cameras" if cls.other_pictures else ""),
            ),
        ):
            parser.add_argument(flag, type=Path, nargs="+", action="extend", metavar="DIR", help=text)
        add_list(
            parser,
            cls.flag(),
            item=int,
            metavar="N",
            minimum=0,
            default=cls.values,
            help=f"values to train (default: {values})",
        )
        if "alignment_weight" in cls.varied.names:
            add_list(
                parser,
                "--alignment-weights",
                item=weight,
                metavar="X",
                minimum=0,
                default=(0.0,),
                help="weights of the alignment loss, each trained with each N above 0 (default: 0)",
            )
        add_list(
            parser,
            "--training-seeds",
            item=int,
            metavar="N",
            minimum=0,
            default=(0, 1),
            help="seeds of the runs of each point (default: 0,1)",
        )
        add_integer(
            parser, "--training-steps", help="optimiser steps of each run (default: of `saccade train`)"
        )
        add_tasks(parser, "tasks to run (default: all that every policy knows)")
        add_episodes(parser, 25, "episodes per task and policy")
        add_seed(parser, "seed of the first episode, the next ones count up")

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Sweep:
        """See ``Study``."""
        from saccade_lab.sim import demos, graphics
        from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig
        from saccade_lab.sim.tasks import check_evaluation_seeds

        seeds = check_evaluation_seeds(args.seed, args.episodes)
        if (args.policies is None) == (args.demos is None):
            raise InputError("policies: expected either --policies, to read runs, or --demos, to train them")
        check_tasks(args.tasks or ())
        graphics.check()
        runs: list[Run] = []
        planned: list[Planned] = []
        if args.policies is not None:
            runs = find_runs(args.policies, cls.varied.names)
            cls.check_comparable(runs)
            known = [SimulationConfig.from_file(run.directory / CONFIG_FILE).tasks for run in runs]
        else:
            if len(args.demos) > 1 and not cls.other_pictures:
                raise InputError("demos: given several, expected one: all runs see the same pictures")
            known = [tuple(demos.recorded_tasks(directory)) for directory in args.demos]
            planned = cls.plan(args)
        tasks = args.tasks or known[0]
        unknown = [task for task in tasks if not all(task in one for one in known)]
        if unknown:
            raise InputError(f"tasks: not all policies know {', '.join(unknown)}")
        by_name = {run.name: run.directory for run in runs}
        return cls(by_name, {plan.name: plan for plan in planned}, tuple(tasks), seeds)

    @classmethod
    def plan(cls, args: argparse.Namespace) -> list[Planned]:
        """The runs to be trained, checked before anything is trained."""
        from saccade_lab.training.settings import TrainingSettings

        steps = TrainingSettings.steps if args.training_steps is None else args.training_steps
        weights = getattr(args, "alignment_weights", (0.0,))
        points = itertools.product(args.demos, getattr(args, cls.setting), weights, args.training_seeds)
        planned = []
        for directory, value, alignment, seed in points:
            if alignment and not value:
                continue  # there is no row to align
            changes: dict[str, Any] = {
                cls.setting: value,
                "alignment_weight": alignment,
                "seed": seed,
                "steps": steps,
            }
            parts = [f"{cls.setting.replace('_', '-')}-{value}", f"seed-{seed}"]
            if alignment:
                parts.insert(1, f"alignment-{alignment:g}")
            if len(args.demos) > 1:
                parts.insert(0, directory.resolve().name)
            planned.append(Planned("-".join(parts), path_text(directory), TrainingSettings(**changes)))
        return planned

    @classmethod
    def held_equal(cls, training: Mapping[str, Any]) -> dict[str, Any]:
        """The part of a run's settings that must be equal in all runs."""
        held = {name: value for name, value in training.items() if name not in ("seed", *cls.varied.names)}
        if cls.other_pictures:
            held["demonstrations"] = training["demonstrations"]["tasks"]
        if not training.get("alignment_weight"):
            held.pop("alignment_block", None)  # it has no effect then
        return held

    @classmethod
    def check_comparable(cls, runs: Sequence[Run]) -> None:
        """Checks that runs differ only in what the sweep varies and in the training seed.

        Raises:
            InputError: Runs differ in something else, which is listed; or two of them are the same point
                with the same seed, or have the same name.
        """
        held = {run.name: cls.held_equal(run.settings) for run in runs}
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
            raise InputError(
                f"policies: expected runs that differ in {', '.join(cls.varied.names)} and seed only. "
                f"{'. '.join(problems or twice)}"
            )

    def begin(self, out: Path) -> Sweep:
        """See ``Study``; says what can be detected."""
        directories = {name: out / "policies" / name for name in self.planned}
        found = replace(self, runs={**self.runs, **directories})
        print("Detectable with 80 % power at the 5 % level:", file=sys.stderr)
        for line in detectable_lines(detectable(**found.before)):
            print(f"- {line}", file=sys.stderr)
        return found

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        # A directory contains policies that may be compared. Only aligned runs have an alignment block.
        training: dict[str, Any] = {"alignment_block": None}
        for name in self.runs:
            planned = self.planned.get(name)
            training |= self.held_equal(planned.settings() if planned else self.read(name).settings)
        return {"varied": list(self.varied.names), "engine": "rust", "training": training}

    @property
    def before(self) -> dict[str, int]:
        """The number of runs of the smallest point, and of episodes of a run."""
        points: list[tuple[Any, ...]] = []
        for name in self.runs:
            planned = self.planned.get(name)
            if planned is None:
                points.append(tuple(self.read(name).point.values()))
            else:
                settings = planned.training
                varied = getattr(settings, self.setting), settings.alignment_weight
                points.append((planned.demonstrations, *varied))
        episodes = len(self.tasks) * len(self.seeds)
        return {"runs": min(map(points.count, points)), "episodes": episodes}

    def cells(self) -> Sequence[Cell]:
        """See ``Study``."""
        cells = [Cell(("before",), self.before)]
        for name in self.runs:
            planned = self.planned.get(name)
            settings = planned.settings() if planned else {"step": self.read(name).step}
            cells.append(Cell(("training", name), settings))
        if self.stage >= EPISODES:
            cells += self.episode_cells()
        if self.stage == COST:
            first = {tuple(run.point.values()): run.name for run in reversed(self.finished())}
            cells.append(Cell(("cost",), {"policies": [first[point] for point in sorted(first)]}))
        return cells

    def episode_cells(self) -> list[Cell]:
        """Every policy in every episode: unchanged, then with its future keys weighted like another N."""
        runs = self.finished()
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
                for task, seed in itertools.product(self.tasks, self.seeds)
            ]
        return cells

    @property
    def num_cells(self) -> int:
        """See ``Study``; without the control of equal mass until the policies are trained."""
        missing = len(self.runs) if self.stage == TRAINING else len(self.runs) - len(self.finished())
        return len(self.cells()) + missing * len(self.tasks) * len(self.seeds) + (self.stage < COST)

    def then(self, table: pd.DataFrame) -> Sweep | None:
        """See ``Study``: after the training the episodes, then, alone, the cost."""
        if self.stage == TRAINING:
            self.check_comparable([self.read(name) for name in self.runs])
        if self.stage == COST or (self.stage == EPISODES and not self.finished()):
            return None
        return replace(self, stage=self.stage + 1)

    def measure(self, cell: Cell) -> Rows:
        """See ``Study``; the first word of the key says what is measured."""
        kind = str(cell.key[0])
        if kind == "before":
            rows = detectable(int(cell.settings["runs"]), int(cell.settings["episodes"]))
        elif kind == "training":
            rows = [self.training(str(cell.key[1]))]
        elif kind == "episode":
            rows = [self.episode(cell)]
        else:
            rows = cost([self.read(name) for name in cell.settings["policies"]])
        return [{"kind": kind, **row} for row in rows]

    @property
    def files(self) -> tuple[str | Path, ...]:
        """See ``Study``: finished runs, and demonstrations.

        Runs that are trained stay in the output directory, which other machines must share.
        """
        finished = (path for name, path in self.runs.items() if name not in self.planned)
        return (*finished, *{plan.demonstrations for plan in self.planned.values()})

    def read(self, name: str) -> Run:
        """A run by name."""
        return read_run(self.runs[name], self.varied.names)

    def finished(self) -> list[Run]:
        """The runs whose training is complete, by point and seed."""
        runs = [self.read(name) for name in self.runs]
        return sorted((run for run in runs if run.finished), key=lambda run: (*run.point.values(), run.seed))

    def training(self, name: str) -> dict[str, Any]:
        """Trains the run if it is planned, then describes how its training ended."""
        if name in self.planned:
            self.planned[name].train(self.runs[name])
        run = self.read(name)
        note = None if run.finished else f"in training, step {run.step} of {run.settings['steps']}"
        loss = run.history[-1]["validation_loss"] if run.finished else None
        return {**describe_run(run), "validation_loss": loss, "steps": run.step, "note": note}

    def episode(self, cell: Cell) -> dict[str, Any]:
        """One episode of one policy; an arm other than ``PLAIN`` weights the future keys like another N."""
        from saccade_lab.study.simulator import judge

        _, name, arm, task, seed = cell.key
        run, mass = self.read(str(name)), cell.settings["mass"]
        change = None if mass is None else equal_mass(int(run.point["num_future_tokens"]), int(mass))
        episode = judge(str(run.directory), str(task), int(seed), change)
        result = {"arm": arm, "task": task, "seed": seed, "success": episode.success, "steps": episode.steps}
        return {**describe_run(run), **result}

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        return section(cls.name, cls.varied, table)


def weight(word: str) -> float:
    """A weight on the command line; raises ``ValueError`` if it is not a finite number."""
    value = float(word)
    if not math.isfinite(value):
        raise ValueError(word)
    return value


def equal_mass(num_tokens: int, like: int) -> Intervention:
    """Gives ``num_tokens`` future keys the total weight in the softmax that ``like`` keys would have.

    Example:
        >>> round(float(equal_mass(8, 32).key_bias["future", None]), 4)  # log(32 / 8)
        1.3863
    """
    return Intervention(key_bias={"future": math.log(like / num_tokens)})


def detectable(runs: int, episodes: int) -> Rows:
    """What ``runs`` runs per point and ``episodes`` per run can detect, under several assumptions."""
    rows: Rows = [
        {
            "comparison": "two trained policies on the same episodes",
            "supposed": f"{100 * share:.0f} % of the episodes have different outcomes",
            "detectable": detectable_difference(episodes, share),
        }
        for share in SUPPOSED_DISCORDANT
    ]
    rows += [
        {
            "comparison": f"two points of {runs} training runs each",
            "supposed": f"the rate is {100 * SUPPOSED_RATE:.0f} % with a standard deviation of "
            f"{100 * deviation:.0f} points between training seeds",
            "detectable": detectable_between_runs(SUPPOSED_RATE, episodes, runs, deviation),
        }
        for deviation in SUPPOSED_DEVIATIONS
    ]
    return rows


def tokens_label(point: Mapping[Any, Any]) -> str:
    """A point of ``FutureTokens``."""
    alignment = float(point["alignment_weight"])
    return f"N = {int(point['num_future_tokens'])}" + (f", aligned ({alignment:g})" if alignment else "")


def pictures_label(point: Mapping[Any, Any]) -> str:
    """A point of ``VlTokens``."""
    size, cameras, patch = (int(point[name]) for name in ("image_size", "num_cameras", "patch_size"))
    return f"{cameras} cameras, {size} px, patches of {patch} px"


def layers_label(point: Mapping[Any, Any]) -> str:
    """A point of ``VlSelfAttention``."""
    return f"{int(point['vl_num_layers'])} layers"


class FutureTokens(Sweep):
    """Policies with different numbers of future tokens, and with the alignment loss."""

    name: ClassVar[str] = "n"
    varied: ClassVar[Varied] = Varied(("num_future_tokens", "alignment_weight"), tokens_label)
    setting: ClassVar[str] = "num_future_tokens"
    values: ClassVar[tuple[int, ...]] = (0, 8, 32)


class VlTokens(Sweep):
    """Policies with different numbers of vision-language tokens."""

    name: ClassVar[str] = "tvl"
    varied: ClassVar[Varied] = Varied(("image_size", "num_cameras", "patch_size"), pictures_label)
    setting: ClassVar[str] = "patch_size"
    values: ClassVar[tuple[int, ...]] = (8, 16, 32)
    other_pictures: ClassVar[bool] = True


class VlSelfAttention(Sweep):
    """Policies with different depths of the VL self-attention."""

    name: ClassVar[str] = "vlsa"
    varied: ClassVar[Varied] = Varied(("vl_num_layers",), layers_label)
    setting: ClassVar[str] = "vl_num_layers"
    values: ClassVar[tuple[int, ...]] = (0, 1, 4)
