"""Studies of any checkpoint on a file of recorded backbone features, without a simulator.

The file is the one of `saccade attention --features`. There is no closed loop, so there is no success: what
is measured is by how much the chunk of actions changes, on equal observations and noise.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from saccade._files import sha256_of
from saccade.config import HeadConfig
from saccade.errors import InputError, ShapeError
from saccade.head import ActionHead, Context
from saccade.intervention import Intervention
from saccade.maps.inputs import as_mask, head_inputs, read_arrays
from saccade.maps.record import describe_checkpoint
from saccade.maps.record import learned_tokens as stored_tokens
from saccade.sim.policy import DEMO_CHECKPOINT, Float32Array
from saccade.study import figures
from saccade.study.arms import control_line, episode_rng
from saccade.study.cells import Cell, OnDone, Rows, run_cells
from saccade.study.section import Figure, Grid, Section, not_measured, number, too_few
from saccade.study.statistics import Estimate, bootstrap_ratio
from saccade.study.tables import Provenance

TASK = "features"  # stands in the tables where the simulator's task would
NOISES = 4  # drawn for each observation, if the file has none

NO_LOOP = f"Success: {not_measured('a file of features has no closed loop')}."
NOT_SHOWN = (
    "A changed chunk is not a failed task: whether it matters can be seen in closed loop only. The next look "
    "may correct what this chunk got wrong.",
    "Intervals are for observations like those of the file, with one set of weights.",
)


@dataclass(frozen=True)
class Recording:
    """A checkpoint and a file of features for it.

    Attributes:
        checkpoint: Whatever `ActionHead.load` reads.
        config: Path of its config, or None: it lies beside the weights.
        file: The features.
        seed: Of what is drawn: noise, if the file has none, and tokens.
        num_threads: Of the head; None is the engine's own choice.
    """

    checkpoint: str
    config: str | None
    file: str
    seed: int
    num_threads: int | None = None


@dataclass(frozen=True)
class Observation:
    """One row of the file as the head takes it.

    Attributes:
        features: `(1, T_vl, context_dim)`.
        state: `(1, state_dim)` or `(1, history, state_dim)`.
        embodiment_id: Of the robot.
        noise: `(1, draws, horizon, encoder_action_dim)`.
        drop_vl: `(1, T_vl)`, or None.
        episode: That it is of, counted from 0.
    """

    features: Float32Array
    state: Float32Array
    embodiment_id: int
    noise: Float32Array
    drop_vl: npt.NDArray[np.bool_] | None
    episode: int


@dataclass(frozen=True, eq=False)
class Observations:
    """All of a file, checked.

    Attributes:
        features, state, embodiment_ids, noise: as in `saccade.maps.inputs.HeadInputs`.
        drop_vl: `(batch, T_vl)`, or None.
        episodes: `(batch,)`, counted from 0; each observation its own if the file does not say.
        episodes_known: Whether it says.
        noise_shape: Of one draw.
    """

    features: npt.NDArray[Any]
    state: npt.NDArray[Any]
    embodiment_ids: npt.NDArray[np.int64]
    noise: npt.NDArray[Any] | None
    drop_vl: npt.NDArray[np.bool_] | None
    episodes: npt.NDArray[np.int64]
    episodes_known: bool
    noise_shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.features)

    def observation(self, row: int, seed: int) -> Observation:
        """One of them, with noise from the seed if the file has none."""
        if self.noise is None:
            draws = np.random.default_rng([seed, row])
            noise = draws.standard_normal((1, NOISES, *self.noise_shape), dtype=np.float32)
        else:
            noise = np.asarray(self.noise[None, row : row + 1], np.float32)
        return Observation(
            np.asarray(self.features[row : row + 1], np.float32),
            np.asarray(self.state[row : row + 1], np.float32),
            int(self.embodiment_ids[row]),
            noise,
            None if self.drop_vl is None else self.drop_vl[row : row + 1],
            int(self.episodes[row]),
        )

    def donor_of(self, row: int) -> int | None:
        """The next observation, going round, of another episode with the same embodiment, or None."""
        others = (np.arange(1, len(self)) + row) % len(self)
        fitting = (self.episodes[others] != self.episodes[row]) & (
            self.embodiment_ids[others] == self.embodiment_ids[row]
        )
        return int(others[fitting][0]) if fitting.any() else None


@functools.lru_cache(maxsize=1)
def observations_of(file: str, config: HeadConfig) -> Observations:
    """Reads a file of features for a head; kept for the next cell.

    Raises:
        FileNotFoundError: there is no such file.
        InputError, ShapeError: it does not fit the head, or holds NaN or infinity.
    """
    path = Path(file)
    arrays = read_arrays(path)
    given = head_inputs(path, arrays, config)
    batch, num_tokens, _ = given.features.shape
    for name, array in (
        ("backbone_features", given.features),
        ("state", given.state),
        ("noise", given.noise),
    ):
        for row in range(batch if array is not None else 0):  # row by row, since the file may be large
            if not np.isfinite(array[row]).all():  # type: ignore[index]
                raise InputError(f"{path}: {name}: NaN or infinity in row {row}, expected finite numbers")

    def mask(name: str) -> npt.NDArray[np.bool_] | None:
        found = as_mask(path, name, arrays.get(name))
        if found is not None and batch == 1 and found.ndim == 1:
            found = found[None]
        if found is not None and found.shape != (batch, num_tokens):
            raise ShapeError(f"{path}: {name}: shape {found.shape}, expected ({batch}, {num_tokens})")
        return found

    attended, drop_vl = mask("attention_mask"), mask("drop_vl")
    if attended is not None and not attended.all():
        raise InputError(
            f"{path}: attention_mask: false entries, but the released head reads padding like any other "
            "token; expected no attention_mask, or drop_vl, true where a position is to be removed"
        )
    if drop_vl is not None and drop_vl.all(axis=1).any():
        raise InputError(f"{path}: drop_vl: row {int(drop_vl.all(axis=1).argmax())} drops every position")
    episodes = np.arange(batch)
    if "episode" in arrays:
        named = np.atleast_1d(arrays["episode"])
        if named.dtype.kind not in "iu" or named.shape != (batch,):
            raise InputError(
                f"{path}: episode: {named.dtype} of shape {named.shape}, expected integers, ({batch},)"
            )
        episodes = np.unique(named, return_inverse=True)[1].reshape(-1)
    return Observations(
        given.features,
        given.state,
        given.embodiment_ids,
        given.noise,
        drop_vl,
        episodes,
        "episode" in arrays,
        (config.action_horizon, config.encoder_action_dim),
    )


def recording_of(args: argparse.Namespace, *refused: str) -> Recording:
    """From the arguments.

    Args:
        args: as `add_rollout_arguments` declares them.
        refused: names of options that mean nothing here, besides those of the episodes.

    Raises:
        InputError: one of those is given.
    """
    given = [name for name in ("tasks", "episodes", *refused) if getattr(args, name) is not None]
    if given:
        raise InputError(
            f"{', '.join(f'--{name}' for name in given)}: not with --features, whose observations are all "
            "measured as they are, without a simulator"
        )
    if args.seed < 0:
        raise InputError(f"--seed: given {args.seed}, expected at least 0")
    return Recording(
        checkpoint=str(args.checkpoint or DEMO_CHECKPOINT),
        config=None if args.config is None else str(args.config),
        file=str(args.features),
        seed=args.seed,
        # The bits do not depend on it. One process may use all cores; several share them.
        num_threads=None if args.jobs == 1 else 1,
    )


@functools.lru_cache(maxsize=1)
def head_of(recording: Recording) -> ActionHead:
    """The head; loaded once in a process."""
    return ActionHead.load(recording.checkpoint, config=recording.config, num_threads=recording.num_threads)


@functools.lru_cache(maxsize=1)
def learned_tokens(recording: Recording) -> Float32Array:
    """The checkpoint's future tokens, `(N, width)`; N is 0 where it has none."""
    config = head_of(recording).config
    if not config.num_future_tokens:
        return np.zeros((0, config.width), np.float32)
    return stored_tokens(Path(recording.checkpoint))


def describe(recording: Recording, config: HeadConfig) -> dict[str, Any]:
    """What a study's settings say of checkpoint and file."""
    found = observations_of(recording.file, config)
    checkpoint = describe_checkpoint(Path(recording.checkpoint))
    if recording.config is not None:
        checkpoint["config_sha256"] = sha256_of(Path(recording.config))
    return {
        "checkpoint": {
            **checkpoint,
            "num_future_tokens": config.num_future_tokens,
            "num_layers": config.num_layers,
            "num_steps": config.num_steps,
            "num_vl_tokens": found.features.shape[1],
        },
        "features": {
            "name": Path(recording.file).name,
            "sha256": sha256_of(Path(recording.file)),
            "observations": len(found),
            "episodes": int(found.episodes.max()) + 1 if found.episodes_known else None,
            "noise": "of the file" if found.noise is not None else f"{NOISES} draws an observation",
        },
        "seed": recording.seed,
    }


def head_and_observations(recording: Recording) -> tuple[ActionHead, Observations]:
    """Both, loaded and checked."""
    head = head_of(recording)
    return head, observations_of(recording.file, head.config)


def encode(head: ActionHead, observation: Observation) -> Context:
    """What the head makes of an observation's features."""
    return head.encode(observation.features, drop_vl=observation.drop_vl)


@functools.lru_cache(maxsize=1)
def unchanged(recording: Recording, row: int) -> tuple[Observation, Context, Float32Array]:
    """An observation, encoded, and the head's chunks for it; kept for the next arm."""
    head, found = head_and_observations(recording)
    observation = found.observation(row, recording.seed)
    context = encode(head, observation)
    return observation, context, chunks(head, observation, context, None)


def chunks(
    head: ActionHead, observation: Observation, context: Context, intervention: Intervention | None
) -> Float32Array:
    """The head's own, normalised actions for each noise, `(draws, horizon, action_dim)`."""
    found = head.sample(
        context,
        observation.state,
        observation.embodiment_id,
        noise=observation.noise,
        num_samples=observation.noise.shape[1],
        intervention=intervention,
    )
    normalised: Float32Array = np.asarray(found)[0]
    return normalised


@dataclass(frozen=True)
class Changes:
    """A study that asks by how much the chunk changes under each of several arms.

    Attributes:
        study: Names the table.
        baseline: The arm in which nothing is changed.
        control: The arm that must change nothing but rounding.
        intervention: What an arm does to learned tokens `(N, width)`, with random numbers.
        why_not: Why an arm cannot be measured on a head with N future tokens, or None.
    """

    study: str
    baseline: str
    control: str
    intervention: Callable[[str, Float32Array, np.random.Generator], Intervention | None]
    why_not: Callable[[str, int], str | None]

    def run(
        self,
        recording: Recording,
        arms: Sequence[str],
        out: Path,
        *,
        backend: str,
        jobs: int,
        on_done: OnDone,
    ) -> None:
        """A cell is an observation with one arm; those of one observation lie side by side."""
        head, found = head_and_observations(recording)
        run_cells(
            self.study,
            [
                Cell((TASK, row, arm))
                for row in range(len(found))
                for arm in dict.fromkeys((self.baseline, *arms))
            ],
            ChangeWork(self, recording),
            out,
            settings=describe(recording, head.config),
            backend=backend,
            jobs=jobs,
            on_done=on_done,
        )


@dataclass(frozen=True)
class ChangeWork:
    """Measures by how much an arm changes the chunk on one observation."""

    changes: Changes
    recording: Recording

    def __call__(self, cell: Cell) -> Rows:
        """A row, or a note why it cannot be measured."""
        row, arm = int(cell.key[1]), str(cell.key[2])
        tokens = learned_tokens(self.recording)
        observation, context, before = unchanged(self.recording, row)
        found: dict[str, Any] = {
            "task": TASK,
            "seed": row,
            "arm": arm,
            "episode": observation.episode,
            "success": None,
            "chunk_change": None,
            "chunk_change_max": None,
            "noise_change": None,
            "note": self.changes.why_not(arm, len(tokens)),
        }
        if found["note"] is not None:
            return [found]
        rng = episode_rng(f"{TASK} {self.recording.seed}", observation.episode)
        intervention = self.changes.intervention(arm, tokens, rng)
        after = before
        if intervention is not None:
            after = chunks(head_of(self.recording), observation, context, intervention)
        change = np.abs(after - before)
        found |= {"chunk_change": float(change.mean()), "chunk_change_max": float(change.max())}
        found["noise_change"] = between_draws(before)
        return [found]


def between_draws(drawn: Float32Array) -> float | None:
    """The mean |difference| of an action between two chunks of one observation from other noise."""
    if len(drawn) < 2:
        return None
    one, two = np.triu_indices(len(drawn), k=1)
    return float(np.abs(drawn[one] - drawn[two]).mean())


@dataclass(frozen=True)
class ArmChange:
    """What the table says of one arm.

    Attributes:
        observations: So many.
        change: Of the chunk; None if it was not measured.
        ratio: The same over what another noise changes; None where noise was not drawn.
        largest: The largest change of one action.
        note: Why it was not measured.
    """

    observations: int
    change: Estimate | None
    ratio: Estimate | None
    largest: float
    note: str | None


def clusters_of(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    """Of each row what it stands and falls with: its episode, in a table of the simulator the seed."""
    return list(zip(table["task"], table["episode" if "episode" in table else "seed"], strict=True))


def arm_changes(table: pd.DataFrame, arms: Sequence[str]) -> dict[str, ArmChange]:
    """Of those arms that the table has, in that order."""
    found = {}
    for arm in arms:
        rows = table[table["arm"] == arm]
        measured = rows[rows["chunk_change"].notna()]
        if not len(rows):
            continue
        if not len(measured):
            found[arm] = ArmChange(0, None, None, np.nan, str(rows["note"].iloc[0]))
            continue
        clusters, values = clusters_of(measured), measured["chunk_change"].to_numpy(dtype=float)
        scale = measured["noise_change"].to_numpy(dtype=float)
        found[arm] = ArmChange(
            len(measured),
            bootstrap_ratio(values, np.ones_like(values), clusters),
            None if np.isnan(scale).any() or not scale.any() else bootstrap_ratio(values, scale, clusters),
            float(measured["chunk_change_max"].max()),
            None,
        )
    return found


def change_section(
    changes: Changes,
    title: str,
    labels: Mapping[str, str],
    about: Sequence[str],
    not_shown: Sequence[str],
    table: pd.DataFrame,
    provenance: Provenance,
) -> Section:
    """The section of a study of changes.

    Args:
        changes: the study.
        title: of the section.
        labels: of the arms, in their order; those that the table has not are passed over.
        about: paragraphs on the arms.
        not_shown: what the study cannot show besides `NOT_SHOWN`.
        table, provenance: of the study.
    """
    found = arm_changes(table, [arm for arm in labels if arm != changes.baseline])
    measured = {labels[arm]: one.change for arm, one in found.items() if one.change is not None}
    pictures = []
    if measured:
        picture = figures.estimates(
            list(measured), list(measured.values()), "mean |change of an action|", reference=0.0
        )
        caption = "Change of the chunk on equal observations and noise, with a 95 % bootstrap interval."
        pictures.append(Figure("change", caption, picture))
    rows, concluded = [], []
    for arm, one in found.items():
        if one.change is None:
            rows.append([labels[arm], not_measured(str(one.note)), "", ""])
            concluded.append(f"{labels[arm]}: {not_measured(str(one.note))}.")
            continue
        ratio = "" if one.ratio is None else number(one.ratio, digits=2)
        rows.append([labels[arm], str(one.observations), number(one.change, digits=4), ratio])
        if arm == changes.control:
            concluded.append(control_line(labels[arm], one.largest))
            continue
        beside = f", {ratio} times what another noise changes" if ratio else ""
        concluded.append(
            f"{labels[arm]}: actions change by {number(one.change, digits=3)} on average{beside}."
        )
    columns = ("arm", "observations", "change of the chunk", "over another noise's")
    return Section(
        title=f"{title}, from a file of features",
        summary=[
            *summary(table, provenance),
            "Change of the chunk: mean over its actions of |change|, with equal noise in every arm, and "
            "beside it the same over what another noise changes (not known where the file brings its noise).",
            *about,
        ],
        figures=pictures,
        grids=[Grid("By arm, with 95 % intervals.", columns, rows)] if rows else [],
        concluded=[*concluded, NO_LOOP, *cautions(table[table["chunk_change"].notna()], provenance)],
        not_shown=(*not_shown, *NOT_SHOWN),
    )


def from_file(provenance: Provenance) -> bool:
    """Whether a table was measured on a file of features."""
    return "features" in provenance.settings


def summary(table: pd.DataFrame, provenance: Provenance) -> list[str]:
    """On what it was measured."""
    checkpoint, features = provenance.settings["checkpoint"], provenance.settings["features"]
    observations = table["seed"].nunique()
    episodes = f" of {table['episode'].nunique()} episodes" if features["episodes"] is not None else ""
    return [
        f"From a file of features, {features['name']} (SHA-256 {features['sha256'][:12]}): {observations} "
        f"observations{episodes}, {checkpoint['num_vl_tokens']} vision-language tokens each; noise: "
        f"{features['noise']}. Checkpoint {checkpoint['name']} (SHA-256 {checkpoint['sha256'][:12]}), N = "
        f"{checkpoint['num_future_tokens']} future tokens, {checkpoint['num_layers']} blocks, "
        f"{checkpoint['num_steps']} Euler steps. Actions are the head's own, normalised; all of the config's "
        "action dimensions count, also those that a robot leaves unused. Intervals are drawn by "
        f"{'episode' if episodes else 'observation'}.",
    ]


def cautions(table: pd.DataFrame, provenance: Provenance) -> list[str]:
    """What is to be known of the intervals; nothing where nothing was measured."""
    if table.empty:
        return []
    lines = []
    if provenance.settings["features"]["episodes"] is None:
        lines.append(
            "The file does not say of which episode an observation is, so each counts by itself. If several "
            "are of one episode, the intervals are too narrow; an array named episode mends that."
        )
    return lines + too_few(table["episode"].nunique(), "independent observations or episodes")
