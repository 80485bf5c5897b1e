"""``saccade study gradients``: derivatives of the actions, and how much runs through future tokens.

Backward passes through ``saccade_lab.reference``, on the observations of episodes in closed loop or of a
file. Two
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

from saccade._internal.flags import add_integer
from saccade.errors import InputError
from saccade.head.input_files import MASKS
from saccade.head.intervention import ROW_GROUPS
from saccade_lab.files import path_text
from saccade_lab.flags import add_frames, add_rollout_arguments
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.arguments import source_of
from saccade_lab.study.arms import NO_TOKENS
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.paths import ALL_PATHS, PATHS
from saccade_lab.study.pictures import PictureSource, encode
from saccade_lab.study.questions.gradients_section import section
from saccade_lab.study.recording import Recorded
from saccade_lab.study.section import Section
from saccade_lab.study.source import Source
from saccade_lab.study.study import Study
from saccade_lab.study.table import Provenance

if TYPE_CHECKING:
    import torch

    from saccade_lab.reference import ActionHead, Backbone
    from saccade_lab.study.derivatives import Sensitivity, Shares
    from saccade_lab.study.simulator import Simulator

NUM_OBSERVATIONS = 3

EPILOG = """\
Runs the policy in closed loop and takes derivatives of its chunks in torch: by the rows before and after
every block, and by the vision-language tokens, split by the paths along which they arise. With --demos also
the derivative of the training loss by the rows. With --frames also the derivative by the words and the image
tokens that the backbone is given, and by the pixels of the views.

examples:
  saccade study gradients --out out/study
  saccade study gradients --checkpoint out/policy --demos out/demos --tasks push --out out/study
  saccade study gradients --checkpoint my-finetune/ --frames table/ --projections 4 --out out/own
  saccade study gradients --checkpoint checkpoint/ --features observations.npz --out out/study
"""


@dataclass(frozen=True)
class Gradients(Study):
    """Derivatives of the actions by rows and by vision-language tokens.

    Attributes:
        source: Checkpoint and observations.
        projections: Random projections of the actions, or draws of time and noise for the loss.
        num_observations: Observations taken from each episode, evenly spaced; a file has one in each row.
        demonstrations: Directory of ``saccade demos`` for the loss, or None: it is then not measured.
    """

    source: Source
    projections: int = 16
    num_observations: int = NUM_OBSERVATIONS
    demonstrations: str | None = None
    name: ClassVar[str] = "gradients"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        parser.epilog = EPILOG
        add_rollout_arguments(parser, episodes=10)
        add_frames(parser)
        add_integer(
            parser,
            "--num-observations",
            help=f"observations of each episode, evenly spaced (default: {NUM_OBSERVATIONS})",
        )
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
        """See ``Study``."""
        source = source_of(args, "num_observations", "demos")
        if not source.closed_loop:
            return cls(source, args.projections)
        demonstrations = None if args.demos is None else path_text(args.demos)
        study = cls(source, args.projections, args.num_observations or NUM_OBSERVATIONS, demonstrations)
        if demonstrations is not None:
            check_demonstrations(Path(demonstrations), study.simulator)
        return study

    @property
    def simulator(self) -> Simulator:
        """The source, if it is the simulator."""
        from saccade_lab.study.simulator import Simulator

        assert isinstance(self.source, Simulator)
        return self.source

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        observed = {"num_observations": self.num_observations} if self.source.closed_loop else {}
        return {**self.source.describe(), **observed, "projections": self.projections}

    def cells(self) -> Sequence[Cell]:
        """The actions in every episode, then the loss on as many demonstrations."""
        cells = [Cell(("actions", task, seed)) for task, seed in self.source.units]
        if self.demonstrations is None:
            return cells
        from saccade_lab.sim import demos

        directory, simulator = Path(self.demonstrations), self.simulator
        # A demonstration depends on its task, its seed, and these.
        recording = {"recording": demos.read_settings(directory, list(simulator.tasks)).to_dict()}
        for task in simulator.tasks:
            recorded = sorted(int(path.stem) for path in (directory / task).glob("[0-9]*.npz"))
            cells += [Cell(("loss", task, seed), recording) for seed in recorded[: len(simulator.seeds)]]
        return cells

    @property
    def files(self) -> tuple[str | Path, ...]:
        """See ``Study``."""
        return (*super().files, *(() if self.demonstrations is None else (self.demonstrations,)))

    def measure(self, cell: Cell) -> Rows:
        """The rows of a cell: a kind, a task and a seed, or the row of a file."""
        kind, task, seed = str(cell.key[0]), str(cell.key[1]), int(cell.key[2])
        row: dict[str, Any] = {"of": kind, "task": task, "seed": seed, **self.source.labels(task, seed)}
        measured = self.of_loss(task, seed) if kind == "loss" else self.of_actions(task, seed)
        return [{**row, **found} for found in measured]

    def of_actions(self, task: str, seed: int) -> Rows:
        """An episode in closed loop, or a row of a file."""
        from saccade_lab.study import derivatives

        head = reference_of(self.source)
        generator = self.generator(task, seed)
        observed = self.source.observed(task, seed)
        sensitivities, paths = [], []
        for place in spaced(len(observed), self.num_observations):
            observation = observed.row(place).with_draw(0)
            sensitivity, parts, by_vl = self.of_observation(head, observation, generator)
            sensitivities.append(sensitivity)
            if parts is not None:
                paths.append(derivatives.shares(parts))
        rows = sensitivity_rows(sensitivities, derivatives.row_groups(head))
        rows += path_rows(paths) if paths else [{"note": NO_TOKENS}]
        if isinstance(self.source, PictureSource):
            assert by_vl is not None
            rows += self.of_inputs(self.source, seed, by_vl)
        return rows

    def of_inputs(self, source: PictureSource, row: int, by_vl: torch.Tensor) -> Rows:
        """Derivatives by the tokens of the prompt and by the pixels of an observation.

        Args:
            source: The source.
            row: Which observation.
            by_vl: Derivatives by the vision-language tokens, ``(projections, T_vl, context_dim)``.
        """
        import torch

        from saccade_lab.study import input_derivatives as derivatives

        encoded = encode(source)
        inputs, layout, config = encoded.inputs[row], encoded.layouts[row], encoded.backbone_config
        count = layout.num_tokens  # what is behind it is padding
        features = torch.from_numpy(source.all.row(row).backbone_features)[:, :count]
        by_features = derivatives.feature_derivatives(reference_of(source), features, by_vl[:, :count])
        found = derivatives.input_derivatives(backbone_of(source), inputs, by_features)
        by_view = derivatives.by_image_token(found, inputs, config, layout)
        return derivatives.part_rows(found, layout, by_view)

    def of_observation(
        self, head: ActionHead, observation: HeadInputs, generator: torch.Generator
    ) -> tuple[Sensitivity, Mapping[str, torch.Tensor] | None, torch.Tensor | None]:
        """Sensitivities, derivatives along paths, and derivatives along all paths.

        The second are None without future tokens, the third where nothing needs them.
        """
        import torch

        from saccade_lab.study import derivatives

        assert observation.noise is not None
        masks = {name: getattr(observation, name) for name in MASKS}
        masks = {name: torch.from_numpy(mask) for name, mask in masks.items() if mask is not None}
        inputs = (
            head.encode(observation.backbone_features, drop_vl=masks.get("drop_vl")),
            head.as_input(observation.state),
            head.as_input(observation.noise),
        )
        shape = (self.projections, head.config.action_horizon, head.config.action_dim)
        cotangents = torch.randn(shape, generator=generator)
        cotangents[..., self.source.action_width :] = 0
        # In a head of full size, which a file may be for, the graph takes a gigabyte for each projection.
        size = self.projections if self.source.closed_loop else 1
        sensitivities, paths = [], []
        for some in torch.split(cotangents, size):
            given = (head, *inputs, some, int(observation.embodiment_id[0]), masks)
            sensitivities.append(derivatives.action_sensitivity(*given))
            if head.config.num_future_tokens:
                paths.append(derivatives.path_derivatives(*given))
            elif isinstance(self.source, PictureSource):
                paths.append({ALL_PATHS: derivatives.vl_derivative(*given)})
        sensitivity = sensitivities[0] if self.source.closed_loop else derivatives.pooled(sensitivities)
        if not paths:
            return sensitivity, None, None
        parts = {name: torch.cat([one[name] for one in paths]) for name in paths[0]}
        return sensitivity, parts if head.config.num_future_tokens else None, parts[ALL_PATHS]

    def generator(self, task: str, seed: int) -> torch.Generator:
        """The generator of the random projections of a cell."""
        import torch

        given = (self.source.seed, seed) if isinstance(self.source, Recorded) else (seed, *map(ord, task))
        return torch.Generator().manual_seed(int(np.random.default_rng(given).integers(2**31)))

    def of_loss(self, task: str, seed: int) -> Rows:
        """A demonstration."""
        from saccade_lab.sim import demos
        from saccade_lab.sim.tasks import find_task
        from saccade_lab.study import derivatives
        from saccade_lab.training.dataset import chunks, normalized_actions

        assert self.demonstrations is not None
        head, policy = reference_of(self.source), self.simulator.policy
        generator = self.generator(task, seed)
        demonstration = demos.load(Path(self.demonstrations) / task / f"{seed}.npz")
        actions, mask = chunks(demonstration, policy.horizon)
        wanted = normalized_actions(policy.whole.normalizer, actions)
        usable = np.flatnonzero(mask[..., 0].any(axis=1))
        names = [camera.name for camera in policy.config.cameras]
        measured = []
        for frame in usable[spaced(len(usable), self.num_observations)]:
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
                    head.as_input(wanted[frame] * mask[frame])[None],
                    head.as_input(mask[frame])[None],
                    generator,
                    self.projections,
                )
            )
        return sensitivity_rows(measured, derivatives.row_groups(head))

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        return section(table, provenance)


def check_demonstrations(directory: Path, source: Simulator) -> None:
    """Checks that there are demonstrations with the same cameras and image size as the policy.

    Raises:
        InputError: There are none for a task, or the pictures differ.
    """
    from saccade_lab.sim import demos

    recorded = demos.recorded_tasks(directory)
    missing = [task for task in source.tasks if task not in recorded]
    if missing:
        raise InputError(f"--demos: {directory} has none of {', '.join(missing)}")
    recording = demos.read_settings(directory, list(source.tasks))
    config = source.policy.config
    given, expected = (recording.image_size, recording.cameras), (config.image_size, config.cameras)
    if given != expected:
        raise InputError(
            f"--demos: {directory} was recorded with another image size or other cameras than the policy's"
        )


@functools.lru_cache(maxsize=1)
def backbone_of(source: Source) -> Backbone:
    """The backbone in torch, without gradients for its weights."""
    from saccade_lab.reference import Backbone

    backbone = Backbone.from_pretrained(source.checkpoint)
    backbone.requires_grad_(False)
    return backbone


@functools.lru_cache(maxsize=1)
def reference_of(source: Source) -> ActionHead:
    """The head in torch, without gradients for its weights."""
    import torch

    from saccade_lab.reference import ActionHead

    if source.num_threads is not None:
        torch.set_num_threads(source.num_threads)
    config = source.config
    head = ActionHead.from_pretrained(
        source.checkpoint,
        config=source.config_file,
        action_horizon=config.action_horizon,
        num_states=config.num_states,
    )
    head.requires_grad_(False)
    return head


def sensitivity_rows(measured: Sequence[Sensitivity], rows: Mapping[str, slice]) -> Rows:
    """The mean over several observations, by block and group, and for learned tokens one by one.

    Args:
        measured: The results of ``action_sensitivity`` or ``loss_sensitivity``, one for each observation.
        rows: The slice of each group.
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
    """At most ``wanted`` of ``count`` places, evenly spaced, the first among them.

    Example:
        >>> spaced(9, 3), spaced(2, 3)
        ([0, 3, 6], [0, 1])
    """
    return [place * count // wanted for place in range(wanted)] if count > wanted else list(range(count))
