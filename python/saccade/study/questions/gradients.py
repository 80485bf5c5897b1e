"""`saccade study gradients`: the derivatives of the actions, and how much of them runs through future tokens.

Backward through `saccade.reference`, on what the policy saw in closed loop. Two questions: how much would the
actions (and the loss on demonstrations) change if a row changed by its own length, and along which paths does
the derivative of the actions by the vision-language tokens come about.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from saccade.errors import InputError
from saccade.intervention import ROW_GROUPS
from saccade.reference import ActionHead
from saccade.sim import demos
from saccade.sim.dataset import chunks
from saccade.sim.policy import EMBODIMENT_ID
from saccade.sim.tasks import find_task
from saccade.study import figures
from saccade.study.arms import NO_TOKENS
from saccade.study.cells import Cell, OnDone, Rows, run_cells
from saccade.study.features import (
    TASK,
    Recording,
    cautions,
    clusters_of,
    describe,
    from_file,
    observations_of,
    recording_of,
)
from saccade.study.features import summary as file_summary
from saccade.study.loaded import describe_checkpoint, environment_of, policy_of
from saccade.study.observations import Rollouts, add_rollout_arguments, record_looks, rollouts_of
from saccade.study.section import Figure, Grid, Section, not_measured, number
from saccade.study.statistics import Estimate, bootstrap
from saccade.study.tables import Provenance

STUDY = "gradients"

# Paths from the vision-language tokens to the actions, over all Euler steps. Each path is in exactly one of
# these, so their derivatives add up to the whole.
DIRECT = "direct"  # by state and action rows alone: it never leaves a future row
READ = "read by future rows"  # it enters the rows where a future row reads the tokens
DETOUR = "detour"  # it enters where a state or action row reads the tokens, and passes a future row later
PATHS = (DIRECT, READ, DETOUR)
ALL_PATHS = "all"

EPILOG = """\
Runs the policy in closed loop and takes derivatives of its chunks in torch: by the rows before and after
every block, and by the vision-language tokens, split by the paths along which they come about. With --demos
also the derivative of the training loss by the rows.

examples:
  saccade study gradients --out out/study
  saccade study gradients --checkpoint out/policy --demos out/demos --tasks push --out out/study
  saccade study gradients --checkpoint checkpoint/ --features looks.npz --out out/study
"""

LEAVING_FUTURE = (("state", "future"), ("action", "future"))
READ_BY_OTHERS = (("state", "vl"), ("action", "vl"))


@dataclass(frozen=True)
class Conditions:
    """What else a chunk depends on.

    Attributes:
        embodiment_id: Of the robot.
        drop_vl: Which tokens are removed, `(1, T_vl)`, or None.
    """

    embodiment_id: int = EMBODIMENT_ID
    drop_vl: Tensor | None = None

    def of(self, count: int) -> dict[str, Any]:
        """Arguments of `sample` for so many copies of one observation."""
        dropped = None if self.drop_vl is None else self.drop_vl.expand(count, -1)
        return {"embodiment_id": self.embodiment_id, "drop_vl": dropped}


SIMULATOR = Conditions()


def path_derivatives(
    head: ActionHead,
    vl_embs: Tensor,
    state: Tensor,
    noise: Tensor,
    cotangents: Tensor,
    conditions: Conditions = SIMULATOR,
) -> dict[str, Tensor]:
    """Derivatives of projections of the actions by the vision-language tokens, path by path.

    Args:
        head: computes, in its dtype.
        vl_embs: of one observation, `(1, T_vl, context_dim)`.
        state: `(1, state_dim)` or `(1, history, state_dim)`.
        noise: `(1, T, action_dim)`.
        cotangents: `(projections, T, action_dim)`; each is multiplied with the actions and summed up.
        conditions: what else the actions depend on.

    Returns:
        Each path of `PATHS` and their sum `ALL_PATHS`, `(projections, T_vl, context_dim)`.
    """
    count = len(cotangents)

    def derivative(stopped: Sequence[tuple[str, str]]) -> Tensor:
        leaf = vl_embs.detach().repeat(count, 1, 1).requires_grad_()
        actions = head.sample(
            leaf,
            state.expand(count, *state.shape[1:]),
            noise=noise.expand(count, -1, -1),
            stop_gradient=stopped,
            **conditions.of(count),
        )
        # Elements of a batch do not mix: each copy of the tokens gets the derivative of its own projection.
        return torch.autograd.grad((actions * cotangents).sum(), leaf)[0]

    whole, direct, read = derivative(()), derivative(LEAVING_FUTURE), derivative(READ_BY_OTHERS)
    return {DIRECT: direct, READ: read, DETOUR: whole - direct - read, ALL_PATHS: whole}


@dataclass(frozen=True)
class Shares:
    """How paths make up a derivative.

    Attributes:
        length: Of each path, its Frobenius norm over that of the whole. Lengths do not add up.
        share: Of each path, how far it goes along the whole. Shares add up to 1; one may be negative.
        cosine: Between two paths, NaN where one is zero.
    """

    length: dict[str, float]
    share: dict[str, float]
    cosine: dict[tuple[str, str], float]


def shares(parts: Mapping[str, Tensor]) -> Shares:
    """From what `path_derivatives` returned.

    With independent standard normal cotangents, the mean product of two projected derivatives is the
    Frobenius product of the two.
    """

    def product(one: str, two: str) -> float:
        return float((parts[one] * parts[two]).sum())

    length = {name: math.sqrt(product(name, name)) for name in parts}

    def cosine(one: str, two: str) -> float:
        scale = length[one] * length[two]
        return product(one, two) / scale if scale > 0 else math.nan

    return Shares(
        length={name: length[name] / length[ALL_PATHS] for name in PATHS},
        share={name: product(name, ALL_PATHS) / length[ALL_PATHS] ** 2 for name in PATHS},
        cosine={pair: cosine(*pair) for pair in itertools.combinations(PATHS, 2)},
    )


class Nudges:
    """Zeros that are added to the rows of every block, to take derivatives by the rows.

    One nudge counts at every Euler step, as a change of a learned token does.

    Args:
        head: whose rows.
        batch: elements of the batch to come.
    """

    def __init__(self, head: ActionHead, batch: int) -> None:
        config = head.config
        rows = 1 + config.num_future_tokens + config.action_horizon
        self._blocks = list(head.model.transformer_blocks)
        self._zeros = [
            torch.zeros(batch, rows, config.width, dtype=head.dtype, requires_grad=True)
            for _ in range(len(self._blocks) + 1)
        ]  # before the first block, then after each
        self._squares = [torch.zeros(batch, rows, dtype=head.dtype) for _ in self._zeros]
        self._steps = 0

    @contextlib.contextmanager
    def applied(self) -> Iterator[None]:
        """Adds them to all that the head computes inside."""

        def nudge(place: int, rows: Tensor) -> Tensor:
            self._squares[place] += rows.detach().square().sum(dim=-1)
            return rows + self._zeros[place]

        def before(block: Any, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
            self._steps += 1
            return (nudge(0, inputs[0]), *inputs[1:])

        def after(place: int, block: Any, inputs: Any, rows: Tensor) -> Tensor:
            return nudge(place, rows)

        handles = [self._blocks[0].register_forward_pre_hook(before)]
        for place, block in enumerate(self._blocks, start=1):
            handles.append(block.register_forward_hook(functools.partial(after, place)))
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    def derivatives(self, scalar: Tensor) -> list[Tensor]:
        """Of a scalar computed inside `applied`, by place: `(batch, rows, width)`."""
        return list(torch.autograd.grad(scalar, self._zeros))

    def lengths(self) -> list[Tensor]:
        """Of the rows, by place: root of the mean square over batch and steps, `(rows,)`."""
        return [(square.mean(dim=0) / self._steps).sqrt() for square in self._squares]


def action_sensitivity(
    head: ActionHead,
    vl_embs: Tensor,
    state: Tensor,
    noise: Tensor,
    cotangents: Tensor,
    conditions: Conditions = SIMULATOR,
) -> list[tuple[Tensor, Tensor]]:
    """How the sampled actions depend on the rows before the first block and after each.

    Arguments as in `path_derivatives`.

    Returns:
        By place, `(rows,)` each: the Frobenius norm of the derivative by each row, and the same times the
        row's length, which is the change if the row changed by its length. Every block normalises what it
        reads, so the norm alone says as much about how long a row is as about how it is used.
    """
    count = len(cotangents)
    nudges = Nudges(head, count)
    with nudges.applied():
        actions = head.sample(
            vl_embs.expand(count, -1, -1),
            state.expand(count, *state.shape[1:]),
            noise=noise.expand(count, -1, -1),
            **conditions.of(count),
        )
    found = nudges.derivatives((actions * cotangents).sum())
    norms = [derivative.square().sum(dim=-1).mean(dim=0).sqrt() for derivative in found]  # (rows,) each
    return [(norm, norm * length) for norm, length in zip(norms, nudges.lengths(), strict=True)]


def loss_sensitivity(
    head: ActionHead,
    features: Tensor,
    state: Tensor,
    actions: Tensor,
    mask: Tensor,
    generator: torch.Generator,
    draws: int,
) -> list[tuple[Tensor, Tensor]]:
    """How the flow-matching loss at one observation depends on the rows, its mean over times and noises.

    Args:
        head: computes, in its dtype.
        features: backbone features, `(1, T_vl, context_dim)`.
        state: `(1, state_dim)`.
        actions: the demonstrated chunk, `(1, T, action_dim)`, normalised.
        mask: which of them count, `(1, T, 1)`.
        generator, draws: of times and noises, and how many.

    Returns:
        As `action_sensitivity`, of the loss.
    """
    nudges = Nudges(head, draws)
    with nudges.applied():
        loss = head.loss(
            features.expand(draws, -1, -1),
            state.expand(draws, -1),
            EMBODIMENT_ID,
            actions.expand(draws, -1, -1),
            noise=torch.randn(draws, *actions.shape[1:], generator=generator, dtype=head.dtype),
            time=head.sample_time(draws, generator),
            action_mask=mask,
        )
    norms = [derivative.sum(dim=0).norm(dim=-1) for derivative in nudges.derivatives(loss)]
    return [(norm, norm * length) for norm, length in zip(norms, nudges.lengths(), strict=True)]


def sensitivity_rows(measured: Sequence[Sequence[tuple[Tensor, Tensor]]], rows: Mapping[str, slice]) -> Rows:
    """The mean over several observations, by block and group, and for learned tokens one by one.

    Args:
        measured: of each observation what `action_sensitivity` or `loss_sensitivity` returned.
        rows: where the groups lie.
    """
    found: Rows = []
    for place, pairs in enumerate(zip(*measured, strict=True)):
        norm = torch.stack([norm for norm, _ in pairs])  # (observations, rows)
        relative = torch.stack([relative for _, relative in pairs])
        for group in ROW_GROUPS:
            here = {"norm": norm[:, rows[group]], "relative": relative[:, rows[group]]}
            if not here["norm"].shape[1]:
                continue
            means = {name: float(values.square().mean(dim=1).sqrt().mean()) for name, values in here.items()}
            found.append({"block": place - 1, "group": group, **means})
            if group == "future" and place == 0:
                for token in range(here["norm"].shape[1]):
                    means = {name: float(values[:, token].mean()) for name, values in here.items()}
                    found.append({"block": -1, "group": group, "token": token, **means})
    return found


def path_rows(measured: Sequence[Shares]) -> Rows:
    """The mean over several observations, by path and pair of paths."""
    found: Rows = []
    for path in PATHS:
        lengths, parts = ([getattr(one, name)[path] for one in measured] for name in ("length", "share"))
        found.append({"path": path, "length": float(np.mean(lengths)), "share": float(np.mean(parts))})
    for one, two in itertools.combinations(PATHS, 2):
        cosines = [shares.cosine[one, two] for shares in measured]
        found.append({"path": one, "other_path": two, "cosine": float(np.mean(cosines))})
    return found


def spaced(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` places, evenly spaced, the first among them.

    Example:
        >>> spaced(9, 3), spaced(2, 3)
        ([0, 3, 6], [0, 1])
    """
    return [place * count // wanted for place in range(wanted)] if count > wanted else list(range(count))


@dataclass(frozen=True)
class Settings:
    """What to measure.

    Attributes:
        rollouts: Whose episodes.
        looks: Observations taken from each episode, evenly spaced.
        projections: Random projections of the actions, or draws of time and noise for the loss.
        demonstrations: Directory of `saccade demos` for the loss, or None: it is then not measured.
    """

    rollouts: Rollouts
    looks: int = 3
    projections: int = 16
    demonstrations: str | None = None


@dataclass(frozen=True)
class FileSettings:
    """What to measure on a file of features; attributes as in `Settings`."""

    recording: Recording
    projections: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    add_rollout_arguments(parser, episodes=10)
    parser.add_argument("--looks", type=int, help="observations of each episode, evenly spaced (default: 3)")
    parser.add_argument(
        "--projections",
        type=int,
        default=16,
        help="random projections of the actions, and draws of time and noise for the loss (default: 16)",
    )
    parser.add_argument(
        "--demos", type=Path, metavar="DIR", help="demonstrations for the loss (default: it is not measured)"
    )


def settings(args: argparse.Namespace) -> Settings | FileSettings:
    """The settings, checked."""
    looks = Settings.looks if args.looks is None else args.looks
    for name, given in (("looks", looks), ("projections", args.projections)):
        if given < 1:
            raise InputError(f"{name}: given {given}, expected at least 1")
    if args.features is not None:
        recording = recording_of(args, "looks", "demos")
        observations_of(recording.file, recorded_head(recording).config)
        return FileSettings(recording, args.projections)
    rollouts = rollouts_of(args)
    if args.demos is not None:
        check_demonstrations(args.demos, rollouts)
    demonstrations = None if args.demos is None else str(args.demos)
    return Settings(rollouts, looks, args.projections, demonstrations)


def check_demonstrations(directory: Path, rollouts: Rollouts) -> None:
    """Raises `InputError` unless there are demonstrations that look like what the policy sees."""
    recorded = demos.recorded_tasks(directory)
    missing = [task for task in rollouts.tasks if task not in recorded]
    if missing:
        raise InputError(f"demos: {directory} has none of {', '.join(missing)}")
    recording = demos.read_settings(directory, list(rollouts.tasks))
    config = policy_of(rollouts.checkpoint).config
    given, expected = (recording.image_size, recording.cameras), (config.backbone.image_size, config.cameras)
    if given != expected:
        raise InputError(
            f"demos: {directory} was recorded with another image size or other cameras than the policy's"
        )


@functools.lru_cache(maxsize=1)
def reference_of(checkpoint: str) -> ActionHead:
    """The head in torch, on one thread, without gradients for its weights."""
    torch.set_num_threads(1)
    head = ActionHead.load(checkpoint)
    head.requires_grad_(False)
    return head


@functools.lru_cache(maxsize=1)
def recorded_head(recording: Recording) -> ActionHead:
    """The same of a recording, on as many threads as it says."""
    if recording.num_threads is not None:
        torch.set_num_threads(recording.num_threads)
    head = ActionHead.load(recording.checkpoint, config=recording.config)
    head.requires_grad_(False)
    return head


def row_groups(head: ActionHead) -> dict[str, slice]:
    """Where the groups of rows lie."""
    future = head.config.num_future_tokens
    return {"state": slice(0, 1), "future": slice(1, 1 + future), "action": slice(1 + future, None)}


@dataclass(frozen=True)
class FileWork:
    """The actions on one observation of a file."""

    settings: FileSettings

    def __call__(self, cell: Cell) -> Rows:
        """The rows of a cell: a kind, a task and the row of the file."""
        kind, task, place = str(cell.key[0]), str(cell.key[1]), int(cell.key[2])
        recording = self.settings.recording
        head = recorded_head(recording)
        observation = observations_of(recording.file, head.config).observation(place, recording.seed)
        dropped = None if observation.drop_vl is None else torch.from_numpy(observation.drop_vl)
        conditions = Conditions(observation.embodiment_id, dropped)
        inputs = (
            head.encode(observation.features, drop_vl=dropped),
            head.as_input(observation.state),
            head.as_input(observation.noise[:, 0]),
        )
        generator = torch.Generator().manual_seed(
            int(np.random.default_rng((recording.seed, place)).integers(2**31))
        )
        shape = (self.settings.projections, head.config.action_horizon, head.config.action_dim)
        cotangents = torch.randn(shape, generator=generator)
        # One by one: the graph of a head of full size takes a gigabyte for each.
        sensitivities, paths = [], []
        for cotangent in cotangents.split(1):
            sensitivities.append(action_sensitivity(head, *inputs, cotangent, conditions))
            if head.config.num_future_tokens:
                paths.append(path_derivatives(head, *inputs, cotangent, conditions))
        rows = sensitivity_rows([pooled(sensitivities)], row_groups(head))
        if paths:
            rows += path_rows([shares({name: torch.cat([one[name] for one in paths]) for name in paths[0]})])
        else:
            rows.append({"note": NO_TOKENS})
        episode = {"of": kind, "task": task, "seed": place, "episode": observation.episode}
        return [{**episode, **row} for row in rows]


def pooled(measured: Sequence[Sequence[tuple[Tensor, Tensor]]]) -> list[tuple[Tensor, Tensor]]:
    """What `action_sensitivity` says of several projections, from what it says of each."""

    def pool(values: Sequence[Tensor]) -> Tensor:
        return torch.stack(list(values)).square().mean(dim=0).sqrt()

    return [
        (pool([norm for norm, _ in pairs]), pool([relative for _, relative in pairs]))
        for pairs in zip(*measured, strict=True)
    ]


@dataclass(frozen=True)
class Work:
    """Two kinds of cells: the actions in an episode in closed loop, and the loss on a demonstration."""

    settings: Settings

    def __call__(self, cell: Cell) -> Rows:
        """The rows of a cell: a kind, a task and a seed."""
        kind, task, seed = str(cell.key[0]), str(cell.key[1]), int(cell.key[2])
        head = reference_of(self.settings.rollouts.checkpoint)
        groups = row_groups(head)
        generator = torch.Generator().manual_seed(
            int(np.random.default_rng((seed, *map(ord, task))).integers(2**31))
        )
        measure = self.of_actions if kind == "actions" else self.of_loss
        return [
            {"of": kind, "task": task, "seed": seed, **row}
            for row in measure(head, task, seed, groups, generator)
        ]

    def of_actions(
        self, head: ActionHead, task: str, seed: int, groups: Mapping[str, slice], generator: torch.Generator
    ) -> Rows:
        """An episode in closed loop."""
        checkpoint = self.settings.rollouts.checkpoint
        _, looks = record_looks(environment_of(checkpoint, task), policy_of(checkpoint), seed)
        sensitivities, paths = [], []
        for place in spaced(len(looks), self.settings.looks):
            look = looks[place]
            vl_embs, state, noise = (
                head.encode(look.features),
                head.as_input(look.state),
                head.as_input(look.noise),
            )
            cotangents = torch.randn(self.settings.projections, *noise.shape[1:], generator=generator)
            sensitivities.append(action_sensitivity(head, vl_embs, state, noise, cotangents))
            if head.config.num_future_tokens:
                paths.append(shares(path_derivatives(head, vl_embs, state, noise, cotangents)))
        rows = sensitivity_rows(sensitivities, groups)
        return rows + (path_rows(paths) if paths else [{"note": NO_TOKENS}])

    def of_loss(
        self, head: ActionHead, task: str, seed: int, groups: Mapping[str, slice], generator: torch.Generator
    ) -> Rows:
        """A demonstration."""
        assert self.settings.demonstrations is not None
        policy = policy_of(self.settings.rollouts.checkpoint)
        demonstration = demos.load(Path(self.settings.demonstrations) / task / f"{seed}.npz")
        actions, mask = chunks(demonstration, policy.horizon)
        usable = np.flatnonzero(mask[..., 0].any(axis=1))
        measured = []
        for frame in usable[spaced(len(usable), self.settings.looks)]:
            observation = {
                "images": dict(
                    zip(
                        (camera.name for camera in policy.config.cameras),
                        demonstration.images[frame],
                        strict=True,
                    )
                ),
                "proprio": demonstration.proprio[frame],
                "instruction": find_task(task).instruction(seed),
            }
            measured.append(
                loss_sensitivity(
                    head,
                    head.as_input(policy.features(observation)),
                    head.as_input(policy.state(observation)),
                    head.as_input(policy.config.action.normalize(actions[frame]) * mask[frame])[None],
                    head.as_input(mask[frame])[None],
                    generator,
                    self.settings.projections,
                )
            )
        return sensitivity_rows(measured, groups)


def run(settings: Settings | FileSettings, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
    """Measures the actions in every episode, then the loss on as many demonstrations."""
    if isinstance(settings, FileSettings):
        run_on_file(settings, out, backend=backend, jobs=jobs, on_done=on_done)
        return
    rollouts = settings.rollouts
    common = {
        "checkpoint": describe_checkpoint(rollouts.checkpoint),
        "looks": settings.looks,
        "projections": settings.projections,
    }
    cells = [Cell(("actions", task, seed)) for task, seed in rollouts.episodes]
    if settings.demonstrations is not None:
        directory = Path(settings.demonstrations)
        # A demonstration depends on its task, its seed, and these.
        recording = {"recording": demos.read_settings(directory, list(rollouts.tasks)).to_dict()}
        for task in rollouts.tasks:
            recorded = sorted(int(path.stem) for path in (directory / task).glob("[0-9]*.npz"))
            cells += [Cell(("loss", task, seed), recording) for seed in recorded[: len(rollouts.seeds)]]
    run_cells(STUDY, cells, Work(settings), out, settings=common, backend=backend, jobs=jobs, on_done=on_done)


def run_on_file(settings: FileSettings, out: Path, *, backend: str, jobs: int, on_done: OnDone) -> None:
    """Measures the actions on every observation."""
    config = recorded_head(settings.recording).config
    observations = observations_of(settings.recording.file, config)
    run_cells(
        STUDY,
        [Cell(("actions", TASK, row)) for row in range(len(observations))],
        FileWork(settings),
        out,
        settings={**describe(settings.recording, config), "projections": settings.projections},
        backend=backend,
        jobs=jobs,
        on_done=on_done,
    )


def mean_of(table: pd.DataFrame, column: str) -> Estimate:
    """The mean over episodes, drawing episodes."""
    return bootstrap(table[column].to_numpy(), clusters_of(table))


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    settings = provenance.settings
    episodes = {kind: len(rows.groupby(["task", "seed"])) for kind, rows in table.groupby("of")}
    how = (
        "derivatives of the sampled chunk (all Euler steps, normalised actions) in torch, Frobenius norms "
        f"from {settings['projections']} random projections. {loss_summary(episodes.get('loss', 0))}"
    )
    title, warned = "Gradients", []
    if from_file(provenance):
        title, warned = "Gradients, from a file of features", cautions(table, provenance)
        summary = [*file_summary(table, provenance), f"{how[0].upper()}{how[1:]}"]
    else:
        summary = [
            f"{episodes.get('actions', 0)} episodes of {settings['checkpoint']['name']} in closed loop, up "
            f"to {settings['looks']} looks of each; {how} Intervals are over episodes."
        ]
    summary.append(
        "The change for a row is the norm of the derivative times the row's length: to first order, how much "
        "the chunk moves if the row changes by its own length, at every Euler step. Norms alone are in the "
        "table; blocks normalise what they read, so those say as much about how long a row is.",
    )
    pictures = [
        Figure(f"rows-of-{kind}", caption, sensitivity_picture(table[table["of"] == kind], label))
        for kind, caption, label in (
            (
                "actions",
                "Change of the chunk for a change of one row by its own length, before the first block (-1) "
                "and after each; root mean square over the rows of a group, 95 % intervals.",
                "change of the chunk (norm)",
            ),
            (
                "loss",
                "The same for the flow-matching loss on demonstrations.",
                "change of the loss",
            ),
        )
        if kind in episodes
    ]
    if "token" in table:
        pictures.append(
            Figure(
                "tokens",
                "Change of the chunk for a change of one learned future token by its own length, the largest "
                "first; 95 % intervals.",
                token_picture(table),
            )
        )
    if "path" not in table:
        return Section(
            title,
            summary,
            pictures,
            concluded=[f"Paths: {not_measured(NO_TOKENS)}.", *warned],
            not_shown=NOT_SHOWN,
        )
    paths = table[table["path"].notna()]
    share = {path: mean_of(shares_of(paths, path), "share") for path in PATHS}
    pictures.insert(
        0,
        Figure(
            "paths",
            "Share of each path in the derivative of the chunk by the vision-language tokens, along the "
            "whole; shares add up to 1. Means over episodes, 95 % intervals.",
            figures.estimates(PATHS, list(share.values()), "share of the derivative", reference=0),
        ),
    )
    return Section(
        title,
        summary,
        pictures,
        [path_grid(paths), cosine_grid(paths)],
        [*conclusions(paths, share), *warned],
        NOT_SHOWN,
    )


def loss_summary(demonstrations: int) -> str:
    """What was done about the loss."""
    if not demonstrations:
        return f"The loss: {not_measured('no demonstrations were given')}."
    return f"The loss: on {demonstrations} demonstrations, which the policy may have been trained on."


def sensitivity_picture(table: pd.DataFrame, label: str) -> Any:
    """A line for each group of rows over the blocks."""
    groups = table[table["group"].notna() & (table["token"].isna() if "token" in table else True)]
    blocks = sorted(int(block) for block in groups["block"].unique())
    series = {
        str(group): [mean_of(rows[rows["block"] == block], "relative") for block in blocks]
        for group, rows in groups.groupby("group")
    }
    return figures.lines(blocks, series, "after block", label)


def token_picture(table: pd.DataFrame) -> Any:
    """An estimate for each learned token, the largest first."""
    tokens = table[(table["of"] == "actions") & table["token"].notna()]
    found = {
        int(token): mean_of(tokens[tokens["token"] == token], "relative")
        for token in tokens["token"].unique()
    }
    order = sorted(found, key=lambda token: -found[token].value)
    picture, (axes,) = figures.new_picture()
    for place, token in enumerate(order):
        axes.plot([place, place], [found[token].low, found[token].high], color=figures.COLOURS[0])
        axes.plot([place], [found[token].value], "o", color=figures.COLOURS[0], markersize=4)
    axes.set_xticks(range(len(order)), [str(token) for token in order], fontsize="x-small")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("future token")
    axes.set_ylabel("change of the chunk (norm)")
    return picture


def shares_of(paths: pd.DataFrame, path: str) -> pd.DataFrame:
    """The rows with a path's length and share."""
    return paths[(paths["path"] == path) & paths["share"].notna()]


def path_grid(paths: pd.DataFrame) -> Grid:
    """Lengths and shares of the paths, over all and by task."""
    rows = []
    for path in PATHS:
        of_path = shares_of(paths, path)
        by_task = [
            number(mean_of(values, "share"), digits=2) for _, values in of_path.groupby("task", sort=False)
        ]
        rows.append(
            [
                path,
                number(mean_of(of_path, "length"), digits=2),
                number(mean_of(of_path, "share"), digits=2),
                *by_task,
            ]
        )
    tasks = list(dict.fromkeys(paths["task"]))
    caption = (
        "Paths from the vision-language tokens to the chunk. Length: Frobenius norm over that of the whole; "
        "lengths need not add up. Share: the part along the whole; adds up to 1. Then the share by task."
    )
    return Grid(caption, ("path", "length", "share", *tasks), rows)


def cosine_grid(paths: pd.DataFrame) -> Grid:
    """Cosines between paths."""
    pairs = paths[paths["cosine"].notna()]
    rows = [
        [str(one), str(other), number(mean_of(values, "cosine"), digits=2)]
        for (one, other), values in pairs.groupby(["path", "other_path"], sort=False)
    ]
    return Grid("Cosine between the derivatives along two paths.", ("path", "other path", "cosine"), rows)


def conclusions(paths: pd.DataFrame, share: Mapping[str, Estimate]) -> list[str]:
    """What the numbers say."""
    through = paths[paths["path"].isin((READ, DETOUR)) & paths["share"].notna()]
    sums = through.groupby(["task", "seed"])["share"].sum()  # sorted, as are the clusters
    observed = through.sort_values(["task", "seed"]).drop_duplicates(["task", "seed"])
    by_future = bootstrap(sums.to_numpy(), clusters_of(observed))
    length = {path: number(mean_of(shares_of(paths, path), "length"), digits=2) for path in PATHS}
    return [
        "Of the derivative of the chunk by the vision-language tokens, a share of "
        f"{number(share[DIRECT], digits=2)} runs by state and action rows alone and one of "
        f"{number(by_future, digits=2)} through future rows. Of the latter, {number(share[READ], digits=2)} "
        f"is read by future rows from the tokens; {number(share[DETOUR], digits=2)} was read by state or "
        "action rows and passes future rows later. Shares are no proportions: one above 1 is taken back by a "
        "negative one.",
        f"By itself, what future rows read has a length of {length[READ]} times the whole, and what runs by "
        f"state and action rows alone one of {length[DIRECT]}. Where lengths are larger than shares, paths "
        "point in other directions than the whole, or against each other.",
    ]


NOT_SHOWN = (
    "A derivative is what a small change does. A path that carries much of it may still be one that the "
    "policy can do without: cuts and success in closed loop say that.",
    "Shares depend on the coordinates: actions are normalised, and the vision-language tokens are taken as "
    "they are, all directions alike, also those in which no picture ever moves them.",
)
