"""``saccade study fast``: what faster modes of the head cost in actions and success, and what they save."""

from __future__ import annotations

import argparse
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from saccade._internal.arrays import PRECISIONS, Float32Array
from saccade._internal.flags import add_list
from saccade.errors import InputError
from saccade_lab.flags import add_rollout_arguments, check_known
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.arguments import source_of
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.questions.fast_modes import (
    Calibration,
    Mode,
    best_times,
    cross_mass,
    encode,
    integrate,
    many_steps,
    sample,
    velocity_of,
)
from saccade_lab.study.questions.fast_results import BASELINE, ONE_STEP
from saccade_lab.study.questions.fast_section import section
from saccade_lab.study.questions.fast_times import FULL, OWN, times_at_full_size, times_of
from saccade_lab.study.section import Section
from saccade_lab.study.source import Source
from saccade_lab.study.study import Study
from saccade_lab.study.table import Provenance

CALIBRATE, CHUNKS, EPISODES, TIME = "calibrate", "chunks", "episodes", "time"
PARTS = (CHUNKS, EPISODES, TIME)

# What is screened by the error of its chunks. Not a full grid: each line varies one thing.
SCREENED = (
    *(
        f"{precision}-euler-{steps}"
        for precision in ("float32", "bfloat16", "int8")
        for steps in (1, 2, 4, 8)
    ),
    *(f"float32-{rest}" for rest in ("euler-3", "heun-1", "heun-2", "midpoint-1", "midpoint-2")),
    *(f"float32-{rest}" for rest in ("adams-2", "adams-3", "adams-4", "times-2", "times-3")),
    *(f"{precision}-midpoint-1-refresh-2" for precision in ("float32", "int8")),
    *(f"{precision}-euler-4-refresh-{every}" for precision in ("float32", "int8") for every in (2, 4)),
    *(f"float32-euler-4-drop-{percent}" for percent in (25, 50, 75)),
)
# What runs in closed loop by default; docs/precision.md says how these were selected by the screening.
JUDGED = (
    ONE_STEP,
    *(f"float32-{rest}" for rest in ("euler-2", "euler-3", "adams-2", "adams-3", "times-2", "midpoint-1")),
    *(f"float32-euler-4-{rest}" for rest in ("refresh-2", "refresh-4", "drop-25", "drop-50")),
    "float32-midpoint-1-refresh-2",
    "bfloat16-euler-4",
    "bfloat16-midpoint-1",
    *(f"int8-euler-{rest}" for rest in ("2", "4", "4-refresh-2", "4-refresh-4")),
    *(f"int8-midpoint-1{rest}" for rest in ("", "-refresh-2")),
)
CALIBRATION_EPISODES = 8  # per task, on validation seeds; the same number of observations of a recording

EPILOG = f"""\
A mode is PRECISION-INTEGRATOR-STEPS, optionally with -refresh-NUMBER (state and future rows are recomputed
every NUMBER evaluations) and -drop-PERCENT (the vision-language tokens with the least attention are removed).
Precisions: {", ".join(PRECISIONS)}. Integrators: euler, midpoint, heun, adams, and times (Euler at step
times that are first optimised on other episodes). All modes are compared with {BASELINE}.

Parts: chunks (the error of each mode's chunks, on the observations of the unchanged policy), episodes (closed
loop, paired by episode), time (of a chunk, also at N1.5's size with random weights; use an idle machine). A
mode is judged only on tasks on which one Euler step measurably fails.

With --features: chunks and time, for any checkpoint on recorded observations. No simulator, no closed loop.

examples:
  saccade study fast --checkpoint out/policy --tasks fork --parts chunks --episodes 20 --out out/study
  saccade study fast --checkpoint out/policy --tasks fork --episodes 300 --out out/study
  saccade study fast --checkpoint checkpoint/ --features observations.npz --out out/own
  saccade study fast --features observations.npz --modes int8-euler-4 --parts chunks --out out/own
"""


@dataclass(frozen=True)
class Fast(Study):
    """What faster modes cost in actions and in success, and what they save.

    Attributes:
        source: Checkpoint and observations.
        parts: Names from ``PARTS``. ``episodes`` is skipped without a closed loop.
        modes: Names of modes. Default: those of each part.
        calibration: What calibrated modes depend on; None until it has been measured.
    """

    source: Source
    parts: tuple[str, ...] = PARTS
    modes: tuple[str, ...] | None = None
    calibration: Calibration | None = None
    name: ClassVar[str] = "fast"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=300)
        add_list(parser, "--modes", help="modes (default: a list for each part)")
        add_list(
            parser, "--parts", help="chunks, episodes, time (default: all; with --features without episodes)"
        )

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Fast:
        """See ``Study``."""
        parts = PARTS if args.parts is None else args.parts
        check_known("--parts", parts, PARTS)
        modes = None
        if args.modes is not None:
            modes = tuple(dict.fromkeys(Mode.parse(name).name for name in args.modes))
        if args.features is not None and args.parts is not None and EPISODES in parts:
            raise InputError("--parts: episodes: not with --features, which has no simulator")
        return cls(source_of(args), tuple(parts), modes)

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        return self.source.describe()

    @property
    def modes_by_part(self) -> dict[str, list[Mode]]:
        """The modes of each part, the baseline first. Calibrated ones need something to calibrate them on."""
        defaults = {CHUNKS: (*SCREENED, *JUDGED), EPISODES: JUDGED, TIME: (*SCREENED, *JUDGED)}
        calibrates = bool(calibration_units(self.source))
        named = {
            part: dict.fromkeys((BASELINE, *(self.modes or defaults[part])))
            for part in self.parts
            if self.source.closed_loop or part != EPISODES
        }
        modes = {part: [Mode.parse(name) for name in names] for part, names in named.items()}
        return {
            part: [mode for mode in found if calibrates or not mode.calibrated]
            for part, found in modes.items()
        }

    def calibration_cells(self) -> list[Cell]:
        """The first stage: step times for each number of steps, and the attention of each position."""
        asked = {mode for modes in self.modes_by_part.values() for mode in modes}
        steps = sorted({mode.num_steps for mode in asked if mode.integrator == "times"})
        keys: list[tuple[str, int]] = [("times", number) for number in steps]
        if any(mode.drop for mode in asked):
            keys.append(("mass", 0))
        return [Cell((CALIBRATE, *key, ""), calibration_settings(self.source)) for key in keys]

    @property
    def calibrating(self) -> bool:
        """Whether this is the first stage."""
        return self.calibration is None and bool(self.calibration_cells())

    def cells(self) -> Sequence[Cell]:
        """See ``Study``."""
        first = self.calibration_cells()
        if self.calibrating:
            return first
        modes, calibration = self.modes_by_part, self.calibration or Calibration()
        measured = [
            Cell((part, *unit, mode.name), {"calibration": calibration.of(mode)} if mode.calibrated else {})
            for part in (CHUNKS, EPISODES)
            for unit in self.source.units
            for mode in modes.get(part, [])
            if not mode.calibrated or judges_calibrated(self.source, unit)
        ]
        if TIME in modes:
            named = {"modes": [[mode.name, calibration.of(mode)] for mode in modes[TIME]]}
            sizes = (OWN, FULL) if self.source.closed_loop else (OWN,)
            measured += [Cell((TIME, size, 0, ""), named) for size in sizes]
        return [*first, *measured]

    @property
    def num_cells(self) -> int:
        """See ``Study``."""
        return len(self.cells()) + self.calibrating

    def then(self, table: pd.DataFrame) -> Fast | None:
        """See ``Study``: after the calibration, everything else."""
        return replace(self, calibration=calibration_of(table)) if self.calibrating else None

    def measure(self, cell: Cell) -> Rows:
        """See ``Study``."""
        part, task, seed, name = str(cell.key[0]), str(cell.key[1]), int(cell.key[2]), str(cell.key[3])
        if part == CALIBRATE:
            values = self.mass() if task == "mass" else self.step_times(seed)
            row = {"part": part, "task": task, "seed": seed}
            return [{**row, "index": index, "value": value} for index, value in enumerate(values)]
        calibration = self.calibration or Calibration()
        if part == TIME:
            rows = self.times(calibration, task)
            return [{"part": part, "task": task, "seed": seed, **row} for row in rows]
        mode = Mode.parse(name)
        measured = (self.episode if part == EPISODES else self.chunks)(task, seed, mode, calibration)
        return [{"part": part, "task": task, "seed": seed, "mode": name, **measured}]

    def mass(self) -> list[float]:
        """The share of the cross-attention of each position of T_vl, over observations that have it."""
        head = self.source.head()
        shares = [cross_mass(head, one.encode(head), one) for one in calibration_observations(self.source)]
        longest = max(map(len, shares))
        return [
            float(np.mean([share[position] for share in shares if position < len(share)]))
            for position in range(longest)
        ]

    def step_times(self, num_steps: int) -> list[float]:
        """The best step times, without the first and the last."""
        source, head = self.source, self.source.head()
        observations = calibration_observations(source)
        contexts = [one.encode(head) for one in observations]
        exact = [
            source.comparable(many_steps(head, context, one))
            for context, one in zip(contexts, observations, strict=True)
        ]

        def error(times: tuple[float, ...]) -> float:
            errors = []
            for context, one, aim in zip(contexts, observations, exact, strict=True):
                assert one.noise is not None
                chunk = integrate(velocity_of(head, context, one), one.noise, "euler", times)
                found = source.comparable(chunk[..., : head.config.action_dim])
                errors.append(np.abs(found - aim).mean())
            return float(np.mean(errors))

        return list(best_times(error, num_steps)[1:-1])

    def episode(self, task: str, seed: int, mode: Mode, calibration: Calibration) -> dict[str, Any]:
        """One episode in closed loop."""
        from saccade_lab.sim.rollout import run_episode
        from saccade_lab.study.questions.fast_engine import policy_in
        from saccade_lab.study.simulator import Simulator, environment_of

        assert isinstance(self.source, Simulator)
        policy = policy_in(self.source.checkpoint, mode, calibration)
        episode = run_episode(environment_of(self.source.checkpoint, task), policy, seed)
        return {"success": episode.success, "steps": episode.steps, "chunks": episode.chunks}

    def chunks(self, task: str, seed: int, mode: Mode, calibration: Calibration) -> dict[str, Any]:
        """How far the mode's chunks are from those of the baseline, and from those of many steps."""
        head = self.source.head(mode.precision)
        changes, errors, scales = [], [], []
        for known in references(self.source, task, seed):
            context = encode(head, mode, calibration, known.observation)
            chunk = self.source.comparable(sample(head, mode, calibration, context, known.observation))
            changes.append(np.abs(chunk - known.chunk))
            errors.append(np.abs(chunk - known.exact))
            if known.other is not None:
                scales.append(np.abs(known.other - known.chunk).mean())
        return {
            "episode": self.source.labels(task, seed).get("episode", seed),
            "num_observations": len(changes),
            "chunk_change": float(np.mean(changes)),
            "chunk_change_max": float(np.max(changes)),
            "chunk_error": float(np.mean(errors)),
            "noise_change": float(np.mean(scales)) if scales else None,
        }

    def times(self, calibration: Calibration, size: str) -> Rows:
        """How long a chunk takes in each mode, at the checkpoint's own size or at N1.5's."""
        modes = self.modes_by_part[TIME]
        if size == FULL:
            return times_at_full_size(modes, calibration)
        loaded = {mode.precision: self.source.head(mode.precision) for mode in modes}
        if self.source.closed_loop:
            one = calibration_observations(self.source)[0]
        else:
            one = self.source.observed(*self.source.units[0]).with_draw(0)
        return times_of(modes, loaded, calibration, one)

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        return section(table, provenance)


def calibration_units(source: Source) -> list[tuple[str, int]]:
    """The units for calibration: validation episodes, or rows of the even episodes of a recording.

    Returns:
        Nothing for a recording of a single episode.
    """
    if source.closed_loop:
        from saccade_lab.sim.tasks import VALIDATION_SEEDS

        tasks = dict.fromkeys(task for task, _ in source.units)
        return [(task, seed) for task in tasks for seed in VALIDATION_SEEDS[:CALIBRATION_EPISODES]]
    if not any(judges_calibrated(source, unit) for unit in source.units):
        return []
    return [unit for unit in source.units if not judges_calibrated(source, unit)][:CALIBRATION_EPISODES]


def judges_calibrated(source: Source, unit: tuple[str, int]) -> bool:
    """Whether calibrated modes are measured on a unit: in recordings, only on odd episodes."""
    return source.closed_loop or bool(source.labels(*unit)["episode"] % 2)


def calibration_settings(source: Source) -> Mapping[str, Any]:
    """What a calibration depends on, apart from checkpoint and recording."""
    units = calibration_units(source)
    numbers = list(dict.fromkeys(seed for _, seed in units))
    if source.closed_loop:
        return {"tasks": list(dict.fromkeys(task for task, _ in units)), "seeds": numbers}
    return {"rows": numbers}


@functools.lru_cache(maxsize=1)
def calibration_observations(source: Source) -> list[HeadInputs]:
    """Single observations with one noise; cached, because every cell of the calibration needs them."""
    return [one.with_draw(0) for unit in calibration_units(source) for one in source.observed(*unit).rows()]


@dataclass(frozen=True, eq=False)
class Reference:
    """An observation, and the chunks that those of a mode are compared with.

    Attributes:
        observation: Input of the head.
        chunk: Chunk of the baseline, comparable actions ``(1, horizon, action_dim)``.
        exact: Chunk of many steps.
        other: Chunk of the baseline from other noise; None if the recording has only one noise.
    """

    observation: HeadInputs
    chunk: Float32Array
    exact: Float32Array
    other: Float32Array | None


@functools.lru_cache(maxsize=1)
def references(source: Source, task: str, seed: int) -> list[Reference]:
    """The observations of an episode, or a row of a recording; cached for the next mode."""
    mode, head, rng = Mode.parse(BASELINE), source.head(), source.rng(task, seed)
    found = []
    for row in source.observed(task, seed).rows():
        one = row.with_draw(0)
        assert one.noise is not None
        context = one.encode(head)
        chunk, exact = (
            source.comparable(actions)
            for actions in (sample(head, mode, Calibration(), context, one), many_steps(head, context, one))
        )
        other: HeadInputs | None = row.with_draw(1) if row.draws > 1 else None
        if source.closed_loop:
            other = replace(one, noise=rng.standard_normal(one.noise.shape, dtype=np.float32))
        repeated = None
        if other is not None:
            repeated = source.comparable(sample(head, mode, Calibration(), context, other))
        found.append(Reference(one, chunk, exact, repeated))
    return found


def calibration_of(table: pd.DataFrame) -> Calibration:
    """The calibration that is in the study's table."""
    rows = table[table["part"] == CALIBRATE]
    times = rows[rows["task"] == "times"].groupby("seed")["value"]
    mass = rows[rows["task"] == "mass"].sort_values("index")["value"]
    return Calibration(
        tuple((0.0, *(float(value) for value in found), 1.0) for _, found in times),
        tuple(float(value) for value in mass),
    )
