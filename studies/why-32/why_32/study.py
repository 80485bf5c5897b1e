"""Trains the policies of the plan and judges them, stage after stage."""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd

from saccade._internal.files import sha256_of
from saccade.errors import InputError
from saccade_lab.files import changed, checkpoint_identity
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.runs import Planned, read_run, saved_step
from saccade_lab.study.study import Study
from saccade_lab.study.table import Provenance, read_table, table_path
from saccade_lab.training.settings import STATE_FILE, features_name
from why_32 import choice
from why_32 import plan as plans
from why_32.arms import ARMS, find_arm, judge
from why_32.costs import cost
from why_32.measured import FIRST_EPISODES, MEASURED
from why_32.plan import CORE_STAGE, PILOT, Backbone, Plan, PlannedPolicy, Recording
from why_32.report import Answered
from why_32.section import section
from why_32.times import TIMES, UNTRAINED, latencies

EPILOG = """\
Records demonstrations, trains backbones, then the policies of the plan as heads on the frozen backbones, and
judges the policies on the same episodes, stage after stage. DIR/answer/backbones and DIR/answer/policies have
what was trained; what is there and finished is not trained again, on any machine. DIR/answer/demos has the
demonstrations, which only training needs; missing ones are recorded again. The stage pilot is run only if it
is named, and is no result.

examples:
  python -m why_32 run --stages pilot --out out/why-32
  python -m why_32 run --stages core --jobs 2 --out out/why-32
  python -m why_32 run --stages steps --recipes n-0,n-32 --arms steps-of-2 --out out/why-32
  python -m why_32 run --out out/why-32
"""
RECORDING, BACKBONE, TRAINING, EPISODES = "recording", "backbone", "training", "episodes"
SEEDS_TOGETHER = 2  # training seeds of a stage that are trained before they are judged, but for the core
ALREADY = ("seed", "demonstrations")  # settings of a run that the table has under other names
#: What `saccade train` writes only to continue, or to be looked at. The rest of a policy's directory is kept.
NOT_KEPT = (STATE_FILE, "loss.png")


@dataclass(frozen=True)
class Phase:
    """Cells that may run at the same time.

    Attributes:
        stage: Their stage.
        kind: What its cells do.
        seeds: The training seeds of the policies; empty for all.
    """

    stage: str
    kind: str
    seeds: tuple[int, ...] = ()

    def has(self, policy: PlannedPolicy) -> bool:
        """Whether a policy of the stage belongs to it."""
        return not self.seeds or policy.seed in self.seeds


@dataclass(frozen=True)
class Answer(Study):
    """Policies trained with different numbers of future tokens, and in other respects, judged alike.

    Attributes:
        plan: What is trained, and how it is judged.
        stages: The stages that are run, in the order of the plan.
        recipes: Names of the recipes whose policies are run; empty for all.
        arms: Names of the arms that are run, in stages that have some; empty for all.
        phase: How many of `phases` are over.
        demos: Directory of each recording, by name; set by `begin`, as are `trainings`.
        trainings: Directory of each backbone and each policy, by name.
        trained: Hash of each one that is finished, by name.
    """

    plan: Plan
    stages: tuple[str, ...]
    recipes: tuple[str, ...] = ()
    arms: tuple[str, ...] = ()
    phase: int = 0
    demos: Mapping[str, Path] = field(default_factory=dict)
    trainings: Mapping[str, Path] = field(default_factory=dict)
    trained: Mapping[str, str] = field(default_factory=dict)
    name: ClassVar[str] = "answer"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See `Study`."""
        parser.epilog = EPILOG
        choice.add_arguments(parser, plans.PLAN)

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Answer:
        """See `Study`."""
        from saccade_lab.sim import graphics

        chosen = choice.choose(args, plans.PLAN)
        graphics.check()
        return cls(plans.PLAN, *chosen)

    def begin(self, out: Path) -> Answer:
        """See `Study`."""
        own = out / self.name
        demos = {recording.name: own / "demos" / recording.name for recording in self.plan.recordings}
        trainings = {one.name: own / "backbones" / one.name for one in self.plan.backbones}
        for policy in self.plan.all_policies(pilots=True):
            trainings[policy.name] = own / "policies" / policy.name
        found = replace(self, demos=demos, trainings=trainings)
        path = table_path(out, self.name)  # of an earlier run, which may have had other stages
        return found.with_trained(read_table(path)) if path.exists() else found

    def settings(self) -> Mapping[str, Any]:
        """See `Study`."""
        return {
            "engine": "rust",
            "tasks": list(self.plan.tasks),
            "episodes": list(self.plan.seeds),
            "pilot_episodes": list(self.plan.pilot_seeds),
        }

    @property
    def chosen(self) -> Plan:
        """The plan with the recipes that are run alone."""
        return self.plan.only(self.recipes)

    @property
    def phases(self) -> list[Phase]:
        """The phases in their order: a stage is finished before the next one begins.

        `SEEDS_TOGETHER` training seeds are trained and judged before the next ones, so that a run which is
        stopped leaves whole pairs with their episodes; but nothing of the core is judged before all of it is
        trained.
        """
        phases = []
        for stage in self.stages:
            if stage in (*MEASURED, TIMES):
                phases.append(Phase(stage, stage))
            elif stage in ARMS:
                phases.append(Phase(stage, EPISODES))
            else:
                phases += [Phase(stage, kind) for kind in (RECORDING, BACKBONE)]
                seeds = sorted({policy.seed for policy in self.chosen.policies(stage)})
                together = len(seeds) if stage == CORE_STAGE else SEEDS_TOGETHER
                for first in range(0, len(seeds), together):
                    some = tuple(seeds[first : first + together])
                    phases += [Phase(stage, kind, some) for kind in (TRAINING, EPISODES)]
        return phases

    def cells(self) -> Sequence[Cell]:
        """See `Study`: those of the phases so far."""
        so_far = map(self.cells_of, self.phases[: self.phase + 1])
        return list({cell.key: cell for cell in itertools.chain.from_iterable(so_far)}.values())

    def cells_of(self, phase: Phase) -> Iterator[Cell]:
        """The cells of one phase. Stages may share recordings and backbones."""
        kind = phase.kind
        if kind == EPISODES:
            yield from self.episode_cells(phase)
            return
        if kind == TIMES:  # one cell for all, which are timed alternately
            timed = self.timed()
            if timed:
                checkpoints = {
                    name: self.trained[policy.name] if self.is_here(policy) else UNTRAINED
                    for name, policy in timed.items()
                }
                yield Cell((TIMES,), {"checkpoints": checkpoints})
            return
        if kind in MEASURED:
            for policy in MEASURED[kind].policies(self.chosen):
                if policy.name in self.trained:
                    settings = {"checkpoint": self.trained[policy.name], "episodes": list(self.first_seeds)}
                    yield Cell((kind, policy.name), settings)
            return
        for policy in self.chosen.policies(phase.stage):
            if not phase.has(policy):
                continue
            backbone = policy.backbone
            recording = described(self.plan.recording(policy.recording))
            if kind == RECORDING:
                yield Cell((RECORDING, policy.recording), recording)
            elif kind == BACKBONE:
                yield Cell((BACKBONE, backbone.name), {**backbone.to_dict(), "recording": recording})
            elif backbone.name in self.trained:
                planned = {"training": policy.training.to_dict(), "recording": recording}
                yield Cell((TRAINING, policy.name), {**planned, "backbone": self.trained[backbone.name]})

    def episode_cells(self, phase: Phase) -> Iterator[Cell]:
        """A cell for each task of each trained policy and arm: its own policies, or the arms of a stage that
        trains none, with all policies.
        """
        for policy, arm in self.judged(phase.stage):
            if policy.name in self.trained and phase.has(policy):
                episodes = list(self.plan.episodes(policy.recipe.stage))
                settings = {"checkpoint": self.trained[policy.name], "episodes": episodes}
                yield from (Cell((EPISODES, policy.name, arm, task), settings) for task in self.plan.tasks)

    def judged(self, stage: str) -> Iterator[tuple[PlannedPolicy, str]]:
        """The policies and arms of a stage that are run, see `choice.judged`."""
        return choice.judged(stage, self.chosen, self.arms)

    def timed(self) -> dict[str, PlannedPolicy]:
        """The policy of each recipe that is timed, by the recipe's name, in the order of the plan: the first
        trained one whose weights are here. Of some policies only the hashes are kept; where no weights of a
        recipe are here, it is the first trained one, which is timed with its first weights.
        """
        trained = [one for one in self.chosen.all_policies(pilots=False) if one.name in self.trained]
        found: dict[str, PlannedPolicy] = {}
        for policy in trained:
            before = found.setdefault(policy.recipe.name, policy)
            if self.is_here(policy) and not self.is_here(before):
                found[policy.recipe.name] = policy
        return found

    def is_here(self, policy: PlannedPolicy) -> bool:
        """Whether the weights of a trained policy are here."""
        return self.trainings[policy.name].is_dir()

    @property
    def first_seeds(self) -> range:
        """The episodes of the stages of `MEASURED`."""
        return self.plan.seeds[:FIRST_EPISODES]

    @property
    def num_cells(self) -> int:
        """See `Study`. Stages without training count the policies that these stages train, or earlier ones
        have trained.
        """
        planned = [policy for stage in self.stages for policy in self.chosen.policies(stage)]
        known = {policy.name for policy in planned} | set(self.trained)
        runs = [policy for stage in self.stages for policy, _ in self.judged(stage) if policy.name in known]
        recordings = {policy.recording for policy in planned}
        backbones = {policy.backbone.name for policy in planned}
        of_policies = [MEASURED[stage].policies(self.chosen) for stage in self.stages if stage in MEASURED]
        measured = [one for policies in of_policies for one in policies if one.name in known]
        trained = len(recordings) + len(backbones) + len(planned)
        timed = TIMES in self.stages and bool(planned or self.timed())
        return trained + len(runs) * len(self.plan.tasks) + len(measured) + timed

    def then(self, table: pd.DataFrame) -> Answer | None:
        """See `Study`."""
        if self.phase + 1 == len(self.phases):
            return None
        found = replace(self.with_trained(table), phase=self.phase + 1)
        found.delete_features()
        return found

    def with_trained(self, table: pd.DataFrame) -> Answer:
        """The study with the hashes of the backbones and policies that the table describes."""
        rows = [] if table.empty else table[table["kind"].isin((BACKBONE, TRAINING))].to_dict("records")
        return replace(self, trained={row["policy"]: row["checkpoint_sha256"] for row in rows})

    def delete_features(self) -> None:
        """Deletes the features of every backbone on which no policy of the plan remains to be trained. Pilots
        count only if their stage is run.
        """
        from saccade_lab.sim.settings import TENSOR_FILE

        planned = list(self.plan.all_policies(pilots=PILOT in self.stages))
        wanted = {policy.backbone.name for policy in planned if policy.name not in self.trained}
        beside = {policy.backbone.name: self.trainings[policy.name].parent for policy in planned}
        for name, policies in beside.items():
            tensors = self.trainings[name] / TENSOR_FILE
            if name not in wanted and tensors.is_file():
                # The star in front is for what a run that was killed left.
                for path in policies.glob("*" + features_name(sha256_of(tensors), "*", "*")):
                    path.unlink()

    @property
    def files(self) -> tuple[str | Path, ...]:
        """See `Study`: the finished policies. Demonstrations, and policies in training, stay in the output
        directory, which other machines must share.
        """
        if self.phases[self.phase].kind not in (EPISODES, *MEASURED, TIMES):
            return ()
        trained = [one.name for one in self.chosen.all_policies(pilots=True) if one.name in self.trained]
        return tuple(self.trainings[name] for name in trained if self.trainings[name].is_dir())

    def measure(self, cell: Cell) -> Rows:
        """See `Study`; the first word of the key says what is measured."""
        kind = str(cell.key[0])
        rows = self.time() if kind == TIMES else self.measure_one(kind, *map(str, cell.key[1:]))
        return [{"kind": kind, **row} for row in rows]

    def measure_one(self, kind: str, name: str, arm: str = "", task: str = "") -> Rows:
        """Measures one recording, backbone or policy."""
        if kind == RECORDING:
            return [self.record(name)]
        if kind == BACKBONE:
            return [self.train(next(one for one in self.plan.backbones if one.name == name))]
        if kind == TRAINING:
            return [self.train(self.planned(name))]
        if kind in MEASURED:
            found = MEASURED[kind].measure(str(self.finished(name)), self.plan.tasks, self.first_seeds)
            return [{**self.planned(name).columns, **row} for row in found]
        return self.judge(self.planned(name), arm, task)

    def time(self) -> Rows:
        """Latencies of a policy of each recipe, timed alternately."""
        timed = self.timed().values()
        directories = [self.finished(one.name) if self.is_here(one) else None for one in timed]
        return latencies(list(zip(timed, directories, strict=True)), self.plan)

    def planned(self, name: str) -> PlannedPolicy:
        """A policy of the plan by its name."""
        return next(policy for policy in self.plan.all_policies(pilots=True) if policy.name == name)

    def record(self, name: str) -> dict[str, Any]:
        """Records what is missing of a recording, and describes it."""
        from saccade_lab.sim import demos, environment_cache
        from saccade_lab.training.dataset import describe

        recording = self.plan.recording(name)
        start = time.perf_counter()
        demos.record_tasks(recording.counts, self.demos[name], recording.settings, lambda task: None)
        environment_cache.close()
        found = describe(self.demos[name], demos.recorded_tasks(self.demos[name]))
        return {
            "recording": name,
            "demonstrations": sum(found["tasks"].values()),
            "demonstrations_sha256": found["sha256"],
            "seconds": time.perf_counter() - start,
        }

    def train(self, planned: Backbone | PlannedPolicy) -> dict[str, Any]:
        """Trains a backbone or a policy unless that is done, and describes it.

        A column `trained_from_step` says how many steps were done when this process began: with another
        number than 0, `seconds` and `cpu` are those of the last part of the training only.
        """
        directory, recording = self.trainings[planned.name], planned.recording
        settings = planned.training
        backbone = self.finished(planned.backbone.name) if isinstance(planned, PlannedPolicy) else None
        start, first = time.perf_counter(), self.steps_done(planned, backbone)
        if first < settings.steps:
            self.record(recording)
            Planned(planned.name, str(self.demos[recording]), settings).train(directory, backbone)
        seconds = time.perf_counter() - start
        for name in NOT_KEPT:
            (directory / name).unlink(missing_ok=True)
        run = read_run(directory, ("image_size", "num_cameras", "num_vl_tokens"))
        found = cost(settings, self.plan.recording(recording))
        recorded = {**asdict(settings), **run.settings}
        known = {name: value for name, value in recorded.items() if name not in ALREADY}
        losses = {name: loss for name, loss in run.history[-1].items() if name != "step"}
        return {
            **planned.columns,
            **known,
            **run.point,
            "recording": recording,
            "demonstrations_sha256": run.settings["demonstrations"]["sha256"],
            "checkpoint_sha256": run.checkpoint_sha256,
            "policy_bytes": sum(file.stat().st_size for file in directory.rglob("*") if file.is_file()),
            **losses,
            "trained_from_step": first,
            "seconds": seconds,
            "chunk_multiply_adds": found.chunk,
            "training_multiply_adds": found.sample * settings.batch_size * settings.steps,
        }

    def steps_done(self, planned: Backbone | PlannedPolicy, backbone: Path | None) -> int:
        """The steps that what is in its directory was trained for.

        Args:
            planned: What is to be trained.
            backbone: The backbone of a policy.

        Raises:
            InputError: it was trained with other settings, demonstrations or another backbone.
        """
        from saccade_lab.sim.settings import TENSOR_FILE

        directory = self.trainings[planned.name]
        if not (directory / "settings.json").is_file():
            return 0
        run = read_run(directory, ())
        wanted = planned.training.to_dict()
        if backbone is not None:
            wanted["start_sha256"] = sha256_of(backbone / TENSOR_FILE)
        found = {name: value for name, value in run.settings.items() if name != "demonstrations"}
        other = changed(found, wanted)
        if other:
            raise InputError(f"{directory}: was trained with other settings ({', '.join(other)})")
        counts = dict(self.plan.recording(planned.recording).counts)
        if run.settings["demonstrations"]["tasks"] != counts:
            raise InputError(f"{directory}: was trained on other demonstrations, expected {counts}")
        if run.finished:
            return run.step
        # Without its state, a run that was stopped cannot be continued, and is begun again.
        return saved_step(directory / STATE_FILE)

    def judge(self, policy: PlannedPolicy, arm: str, task: str) -> Rows:
        """All episodes of a task, a row each; raises as `finished`."""
        directory, blind = self.finished(policy.name), policy.training.blind
        rows = []
        for seed in self.plan.episodes(policy.recipe.stage):
            episode = judge(str(directory), task, seed, find_arm(arm), blind=blind)
            result = {"success": episode.success, "control_steps": episode.steps, "chunks": episode.chunks}
            rows.append({**policy.columns, "arm": arm, "task": task, "seed": seed, **result})
        return rows

    def finished(self, name: str) -> Path:
        """The directory of a backbone or a policy that is trained.

        Raises:
            FileNotFoundError: it is not there.
            InputError: it is not the one that the table describes.
        """
        directory, expected = self.trainings[name], self.trained[name]
        if not directory.is_dir():
            raise FileNotFoundError(
                f"{directory}: no such policy; it was trained, with the hash {expected}. Put it back, or "
                "delete its file in answer/cells to train it again"
            )
        found = checkpoint_identity(directory)["sha256"]
        if found != expected:
            raise InputError(f"{directory}: has the hash {found}, expected {expected}, which was trained")
        return directory

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Answered:
        """See `Study`."""
        return section(table, provenance, plans.PLAN)


def described(recording: Recording) -> dict[str, Any]:
    """A recording as JSON."""
    return {"counts": dict(recording.counts), **recording.settings.to_dict()}
