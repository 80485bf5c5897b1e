"""`saccade study gradients`: the derivatives of the actions, and how much of them runs through future tokens.

Backward passes through `saccade.reference`, on the observations of episodes in closed loop or of a file. Two
questions: how much the actions (and the loss on demonstrations) would change if a row changed by its own
length, and along which paths the derivative of the actions by the vision-language tokens arises.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pandas as pd

from saccade.cli.arguments import add_integer, add_rollout_arguments
from saccade.errors import InputError
from saccade.intervention import ROW_GROUPS
from saccade.observation import MASKS, Observation
from saccade.study import figures
from saccade.study.arms import NO_TOKENS
from saccade.study.cell import Cell, Rows
from saccade.study.changes import cautions
from saccade.study.changes import summary as file_summary
from saccade.study.paths import DETOUR, DIRECT, PATHS, READ
from saccade.study.section import Figure, Grid, Section, not_measured, number
from saccade.study.source import Source, source_of
from saccade.study.statistics import Estimate, bootstrap
from saccade.study.study import Study
from saccade.study.table import Provenance, clusters_of, from_file

if TYPE_CHECKING:
    import torch

    from saccade.reference import ActionHead
    from saccade.study.derivatives import Sensitivity, Shares
    from saccade.study.simulator import Simulator

LOOKS = 3

EPILOG = """\
Runs the policy in closed loop and takes derivatives of its chunks in torch: by the rows before and after
every block, and by the vision-language tokens, split by the paths along which they arise. With --demos also
the derivative of the training loss by the rows.

examples:
  saccade study gradients --out out/study
  saccade study gradients --checkpoint out/policy --demos out/demos --tasks push --out out/study
  saccade study gradients --checkpoint checkpoint/ --features looks.npz --out out/study
"""


@dataclass(frozen=True)
class Gradients(Study):
    """Derivatives of the actions by rows and by vision-language tokens.

    Attributes:
        source: Checkpoint and observations.
        projections: Random projections of the actions, or draws of time and noise for the loss.
        looks: Observations taken from each episode, evenly spaced; a file has one in each row.
        demonstrations: Directory of `saccade demos` for the loss, or None: it is then not measured.
    """

    source: Source
    projections: int = 16
    looks: int = LOOKS
    demonstrations: str | None = None
    name: ClassVar[str] = "gradients"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See `Study`."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=10)
        add_integer(parser, "--looks", help=f"observations of each episode, evenly spaced (default: {LOOKS})")
        add_integer(
            parser,
            "--projections",
            default=16,
            help="random projections of the actions, and draws of time and noise for the loss",
        )
        parser.add_argument(
            "--demos",
            type=Path,
            metavar="DIR",
            help="demonstrations for the loss (default: it is not measured)",
        )

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Gradients:
        """See `Study`."""
        source = source_of(args, "looks", "demos")
        if not source.closed_loop:
            return cls(source, args.projections)
        demonstrations = None if args.demos is None else str(args.demos)
        study = cls(source, args.projections, args.looks or LOOKS, demonstrations)
        if demonstrations is not None:
            check_demonstrations(Path(demonstrations), study.simulator)
        return study

    @property
    def simulator(self) -> Simulator:
        """The source, if it is the simulator."""
        from saccade.study.simulator import Simulator

        assert isinstance(self.source, Simulator)
        return self.source

    def settings(self) -> Mapping[str, Any]:
        """See `Study`."""
        looks = {"looks": self.looks} if self.source.closed_loop else {}
        return {**self.source.describe(), **looks, "projections": self.projections}

    def cells(self) -> Sequence[Cell]:
        """The actions in every episode, then the loss on as many demonstrations."""
        cells = [Cell(("actions", task, seed)) for task, seed in self.source.units]
        if self.demonstrations is None:
            return cells
        from saccade.sim import demos

        directory, simulator = Path(self.demonstrations), self.simulator
        # A demonstration depends on its task, its seed, and these.
        recording = {"recording": demos.read_settings(directory, list(simulator.tasks)).to_dict()}
        for task in simulator.tasks:
            recorded = sorted(int(path.stem) for path in (directory / task).glob("[0-9]*.npz"))
            cells += [Cell(("loss", task, seed), recording) for seed in recorded[: len(simulator.seeds)]]
        return cells

    def measure(self, cell: Cell) -> Rows:
        """The rows of a cell: a kind, a task and a seed, or the row of a file."""
        kind, task, seed = str(cell.key[0]), str(cell.key[1]), int(cell.key[2])
        row: dict[str, Any] = {"of": kind, "task": task, "seed": seed, **self.source.labels(task, seed)}
        measured = self.of_loss(task, seed) if kind == "loss" else self.of_actions(task, seed)
        return [{**row, **found} for found in measured]

    def of_actions(self, task: str, seed: int) -> Rows:
        """An episode in closed loop, or a row of a file."""
        from saccade.study import derivatives

        head = reference_of(self.source)
        generator = self.generator(task, seed)
        observed = self.source.observed(task, seed)
        sensitivities, paths = [], []
        for place in spaced(len(observed), self.looks):
            observation = observed.row(place).with_draw(0)
            sensitivity, parts = self.of_observation(head, observation, generator)
            sensitivities.append(sensitivity)
            if parts is not None:
                paths.append(derivatives.shares(parts))
        rows = sensitivity_rows(sensitivities, derivatives.row_groups(head))
        return rows + (path_rows(paths) if paths else [{"note": NO_TOKENS}])

    def of_observation(
        self, head: ActionHead, observation: Observation, generator: torch.Generator
    ) -> tuple[Sensitivity, Mapping[str, torch.Tensor] | None]:
        """Sensitivities and derivatives along paths; None without future tokens."""
        import torch

        from saccade.study import derivatives

        masks = {name: getattr(observation, name) for name in MASKS}
        masks = {name: torch.from_numpy(mask) for name, mask in masks.items() if mask is not None}
        inputs = (
            head.encode(observation.backbone_features, drop_vl=masks.get("drop_vl")),
            head.as_input(observation.state),
            head.as_input(observation.noise),
        )
        shape = (self.projections, head.config.action_horizon, head.config.action_dim)
        cotangents = torch.randn(shape, generator=generator)
        # In a head of full size, which a file may be for, the graph takes a gigabyte for each projection.
        size = self.projections if self.source.closed_loop else 1
        sensitivities, paths = [], []
        for some in cotangents.split(size):
            given = (head, *inputs, some, int(observation.embodiment_id[0]), masks)
            sensitivities.append(derivatives.action_sensitivity(*given))
            if head.config.num_future_tokens:
                paths.append(derivatives.path_derivatives(*given))
        sensitivity = sensitivities[0] if self.source.closed_loop else derivatives.pooled(sensitivities)
        if not paths:
            return sensitivity, None
        return sensitivity, {name: torch.cat([one[name] for one in paths]) for name in paths[0]}

    def generator(self, task: str, seed: int) -> torch.Generator:
        """Of the random projections of a cell."""
        import torch

        from saccade.study.recording import Recording

        given = (self.source.seed, seed) if isinstance(self.source, Recording) else (seed, *map(ord, task))
        return torch.Generator().manual_seed(int(np.random.default_rng(given).integers(2**31)))

    def of_loss(self, task: str, seed: int) -> Rows:
        """A demonstration."""
        from saccade.sim import demos
        from saccade.sim.dataset import chunks
        from saccade.sim.tasks import find_task
        from saccade.study import derivatives

        assert self.demonstrations is not None
        head, policy = reference_of(self.source), self.simulator.policy
        generator = self.generator(task, seed)
        demonstration = demos.load(Path(self.demonstrations) / task / f"{seed}.npz")
        actions, mask = chunks(demonstration, policy.horizon)
        usable = np.flatnonzero(mask[..., 0].any(axis=1))
        names = [camera.name for camera in policy.config.cameras]
        measured = []
        for frame in usable[spaced(len(usable), self.looks)]:
            seen = {
                "images": dict(zip(names, demonstration.images[frame], strict=True)),
                "proprio": demonstration.proprio[frame],
                "instruction": find_task(task).instruction(seed),
            }
            measured.append(
                derivatives.loss_sensitivity(
                    head,
                    head.as_input(policy.features(seen)),
                    head.as_input(policy.state(seen)),
                    head.as_input(policy.config.action.normalize(actions[frame]) * mask[frame])[None],
                    head.as_input(mask[frame])[None],
                    generator,
                    self.projections,
                )
            )
        return sensitivity_rows(measured, derivatives.row_groups(head))

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See `Study`."""
        return section(table, provenance)


def check_demonstrations(directory: Path, source: Simulator) -> None:
    """Checks that there are demonstrations with the pictures that the policy is given.

    Raises:
        InputError: there are none for a task, or the pictures differ.
    """
    from saccade.sim import demos

    recorded = demos.recorded_tasks(directory)
    missing = [task for task in source.tasks if task not in recorded]
    if missing:
        raise InputError(f"--demos: {directory} has none of {', '.join(missing)}")
    recording = demos.read_settings(directory, list(source.tasks))
    config = source.policy.config
    given, expected = (recording.image_size, recording.cameras), (config.backbone.image_size, config.cameras)
    if given != expected:
        raise InputError(
            f"--demos: {directory} was recorded with another image size or other cameras than the policy's"
        )


@functools.lru_cache(maxsize=1)
def reference_of(source: Source) -> ActionHead:
    """The head in torch, without gradients for its weights."""
    import torch

    from saccade.reference import ActionHead
    from saccade.study.recording import Recording

    checkpoint, config, num_threads = source.checkpoint, None, 1
    if isinstance(source, Recording):
        config, num_threads = source.config_file, source.num_threads
    if num_threads is not None:
        torch.set_num_threads(num_threads)
    head = ActionHead.load(checkpoint, config=config)
    head.requires_grad_(False)
    return head


def sensitivity_rows(measured: Sequence[Sensitivity], rows: Mapping[str, slice]) -> Rows:
    """The mean over several observations, by block and group, and for learned tokens one by one.

    Args:
        measured: of each observation what `action_sensitivity` or `loss_sensitivity` returned.
        rows: where the groups lie.
    """
    import torch

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
