"""`saccade study fast`: what faster modes of the head cost in actions and in success, and what they save."""

from __future__ import annotations

import argparse
import functools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from saccade.bench import heads
from saccade.errors import InputError
from saccade.head import ActionHead, Context
from saccade.sim.policy import EMBODIMENT_ID, Float32Array, Policy
from saccade.sim.rollout import run_episode
from saccade.sim.tasks import VALIDATION_SEEDS
from saccade.study import features
from saccade.study.arguments import check_known, names
from saccade.study.cells import Cell, OnDone, Rows, run_cells
from saccade.study.closed_loop import unchanged_episode
from saccade.study.fast_modes import (
    PRECISIONS,
    BoolArray,
    Calibration,
    Mode,
    ModeEngine,
    best_times,
    cross_mass,
    encode,
    head_of,
    integrate,
    many_steps,
    sample,
    velocity_of,
)
from saccade.study.fast_report import BASELINE, ONE_STEP, section
from saccade.study.features import Recording, head_and_observations, recording_of
from saccade.study.loaded import describe_checkpoint, environment_of, policy_of
from saccade.study.observations import Rollouts, add_rollout_arguments, record_looks, rollouts_of

__all__ = ["STUDY", "add_arguments", "run", "section", "settings"]

STUDY = "fast"
CALIBRATE, CHUNKS, EPISODES, TIME = "calibrate", "chunks", "episodes", "time"
PARTS = (CHUNKS, EPISODES, TIME)
OWN, FULL = "own", "n1.5"  # sizes at which a chunk is timed
FULL_TOKENS = 296  # one camera of N1.5

# What is screened by the error of its chunks. A catalogue, not a grid: each line varies one thing.
SCREENED = (
    *(f"{precision}-euler-{steps}" for precision in PRECISIONS for steps in (1, 2, 4, 8)),
    *(f"float32-{rest}" for rest in ("euler-3", "heun-1", "heun-2", "midpoint-1", "midpoint-2")),
    *(f"float32-{rest}" for rest in ("adams-2", "adams-3", "adams-4", "times-2", "times-3")),
    *(f"{precision}-midpoint-1-refresh-2" for precision in ("float32", "int8")),
    *(f"{precision}-euler-4-refresh-{every}" for precision in ("float32", "int8") for every in (2, 4)),
    *(f"float32-euler-4-drop-{percent}" for percent in (25, 50, 75)),
)
# What runs in closed loop if nothing else is asked for; docs/fast.md says how it was chosen by the screening.
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
CALIBRATION_EPISODES = 8  # of each task, on seeds that are kept for choosing; as many observations of a file
FEWEST_ROUNDS, MOST_ROUNDS = 3, 40
ROUNDS_SECONDS = 120.0  # that are not exceeded once there are the fewest

EPILOG = f"""\
A mode is PRECISION-INTEGRATOR-STEPS, then -refresh-NUMBER (state and future rows computed anew at every so
many evaluations) and -drop-PERCENT (vision-language tokens removed, those with the least attention).
Precisions: {", ".join(PRECISIONS)}. Integrators: euler, midpoint, heun, adams, and times (Euler at step
times that are optimised on other episodes first). All are compared with {BASELINE}.

Parts: chunks (the error of each mode's chunk, on what the unchanged policy saw), episodes (closed loop,
paired by episode), time (of a chunk, on an idle machine if the numbers are to be kept; also at N1.5's size
with random weights). A task on which one Euler step does not measurably fail judges no mode.

With --features: chunks and time of any checkpoint on a file of features. No simulator, no closed loop.

examples:
  saccade study fast --checkpoint out/policy --tasks fork --parts chunks --episodes 20 --out out/study
  saccade study fast --checkpoint out/policy --tasks fork --episodes 300 --out out/study
  saccade study fast --checkpoint checkpoint/ --features looks.npz --out out/own
  saccade study fast --features looks.npz --modes int8-euler-4,float32-euler-2 --parts chunks --out out/own
"""


@dataclass(frozen=True)
class Given:
    """What the head was given at one look.

    Attributes:
        features: `(1, T_vl, context_dim)`.
        state: `(1, state_dim)` or `(1, history, state_dim)`.
        embodiment_id: Of the robot.
        noise: `(1, horizon, encoder_action_dim)`.
        other_noise: Another draw; None if the file has one only.
        removed: Positions that are not there, `(1, T_vl)`, or None.
    """

    features: Float32Array
    state: Float32Array
    embodiment_id: int
    noise: Float32Array
    other_noise: Float32Array | None
    removed: BoolArray | None


@dataclass(frozen=True)
class Simulated:
    """A policy in the simulator.

    Attributes:
        checkpoint: Its directory.
        tasks: What the episodes for calibration are of.
    """

    checkpoint: str
    tasks: tuple[str, ...]

    def head(self, precision: str) -> ActionHead:
        """Its head, on one thread: episodes are spread out over processes."""
        return head_of(self.checkpoint, None, precision, 1)

    def looks(self, task: str, seed: int) -> list[Given]:
        """All looks of an episode of the unchanged policy."""
        _, looks = unchanged_episode(self.checkpoint, "rust", task, seed)
        rng = np.random.default_rng([seed, *task.encode()])
        return [
            Given(
                look.features,
                look.state,
                EMBODIMENT_ID,
                look.noise,
                rng.standard_normal(look.noise.shape, dtype=np.float32),
                None,
            )
            for look in looks
        ]

    def episode_of(self, seed: int) -> int:
        """What an observation stands and falls with."""
        return seed

    def for_calibration(self) -> list[Given]:
        """Looks of episodes that nothing is judged on."""
        policy = policy_of(self.checkpoint)
        found = []
        for task in self.tasks:
            for seed in VALIDATION_SEEDS[:CALIBRATION_EPISODES]:
                _, looks = record_looks(environment_of(self.checkpoint, task), policy, seed)
                found += [
                    Given(one.features, one.state, EMBODIMENT_ID, one.noise, None, None) for one in looks
                ]
        return found

    def comparable(self, chunk: Float32Array) -> Float32Array:
        """Actions as the robot gets them, in [-1, 1]."""
        return np.clip(policy_of(self.checkpoint).config.action.restore(chunk), -1.0, 1.0)


@dataclass(frozen=True)
class FromFile:
    """A checkpoint and a file of features."""

    recording: Recording

    def head(self, precision: str) -> ActionHead:
        """The head; in float32 the one that the file was checked against."""
        one = self.recording
        if precision == "float32":
            return features.head_of(one)
        return head_of(one.checkpoint, one.config, precision, one.num_threads)

    def looks(self, task: str, seed: int) -> list[Given]:
        """One observation of the file; `seed` is its row."""
        _, found = head_and_observations(self.recording)
        one = found.observation(seed, self.recording.seed)
        draws = one.noise.shape[1]
        return [
            Given(
                one.features,
                one.state,
                one.embodiment_id,
                one.noise[:, 0],
                one.noise[:, 1] if draws > 1 else None,
                one.drop_vl,
            )
        ]

    def episode_of(self, seed: int) -> int:
        """The episode that an observation is of."""
        return int(head_and_observations(self.recording)[1].episodes[seed])

    def rows(self) -> tuple[list[int], list[int]]:
        """Rows to calibrate on, of every other episode, and the rest. None of the former in a file of one."""
        _, found = head_and_observations(self.recording)
        all_rows = range(len(found))
        if found.episodes.max() == 0:
            return [], list(all_rows)
        chosen = [row for row in all_rows if found.episodes[row] % 2 == 0][:CALIBRATION_EPISODES]
        return chosen, [row for row in all_rows if found.episodes[row] % 2]

    def for_calibration(self) -> list[Given]:
        """Observations on which no calibrated mode is measured."""
        return [one for row in self.rows()[0] for one in self.looks("", row)]

    def comparable(self, chunk: Float32Array) -> Float32Array:
        """The head's own actions."""
        return chunk


Source: TypeAlias = Simulated | FromFile


@dataclass(frozen=True)
class Settings:
    """What is run.

    Attributes:
        rollouts: The episodes.
        parts: Of `PARTS`.
        modes: Names; None takes those that each part has by default.
    """

    rollouts: Rollouts
    parts: tuple[str, ...]
    modes: tuple[str, ...] | None


@dataclass(frozen=True)
class FileSettings:
    """What is run on a file of features; attributes as in `Settings`."""

    recording: Recording
    parts: tuple[str, ...]
    modes: tuple[str, ...] | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    add_rollout_arguments(parser, episodes=300)
    parser.add_argument(
        "--modes", metavar="NAME,...", help="modes, separated by commas (default: a list for each part)"
    )
    parser.add_argument(
        "--parts",
        metavar="NAME,...",
        help="chunks, episodes and time, separated by commas (default: all; with --features the other two)",
    )


def settings(args: argparse.Namespace) -> Settings | FileSettings:
    """From the arguments; raises what is wrong with them."""
    parts = PARTS if args.parts is None else names("--parts", args.parts)
    check_known("parts", parts, PARTS)
    modes = None
    if args.modes is not None:
        modes = tuple(dict.fromkeys(Mode.parse(name).name for name in names("--modes", args.modes)))
    if args.features is None:
        return Settings(rollouts_of(args), parts, modes)
    if args.parts is not None and EPISODES in parts:
        raise InputError("--parts: episodes: not with --features, which has no simulator")
    recording = recording_of(args)
    head_and_observations(recording)
    return FileSettings(recording, tuple(part for part in parts if part != EPISODES), modes)


def run(settings: Settings | FileSettings, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
    """Calibrates first, then works through the parts."""
    if isinstance(settings, FileSettings):
        head, _ = head_and_observations(settings.recording)
        described = features.describe(settings.recording, head.config)
        source: Source = FromFile(settings.recording)
        calibrates = bool(FromFile(settings.recording).rows()[0])
    else:
        described = {"checkpoint": describe_checkpoint(settings.rollouts.checkpoint)}
        source = Simulated(settings.rollouts.checkpoint, settings.rollouts.tasks)
        calibrates = True
    modes = {
        part: [Mode.parse(name) for name in dict.fromkeys((BASELINE, *(settings.modes or defaults)))]
        for part, defaults in (
            (CHUNKS, (*SCREENED, *JUDGED)),
            (EPISODES, JUDGED),
            (TIME, (*SCREENED, *JUDGED)),
        )
        if part in settings.parts
    }
    if not calibrates:
        modes = {part: [mode for mode in found if not mode.calibrated] for part, found in modes.items()}
    asked = {mode for found in modes.values() for mode in found}
    first = [
        Cell((CALIBRATE, "times", steps, ""), calibration_settings(source))
        for steps in sorted({mode.num_steps for mode in asked if mode.integrator == "times"})
    ]
    if any(mode.drop for mode in asked):
        first.append(Cell((CALIBRATE, "mass", 0, ""), calibration_settings(source)))

    def worked(cells: list[Cell], work: Callable[[Cell], Rows], expected: int = 0) -> pd.DataFrame:
        return run_cells(
            STUDY,
            cells,
            work,
            out,
            settings=described,
            backend=backend,
            jobs=jobs,
            on_done=on_done,
            expected=expected,
        )

    calibration = (
        calibration_of(worked(first, CalibrationWork(source), len(first) + 1)) if first else Calibration()
    )
    cells = [
        Cell((part, task, seed, mode.name), {"calibration": calibration.of(mode)} if mode.calibrated else {})
        for part in (CHUNKS, EPISODES)
        for task, seed in observed(settings, part)
        for mode in modes.get(part, [])
        if measures(source, seed, mode)
    ]
    if TIME in modes:
        named = {"modes": [[mode.name, calibration.of(mode)] for mode in modes[TIME]]}
        sizes = (OWN,) if isinstance(settings, FileSettings) else (OWN, FULL)
        cells += [Cell((TIME, size, 0, ""), named) for size in sizes]
    worked([*first, *cells], Work(source, calibration, tuple(modes.get(TIME, ()))))


def observed(settings: Settings | FileSettings, part: str) -> list[tuple[str, int]]:
    """Task and seed of what a part is measured on."""
    if isinstance(settings, Settings):
        return settings.rollouts.episodes
    _, found = head_and_observations(settings.recording)
    return [(features.TASK, row) for row in range(len(found))] if part == CHUNKS else []


def measures(source: Source, seed: int, mode: Mode) -> bool:
    """Whether the mode was not calibrated on this."""
    return not (mode.calibrated and isinstance(source, FromFile)) or seed in source.rows()[1]


def calibration_settings(source: Source) -> Mapping[str, Any]:
    """What a calibration depends on besides checkpoint and file."""
    if isinstance(source, FromFile):
        return {"rows": source.rows()[0]}
    return {"tasks": list(source.tasks), "seeds": list(VALIDATION_SEEDS[:CALIBRATION_EPISODES])}


@functools.lru_cache(maxsize=1)
def calibration_looks(source: Source) -> list[Given]:
    """Kept, because every cell of the calibration asks for them."""
    return source.for_calibration()


@dataclass(frozen=True)
class CalibrationWork:
    """Finds step times, or how much attention each vision-language position gets."""

    source: Source

    def __call__(self, cell: Cell) -> Rows:
        """A row for each step time but the first and the last, or for each position."""
        head = self.source.head("float32")
        looks = calibration_looks(self.source)
        contexts = [head.encode(one.features, drop_vl=one.removed) for one in looks]
        if cell.key[1] == "mass":
            shares = [
                cross_mass(head, context, one.state, one.embodiment_id, one.noise)
                for context, one in zip(contexts, looks, strict=True)
            ]
            values = np.mean(shares, axis=0).tolist()
        else:
            exact = [
                self.source.comparable(many_steps(head, context, one.state, one.embodiment_id, one.noise))
                for context, one in zip(contexts, looks, strict=True)
            ]

            def error(times: tuple[float, ...]) -> float:
                errors = []
                for context, one, aim in zip(contexts, looks, exact, strict=True):
                    velocity = velocity_of(head, context, one.state, one.embodiment_id)
                    chunk = integrate(velocity, one.noise, "euler", times)[..., : head.config.action_dim]
                    errors.append(np.abs(self.source.comparable(chunk) - aim).mean())
                return float(np.mean(errors))

            values = list(best_times(error, int(cell.key[2]))[1:-1])
        what, number, _ = cell.key[1:]
        return [
            {"part": CALIBRATE, "task": what, "seed": number, "index": index, "value": value}
            for index, value in enumerate(values)
        ]


def calibration_of(table: pd.DataFrame) -> Calibration:
    """Out of the study's table."""
    rows = table[table["part"] == CALIBRATE]
    times = rows[rows["task"] == "times"].groupby("seed")["value"]
    mass = rows[rows["task"] == "mass"].sort_values("index")["value"]
    return Calibration(
        tuple((0.0, *(float(value) for value in found), 1.0) for _, found in times),
        tuple(float(value) for value in mass),
    )


@dataclass(frozen=True)
class Work:
    """A cell of any part but the calibration.

    Attributes:
        source: Of observations and checkpoint.
        calibration: What calibrated modes take.
        timed: The modes that are timed side by side.
    """

    source: Source
    calibration: Calibration
    timed: tuple[Mode, ...]

    def __call__(self, cell: Cell) -> Rows:
        """Rows with the cell's part, task, seed and mode."""
        part, task, seed, name = str(cell.key[0]), str(cell.key[1]), int(cell.key[2]), str(cell.key[3])
        if part == TIME:
            measured = self.time_full() if task == FULL else self.time_own()
            return [{"part": part, "task": task, "seed": seed, **row} for row in measured]
        mode = Mode.parse(name)
        row = {"part": part, "task": task, "seed": seed, "mode": name}
        if part == EPISODES:
            return [row | self.episode(task, seed, mode)]
        return [row | self.chunks(task, seed, mode)]

    def episode(self, task: str, seed: int, mode: Mode) -> dict[str, Any]:
        """One episode in closed loop."""
        assert isinstance(self.source, Simulated)
        policy = policy_in(self.source.checkpoint, mode, self.calibration)
        episode = run_episode(environment_of(self.source.checkpoint, task), policy, seed)
        return {"success": episode.success, "steps": episode.steps, "chunks": episode.chunks}

    def chunks(self, task: str, seed: int, mode: Mode) -> dict[str, Any]:
        """How far the mode's chunks are from those of the baseline, and from those of many steps."""
        head = self.source.head(mode.precision)
        changes, errors, scales = [], [], []
        for known in compared(self.source, task, seed):
            one = known.given
            context = encode(head, mode, self.calibration, one.features, one.removed)
            found = sample(head, mode, self.calibration, context, one.state, one.embodiment_id, one.noise)
            chunk = self.source.comparable(found)
            changes.append(np.abs(chunk - known.chunk))
            errors.append(np.abs(chunk - known.exact))
            if known.other is not None:
                scales.append(np.abs(known.other - known.chunk).mean())
        return {
            "episode": self.source.episode_of(seed),
            "looks": len(changes),
            "chunk_change": float(np.mean(changes)),
            "chunk_change_max": float(np.max(changes)),
            "chunk_error": float(np.mean(errors)),
            "noise_change": float(np.mean(scales)) if scales else None,
        }

    def time_own(self) -> Rows:
        """The checkpoint's own head, on one of the observations."""
        source = self.source
        one = calibration_looks(source)[0] if isinstance(source, Simulated) else source.looks("", 0)[0]
        loaded = {
            precision: source.head(precision)
            for precision in dict.fromkeys(mode.precision for mode in self.timed)
        }
        return times_of(self.timed, loaded, self.calibration, one)

    def time_full(self) -> Rows:
        """A head of N1.5's size with random weights. Which tokens are dropped does not matter to the time."""
        with tempfile.TemporaryDirectory() as name:
            heads.write(Path(name), heads.sized(FULL))
            loaded = {
                precision: ActionHead.load(name, precision=precision)
                for precision in dict.fromkeys(mode.precision for mode in self.timed)
            }
        config = next(iter(loaded.values())).config
        rng = np.random.default_rng(0)

        def normal(*shape: int) -> Float32Array:
            return rng.standard_normal(shape, dtype=np.float32)

        one = Given(
            normal(1, FULL_TOKENS, config.context_dim),
            normal(1, config.state_dim),
            0,
            normal(1, config.action_horizon, config.encoder_action_dim),
            None,
            None,
        )
        mass = Calibration(self.calibration.times, tuple(rng.random(FULL_TOKENS)))
        return times_of(self.timed, loaded, mass, one)


@functools.lru_cache(maxsize=64)
def policy_in(checkpoint: str, mode: Mode, calibration: Calibration) -> Policy:
    """The policy with its head in a mode; one for each mode of a study is kept, the weights are shared."""
    policy = policy_of(checkpoint)
    return Policy(
        policy.config, policy.backbone, ModeEngine(checkpoint, mode, calibration), policy.checkpoint
    )


@dataclass(frozen=True)
class Compared:
    """A look, and what its chunks are compared with.

    Attributes:
        given: What the head is given.
        chunk: Of the baseline, comparable actions `(1, horizon, action_dim)`.
        exact: Of many steps.
        other: Of the baseline with the other noise; None if there is none.
    """

    given: Given
    chunk: Float32Array
    exact: Float32Array
    other: Float32Array | None


@functools.lru_cache(maxsize=1)
def compared(source: Source, task: str, seed: int) -> list[Compared]:
    """The looks of an episode, or an observation of a file; kept for the next mode."""
    mode, head = Mode.parse(BASELINE), source.head("float32")
    found = []
    for one in source.looks(task, seed):
        context = head.encode(one.features, drop_vl=one.removed)

        def chunk(noise: Float32Array, one: Given = one, context: Context = context) -> Float32Array:
            actions = sample(head, mode, Calibration(), context, one.state, one.embodiment_id, noise)
            return source.comparable(actions)

        exact = source.comparable(many_steps(head, context, one.state, one.embodiment_id, one.noise))
        other = None if one.other_noise is None else chunk(one.other_noise)
        found.append(Compared(one, chunk(one.noise), exact, other))
    return found


def times_of(
    modes: Sequence[Mode], loaded: Mapping[str, ActionHead], calibration: Calibration, one: Given
) -> Rows:
    """Milliseconds of `encode` and `sample` in each mode, round by round, in another order in each.

    Returns:
        A row for each mode: medians over the rounds, and the quartiles of both together.
    """

    def timed(mode: Mode) -> tuple[float, float]:
        head = loaded[mode.precision]
        start = time.perf_counter()
        context = encode(head, mode, calibration, one.features, one.removed)
        encoded = time.perf_counter()
        sample(head, mode, calibration, context, one.state, one.embodiment_id, one.noise)
        return 1e3 * (encoded - start), 1e3 * (time.perf_counter() - encoded)

    for mode in modes:
        timed(mode)  # the first call of a size allocates
    spent: dict[Mode, list[tuple[float, float]]] = {mode: [] for mode in modes}
    rng, begin = np.random.default_rng(0), time.perf_counter()
    for number in range(MOST_ROUNDS):
        if number >= FEWEST_ROUNDS and (time.perf_counter() - begin) * (number + 1) / number > ROUNDS_SECONDS:
            break
        for place in rng.permutation(len(modes)):
            spent[modes[place]].append(timed(modes[place]))
    rows = []
    for mode, found in spent.items():
        each = np.array(found)
        low, middle, high = np.quantile(each.sum(axis=1), (0.25, 0.5, 0.75))
        rows.append(
            {
                "mode": mode.name,
                "encode_ms": float(np.median(each[:, 0])),
                "sample_ms": float(np.median(each[:, 1])),
                "chunk_ms": float(middle),
                "chunk_ms_low": float(low),
                "chunk_ms_high": float(high),
                "rounds": len(each),
                "num_threads": loaded[mode.precision].num_threads,
                "isa": loaded[mode.precision].isa,
                "num_vl_tokens": one.features.shape[1],
            }
        )
    return rows
