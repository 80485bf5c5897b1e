"""`saccade study patching`: rows of one observation patched into another's run; do the actions follow?"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
import pandas as pd

from saccade.cli.arguments import add_list, add_rollout_arguments, check_known, indices
from saccade.head import ActionHead
from saccade.intervention import ROW_GROUPS, Intervention, Tokens
from saccade.observation import Observation
from saccade.study import figures
from saccade.study.arms import NO_TOKENS
from saccade.study.cell import Cell, Rows
from saccade.study.changes import cautions
from saccade.study.changes import summary as file_summary
from saccade.study.section import Figure, Grid, Section, not_measured, number, too_few
from saccade.study.source import Source, source_of
from saccade.study.statistics import Estimate, bootstrap_ratio
from saccade.study.study import Study
from saccade.study.table import Provenance, clusters_of, from_file

if TYPE_CHECKING:
    from saccade.study.recording import Recording
    from saccade.study.simulator import Simulator

ALL = "all"  # every block at once
CONTROL = "all rows"
SAME = 1e-6  # a squared distance between two chunks that are equal up to rounding
EXACT = 1e-3  # how far from 1 the control may be

# What the donor's observation has that the receiver's has not.
KINDS = {
    "layout": "the same task and words, objects and goal elsewhere",
    "words": "the same picture, told another task of the same objects",
    "task": "another task: other objects, other words",
}
FROM_FILE = "observation"
ABOUT = {**KINDS, FROM_FILE: "an observation of another episode of the file, same embodiment"}
GROUPS: dict[str, tuple[str, ...]] = {
    "future": ("future",),
    "state": ("state",),
    "action": ("action",),
    CONTROL: ROW_GROUPS,
}

EPILOG = """\
Two observations, donor and receiver, start from the same noise. Rows that the donor's run had after a block
replace those of the receiver's run, and the change of the chunk is measured along the way from the receiver's
chunk to the donor's: 0 is no effect, 1 is the donor's chunk.

kinds of donors:
{kinds}

examples:
  saccade study patching --episodes 15 --out out/study
  saccade study patching --kinds layout --blocks 1 --steps 0 --tasks push --out out/study
  saccade study patching --checkpoint checkpoint/ --features looks.npz --out out/study
"""


@dataclass(frozen=True)
class Patching(Study):
    """How far the actions follow rows of another observation.

    Attributes:
        source: The receivers: the first observation of each episode, or each row of a file.
        blocks: Are patched one by one, and all of them at once.
        steps: Euler steps in which they are patched.
        kinds: Of donors, names of `KINDS`; a file has one kind of its own. In the simulator donors have the
            seeds that follow those of the receivers.
    """

    source: Source
    blocks: tuple[int, ...]
    steps: tuple[int, ...]
    kinds: tuple[str, ...] = tuple(KINDS)
    name: ClassVar[str] = "patching"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """See `Study`."""
        width = max(len(name) for name in KINDS)
        parser.epilog = EPILOG.format(
            kinds="\n".join(f"  {name:{width}}  {about}" for name, about in KINDS.items())
        )
        add_rollout_arguments(parser, episodes=15)
        add_list(parser, "--kinds", help="kinds of donors (default: all)")
        add_list(
            parser, "--blocks", item=int, metavar="N", help="blocks, one by one and together (default: all)"
        )
        add_list(parser, "--steps", item=int, metavar="N", help="Euler steps (default: all)")

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> Patching:
        """See `Study`."""
        kinds = tuple(args.kinds or KINDS)
        check_known("--kinds", kinds, KINDS)
        source = source_of(args, "kinds")
        if source.closed_loop:
            from saccade.sim.tasks import check_evaluation_seeds

            episodes = args.default_episodes if args.episodes is None else args.episodes
            check_evaluation_seeds(args.seed, 2 * episodes)  # donors have the later half
        return cls(
            source,
            indices("--blocks", args.blocks, source.config.num_layers),
            indices("--steps", args.steps, source.config.num_steps),
            kinds if source.closed_loop else (FROM_FILE,),
        )

    def settings(self) -> Mapping[str, Any]:
        """See `Study`."""
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
        return patched(self.source.head(), pair, self.blocks, self.steps, {**row, **pair.labels})

    @classmethod
    def summarise(cls, table: pd.DataFrame, provenance: Provenance) -> Section:
        """See `Study`."""
        return section(table, provenance)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two observations.

    Attributes:
        donor, receiver: One row each; the run of both starts from the receiver's noise.
        labels: Columns that name the donor.
    """

    donor: Observation
    receiver: Observation
    labels: Mapping[str, Any]


def pair_of(source: Source, kind: str, task: str, seed: int, donor_seed: int | None) -> Pair | str:
    """Donor and receiver, or why there is no donor."""
    from saccade.study.recording import Recording

    if isinstance(source, Recording):
        return recorded_pair(source, kind, task, seed)
    from saccade.study.simulator import Simulator  # imports MuJoCo

    assert isinstance(source, Simulator)
    assert donor_seed is not None
    return simulated_pair(source, kind, task, seed, donor_seed)


def simulated_pair(source: Simulator, kind: str, task: str, seed: int, donor_seed: int) -> Pair | str:
    """First observations of two episodes, or why there is no donor."""
    from saccade.sim.tasks import find_task

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


def recorded_pair(source: Recording, kind: str, task: str, row: int) -> Pair | str:
    """A row of a file, and the next one, going round, of another episode with the same embodiment."""
    found = source.all
    others = (np.arange(1, len(found)) + row) % len(found)
    fitting = (found.clusters[others] != found.clusters[row]) & (
        found.embodiment_id[others] == found.embodiment_id[row]
    )
    if not fitting.any():
        return f"the file has no donor for it ({ABOUT[kind]})"
    number = int(others[fitting][0])
    donor, receiver = found.row(number), source.observed(task, row).with_draw(0)
    return Pair(donor, receiver, {"donor_task": task, "donor_seed": number})


def patched(
    head: ActionHead, pair: Pair, blocks: Sequence[int], steps: Sequence[int], row: Mapping[str, Any]
) -> Rows:
    """A row for each group of rows and block: what the donor's rows do in the receiver's run.

    Args:
        head: computes.
        pair: donor and receiver.
        blocks: after which rows are patched, one by one and all at once.
        steps: in which they are patched.
        row: columns that all rows have.
    """
    receiver = pair.receiver
    context = receiver.encode(head)

    def chunk(intervention: Intervention | None) -> npt.NDArray[np.float64]:
        """The head's own, normalised actions, `(horizon, action_dim)`."""
        return receiver.sample(head, context, intervention=intervention).astype(np.float64)[0]

    trace = replace(pair.donor, noise=receiver.noise).trace(
        head, record=("hidden",), blocks=blocks, steps=steps
    )
    hidden = {place: np.asarray(rows)[0] for place, rows in trace.hidden.items()}
    before = chunk(None)
    way = np.asarray(trace.actions)[0] - before
    found: Rows = []
    for group, members in GROUPS.items():
        if "future" in members and head.config.num_future_tokens == 0 and members != ROW_GROUPS:
            found.append({**row, "group": group, "note": NO_TOKENS})
            continue
        for block in (None, *blocks):
            places = [(step, one) for step in steps for one in blocks if block in (None, one)]
            patch: dict[tuple[int, int], dict[Tokens, npt.NDArray[np.float32]]] = {
                place: {name: hidden[place][trace.rows[name]] for name in members} for place in places
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
    from saccade.sim.tasks import find_task

    if kind == "layout":
        return task
    start = known.index(task)
    others = [*known[start + 1 :], *known[:start]]
    same = kind == "words"
    fitting = [one for one in others if (find_task(one).objects == find_task(task).objects) == same]
    return fitting[0] if fitting else None


def shares(rows: pd.DataFrame) -> tuple[Estimate, float]:
    """How far the chunks moved towards the donor's, of all pairs together, and how far at all.

    Returns:
        The sum over pairs of the way made towards the donor's chunk, over that of the ways there are, each
        pair weighted by the square of its way; drawn anew by receiver. And the root of the summed squared
        changes over the summed squared ways.
    """
    rows = rows[rows["squared_way"] >= SAME]
    receivers = clusters_of(rows)
    way = rows["squared_way"].to_numpy(dtype=float)
    share = bootstrap_ratio(rows["toward"], way, receivers)
    size = math.sqrt(rows["squared_change"].sum() / way.sum()) if len(way) else math.nan
    return share, size


FIRST_ONLY = "First observations only, where the hand is at rest; what the rows carry later may differ. "


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """See `Study`."""
    measured = measured_rows(table)
    found: dict[tuple[str, str, str], tuple[Estimate, float, int]] = {}
    if len(measured):
        for (kind, group, block), rows in measured.groupby(["kind", "group", "block"]):
            found[str(kind), str(group), str(block)] = (*shares(rows), len(rows))
    kinds = [kind for kind in ABOUT if kind in set(table["kind"])]
    on_file = from_file(provenance)
    return Section(
        title="Patching: do the actions follow rows taken from another observation?"
        + (" From a file of features" if on_file else ""),
        summary=summary(table, provenance, kinds),
        figures=pictures(found, provenance, kinds),
        grids=[grid(found, provenance, kinds)],
        concluded=[
            *conclusions(table, found, provenance, kinds),
            *(cautions(measured, provenance) if on_file else ()),
        ],
        not_shown=(
            "Rows after later blocks have also read the donor's half-made actions, so patching them brings "
            "more than what was seen. After block 0, a cross-attention block, the future rows depend on the "
            "vision-language tokens and the time alone.",
            "Patched rows stand among rows that they never met. A share can be below what the rows carry "
            "because later cross-attention blocks read the receiver's tokens again, and above it because "
            "the mixture is one that the head never met.",
            ("" if on_file else FIRST_ONLY) + "A moved chunk is not yet a failed task (see the study cuts).",
        ),
    )


def summary(table: pd.DataFrame, provenance: Provenance, kinds: Sequence[str]) -> list[str]:
    """What was run."""
    checkpoint = provenance.settings["checkpoint"]
    steps, blocks = provenance.settings["steps"], provenance.settings["blocks"]
    pairs = {kind: len(pairs_of(measured_rows(table), kind)) for kind in kinds}
    if from_file(provenance):
        measured_on = file_summary(table, provenance)
        which = "Donor and receiver are of different episodes"
    else:
        measured_on = []
        which = (
            f"Policy {checkpoint['name']} (SHA-256 {checkpoint['sha256'][:12]}), N = "
            f"{checkpoint['num_future_tokens']} future tokens. Donor and receiver are first observations"
        )
    return [
        *measured_on,
        f"{which} and start from the same noise. Rows of the donor's run after the blocks "
        f"{', '.join(map(str, blocks))}, in the Euler steps {', '.join(map(str, steps))}, take the place of "
        "the receiver's.",
        "Share: how far the chunk (the head's own, normalised actions) moves along the way from the "
        "receiver's chunk to the donor's, 0 for not at all and 1 for all of it, below 0 for away from it; "
        "shares of groups need not add up to 1. All pairs together, with a 95 % bootstrap interval over "
        "receivers. Size: how far it moves at all, in the same unit.",
        *(
            f"Donors of the kind {kind} ({pairs[kind]} pairs{ways(table, kind)}): {ABOUT[kind]}."
            for kind in kinds
        ),
    ]


def ways(table: pd.DataFrame, kind: str) -> str:
    """How long the ways from receivers' to donors' chunks are, which says how much there is to follow."""
    measured = measured_rows(table)
    squares = measured.loc[measured["kind"] == kind, "squared_way"] if len(measured) else measured
    return f", ways of a mean length of {float(np.sqrt(squares).mean()):.2f}" if len(squares) else ""


def measured_rows(table: pd.DataFrame) -> pd.DataFrame:
    """The rows that hold numbers and not a note."""
    return table[table["note"].isna()] if "group" in table else table.iloc[:0]


def pairs_of(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Receivers that had a donor of the kind, each once."""
    return rows.loc[rows["kind"] == kind, ["task", "seed"]].drop_duplicates()


def pictures(
    found: Mapping[tuple[str, str, str], tuple[Estimate, float, int]],
    provenance: Provenance,
    kinds: Sequence[str],
) -> list[Figure]:
    """Shares with all blocks patched, and for each kind of donor block by block."""
    # The action rows after the last block are all that the actions are made of.
    together = {
        f"{kind}: {group}": found[kind, group, ALL][0]
        for kind in kinds
        for group in GROUPS
        if group != "action" and (kind, group, ALL) in found
    }
    drawn = []
    if together:
        picture = figures.estimates(
            list(together), list(together.values()), "share of the way to the donor's chunk", reference=0.0
        )
        caption = "All chosen blocks and steps patched at once, by kind of donor and group of rows."
        drawn.append(Figure("together", caption, picture))
    blocks = [int(block) for block in provenance.settings["blocks"]]
    for kind in kinds:
        series = {
            group: [found[kind, group, str(block)][0] for block in blocks]
            for group in GROUPS
            if (kind, group, str(blocks[0])) in found
        }
        if series:
            picture = figures.lines(blocks, series, "patched after block", "share of the way", reference=0.0)
            caption = f"One block patched (in all chosen steps), donors of the kind {kind}: {ABOUT[kind]}."
            drawn.append(Figure(f"blocks-{kind}", caption, picture))
    return drawn


def grid(
    found: Mapping[tuple[str, str, str], tuple[Estimate, float, int]],
    provenance: Provenance,
    kinds: Sequence[str],
) -> Grid:
    """All numbers."""
    rows = []
    for kind in kinds:
        for group in GROUPS:
            for block in (ALL, *map(str, provenance.settings["blocks"])):
                if (kind, group, block) in found:
                    share, size, pairs = found[kind, group, block]
                    rows.append([kind, group, block, str(pairs), number(share, digits=3), f"{size:.3f}"])
    columns = ("donor", "rows", "block", "pairs", "share of the way", "size")
    return Grid("By kind of donor, group of rows and block, with 95 % intervals.", columns, rows)


def conclusions(
    table: pd.DataFrame,
    found: Mapping[tuple[str, str, str], tuple[Estimate, float, int]],
    provenance: Provenance,
    kinds: Sequence[str],
) -> list[str]:
    """What the intervals allow to be said."""
    lines = []
    found_kinds = {kind for kind, _, _ in found}
    for kind in kinds:
        lines += without_donor(table, kind)
        for group in ("future", "state"):
            if (kind, group, ALL) in found:
                lines.append(f"{kind}, {group} rows in all blocks: {following(found[kind, group, ALL][0])}.")
            elif kind in found_kinds:  # pairs there were, but no such rows in the head
                lines.append(f"{kind}, {group} rows: {not_measured(NO_TOKENS)}.")
        if (kind, "future", "0") in found:
            share = found[kind, "future", "0"][0]
            lines.append(
                f"{kind}, future rows after block 0, where they hold vision alone: {following(share)}."
            )
        if kind in found_kinds and not from_file(provenance):  # a file has its own cautions
            lines += too_few(len(pairs_of(measured_rows(table), kind)), f"receivers of the kind {kind}")
    controls = [found[kind, CONTROL, ALL][0].value for kind in kinds if (kind, CONTROL, ALL) in found]
    controls = [value for value in controls if math.isfinite(value)]
    if controls and controls_are_exact(provenance):
        worst = max(controls, key=lambda value: abs(value - 1))
        verdict = "as it must be" if abs(worst - 1) < EXACT else "WHICH IT MUST NOT BE: do not trust the rest"
        lines.append(f"Control, {CONTROL} in all blocks: a share of {worst:.4f}, {verdict}.")
    return lines


def without_donor(table: pd.DataFrame, kind: str) -> list[str]:
    """Which receivers had no donor of the kind, and why."""
    of_kind = table[table["kind"] == kind]
    noted = of_kind[of_kind["note"].notna()]
    if "group" in table:
        noted = noted[noted["group"].isna()]
    lines = []
    for note, rows in noted.groupby("note"):
        tasks = ", ".join(dict.fromkeys(rows["task"]))
        lines.append(f"{kind}: {not_measured(str(note))} ({len(pairs_of(rows, kind))} receivers: {tasks}).")
    return lines


def controls_are_exact(provenance: Provenance) -> bool:
    """Whether all rows after the last block of every step were patched, which gives the donor's chunk."""
    checkpoint = provenance.settings["checkpoint"]
    every_step = len(provenance.settings["steps"]) == checkpoint["num_steps"]
    return every_step and checkpoint["num_layers"] - 1 in provenance.settings["blocks"]


def following(share: Estimate) -> str:
    """What the interval of a share allows to be said.

    Example:
        >>> following(Estimate(0.2, 0.1, 0.3))
        "the chunk goes 20.0 % of the way to the donor's (95 % interval 10.0 to 30.0)"
        >>> following(Estimate(-0.2, -0.3, -0.1))
        "the chunk goes away from the donor's, by 20.0 % of the way (95 % interval 10.0 to 30.0)"
        >>> following(Estimate(0.01, -0.02, 0.04))
        "the chunk was not found to follow; from -2.0 to 4.0 % of the way to the donor's is not excluded"
    """
    if math.isnan(share.value):
        return "donors and receivers act alike, so there is nothing to follow"
    value, low, high = 100 * share.value, 100 * share.low, 100 * share.high
    if math.isnan(low):
        return f"the chunk goes {value:.1f} % of the way to the donor's (one receiver, no interval)"
    if low > 0:
        return (
            f"the chunk goes {value:.1f} % of the way to the donor's (95 % interval {low:.1f} to {high:.1f})"
        )
    if high < 0:
        return (
            f"the chunk goes away from the donor's, by {-value:.1f} % of the way "
            f"(95 % interval {-high:.1f} to {-low:.1f})"
        )
    return (
        f"the chunk was not found to follow; from {low:.1f} to {high:.1f} % of the way to the donor's is not "
        "excluded"
    )
