"""``saccade study patching``: rows of one observation inserted into the run of another."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
import pandas as pd

from saccade._internal.flags import add_list
from saccade.head.head import ActionHead
from saccade.head.intervention import ROW_GROUPS, Intervention, Tokens
from saccade_lab.flags import add_frames, add_rollout_arguments, check_known, indices
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.arguments import source_of
from saccade_lab.study.arms import NO_TOKENS
from saccade_lab.study.cell import Cell, Rows
from saccade_lab.study.pictures import PictureSource
from saccade_lab.study.questions.patching_section import (
    ABOUT,
    ALL,
    FROM_FILE,
    GROUPS,
    KINDS,
    WITH_FRAMES,
    WITH_INSTRUCTION,
    section,
)
from saccade_lab.study.recording import Recorded
from saccade_lab.study.section import Section
from saccade_lab.study.source import Source
from saccade_lab.study.study import Study
from saccade_lab.study.table import Provenance

if TYPE_CHECKING:
    from saccade_lab.study.simulator import Simulator


EPILOG = """\
Two observations, donor and receiver, start from the same noise. Rows that the donor's run had after a block
replace those of the receiver's run, and the change of the chunk is measured along the way from the receiver's
chunk to the donor's: 0 is no effect, 1 is the donor's chunk.

kinds of donors:
{kinds}

With --frames or --features, the donor of an observation is one of another episode. With --frames it may also
be the same pictures with another instruction (--other-instruction), or the pictures of another directory
(--other-frames). Only rows of the head are patched: donor and receiver have equally many, whatever their
numbers of vision-language tokens are.

examples:
  saccade study patching --episodes 15 --out out/study
  saccade study patching --kinds layout --blocks 1 --steps 0 --tasks push --out out/study
  saccade study patching --checkpoint my-finetune/ --frames table/ --instruction "take the pear" \\
    --other-instruction "take the apple" --out out/own
  saccade study patching --checkpoint checkpoint/ --features observations.npz --out out/study
"""


@dataclass(frozen=True)
class Patching(Study):
    """How far the actions follow rows of another observation.

    Attributes:
        source: The receivers: the first observation of each episode, or each row of a file.
        blocks: Are patched one by one, and all of them at once.
        steps: Euler steps in which they are patched.
        kinds: Kinds of donors, names from ``KINDS``; of recorded observations the one of ``kind_of``. In the
            simulator, donors have the seeds that follow those of the receivers.
    """

    source: Source
    blocks: tuple[int, ...]
    steps: tuple[int, ...]
    kinds: tuple[str, ...] = tuple(KINDS)
    name: ClassVar[str] = "patching"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See ``Study``."""
        width = max(len(name) for name in KINDS)
        parser.epilog = EPILOG.format(
            kinds="\n".join(f"  {name:{width}}  {about}" for name, about in KINDS.items())
        )
        add_rollout_arguments(parser, episodes=15)
        add_frames(parser)
        parser.add_argument("--other-instruction", metavar="TEXT", help="with --frames: donors are told this")
        parser.add_argument(
            "--other-frames",
            type=Path,
            metavar="DIR",
            help="with --frames: donors see these pictures",
        )
        add_list(parser, "--kinds", help="kinds of donors in the simulator (default: all)")
        add_list(
            parser, "--blocks", item=int, metavar="N", help="blocks, one by one and together (default: all)"
        )
        add_list(parser, "--steps", item=int, metavar="N", help="Euler steps (default: all)")

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Patching:
        """See ``Study``."""
        kinds = tuple(args.kinds or KINDS)
        check_known("--kinds", kinds, KINDS)
        source = source_of(args, "kinds")
        if source.closed_loop:
            from saccade_lab.sim.tasks import check_evaluation_seeds

            episodes = args.default_episodes if args.episodes is None else args.episodes
            check_evaluation_seeds(args.seed, 2 * episodes)  # donors have the later half
        return cls(
            source,
            indices("--blocks", args.blocks, source.config.num_layers),
            indices("--steps", args.steps, source.config.num_steps),
            kinds if source.closed_loop else (kind_of(source),),
        )

    def settings(self) -> Mapping[str, Any]:
        """See ``Study``."""
        return {**self.source.describe(), "blocks": self.blocks, "steps": self.steps}

    def cells(self) -> Sequence[Cell]:
        """A pair of donor and receiver each."""
        offset = len({seed for _, seed in self.source.units})
        return [
            Cell((kind, task, seed), {"donor_seed": seed + offset} if self.source.closed_loop else {})
            for task, seed in self.source.units
            for kind in self.kinds
        ]

    def measure(self, cell: Cell) -> Rows:
        """A row for each group of rows and block, or a note why there is none."""
        kind, task, seed = str(cell.key[0]), str(cell.key[1]), int(cell.key[2])
        row: dict[str, Any] = {"kind": kind, "task": task, "seed": seed, **self.source.labels(task, seed)}
        pair = pair_of(self.source, kind, task, seed, cell.settings.get("donor_seed"))
        if isinstance(pair, str):
            return [{**row, "note": pair}]
        columns = {**row, **pair.labels}
        return patched(self.source.head(), pair, self.blocks, self.steps, columns, self.source.action_width)

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See ``Study``."""
        return section(table, provenance)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two observations.

    Attributes:
        donor, receiver: One row each; the run of both starts from the receiver's noise.
        labels: Columns that name the donor.
    """

    donor: HeadInputs
    receiver: HeadInputs
    labels: Mapping[str, Any]


def kind_of(source: Source) -> str:
    """The kind of donors of recorded observations."""
    if isinstance(source, PictureSource) and source.others is not None:
        return WITH_INSTRUCTION if source.other_frames is None else WITH_FRAMES
    return FROM_FILE


def pair_of(source: Source, kind: str, task: str, seed: int, donor_seed: int | None) -> Pair | str:
    """Donor and receiver, or why there is no donor."""
    if isinstance(source, Recorded):
        return recorded_pair(source, kind, task, seed)
    from saccade_lab.study.simulator import Simulator  # imports MuJoCo

    assert isinstance(source, Simulator)
    assert donor_seed is not None
    return simulated_pair(source, kind, task, seed, donor_seed)


def simulated_pair(source: Simulator, kind: str, task: str, seed: int, donor_seed: int) -> Pair | str:
    """First observations of two episodes, or why there is no donor."""
    from saccade_lab.sim.tasks import find_task

    donor_task = find_donor(kind, task, source.policy.config.tasks)
    if donor_task is None:
        return f"the policy knows no task for it ({KINDS[kind]})"
    if kind == "words":
        donor_seed = seed
    receiver = source.first(task, seed, find_task(task).instruction(seed))
    if kind == "task":
        donor = source.first(donor_task, donor_seed, find_task(donor_task).instruction(donor_seed))
    else:
        donor = source.first(task, donor_seed, find_task(donor_task).instruction(seed))
    receiver = receiver.with_noise(source.rng(task, seed), source.config)
    return Pair(donor, receiver, {"donor_task": donor_task, "donor_seed": donor_seed})


def recorded_pair(source: Recorded, kind: str, task: str, row: int) -> Pair | str:
    """An observation and its other one; or the next (cyclically) of another episode, same embodiment."""
    found, receiver = source.all, source.observed(task, row).with_draw(0)
    if source.others is not None:
        return Pair(source.others.row(row), receiver, {"donor_task": task, "donor_seed": row})
    others = (np.arange(1, len(found)) + row) % len(found)
    fitting = (found.clusters[others] != found.clusters[row]) & (
        found.embodiment_id[others] == found.embodiment_id[row]
    )
    if not fitting.any():
        return f"there is no donor for it ({ABOUT[kind]})"
    number = int(others[fitting][0])
    return Pair(found.row(number), receiver, {"donor_task": task, "donor_seed": number})


def patched(
    head: ActionHead,
    pair: Pair,
    blocks: Sequence[int],
    steps: Sequence[int],
    row: Mapping[str, Any],
    action_width: int,
) -> Rows:
    """A row for each group of rows and block: what the donor's rows do in the receiver's run.

    Args:
        head: Head that computes.
        pair: Donor and receiver.
        blocks: After which rows are patched, one by one and all at once.
        steps: Euler steps in which they are patched.
        row: Columns that all rows have.
        action_width: Number of action dimensions that count.
    """
    receiver = pair.receiver
    context = receiver.encode(head)

    def chunk(intervention: Intervention | None) -> npt.NDArray[np.float64]:
        """The head's own, normalised actions, ``(horizon, action_width)``."""
        found = receiver.sample(head, context, intervention=intervention)[0, :, :action_width]
        return np.asarray(found, dtype=np.float64)

    trace = replace(pair.donor, noise=receiver.noise).trace(
        head, record=("hidden",), blocks=blocks, steps=steps
    )
    hidden = {place: np.asarray(rows)[0] for place, rows in trace.hidden.items()}
    before = chunk(None)
    way = np.asarray(trace.actions)[0, :, :action_width] - before
    found: Rows = []
    for group, members in GROUPS.items():
        if "future" in members and head.config.num_future_tokens == 0 and members != ROW_GROUPS:
            found.append({**row, "group": group, "note": NO_TOKENS})
            continue
        present = [name for name in members if name != "future" or head.config.num_future_tokens]
        for block in (None, *blocks):
            places = [(step, one) for step in steps for one in blocks if block in (None, one)]
            patch: dict[tuple[int, int], dict[Tokens, npt.NDArray[np.float32]]] = {
                place: {name: hidden[place][trace.rows[name]] for name in present} for place in places
            }
            change = chunk(Intervention(patch=patch)) - before
            found.append(
                {
                    **row,
                    "group": group,
                    "block": ALL if block is None else str(block),
                    "toward": float((change * way).sum()),
                    "squared_change": float((change * change).sum()),
                    "squared_way": float((way * way).sum()),
                    "note": None,
                }
            )
    return found


def find_donor(kind: str, task: str, known: Sequence[str]) -> str | None:
    """The task of the donor: the next one that fits among those that the policy knows, or None.

    Example:
        >>> find_donor("words", "reach", ["reach", "drawer-open", "push"])
        'push'
        >>> find_donor("task", "push", ["reach", "drawer-open", "push"])
        'drawer-open'
    """
    from saccade_lab.sim.tasks import find_task

    if kind == "layout":
        return task
    start = known.index(task)
    others = [*known[start + 1 :], *known[:start]]
    same = kind == "words"
    fitting = [one for one in others if (find_task(one).objects == find_task(task).objects) == same]
    return fitting[0] if fitting else None
