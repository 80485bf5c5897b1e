"""The report's section on patching: the values of its template, its figures and its table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from saccade.head.intervention import ROW_GROUPS
from saccade_lab.study import figures
from saccade_lab.study.changes import recorded
from saccade_lab.study.section import Figure, Grid, Prose, Section, number
from saccade_lab.study.statistics import Estimate, bootstrap_ratio
from saccade_lab.study.table import Provenance, clusters_of, is_recorded

ALL = "all"  # every block at once
CONTROL = "all rows"
SAME = 1e-6  # a squared distance between two chunks that are equal up to rounding
EXACT = 1e-3  # how far from 1 the control may be

# What the donor's observation has that the receiver's has not.
KINDS = {
    "layout": "the same task and instruction, object and goal elsewhere",
    "words": "the same picture with the instruction of another task on the same objects",
    "task": "another task: other objects, another instruction",
}
FROM_FILE = "observation"
WITH_INSTRUCTION, WITH_FRAMES = "instruction", "frames"
ABOUT = {
    **KINDS,
    FROM_FILE: "an observation of another episode, same embodiment",
    WITH_INSTRUCTION: "the same pictures and state, with the other instruction",
    WITH_FRAMES: "the observation in the same place of the other directory, with its state",
}
GROUPS: dict[str, tuple[str, ...]] = {
    "future": ("future",),
    "state": ("state",),
    "action": ("action",),
    CONTROL: ROW_GROUPS,
}
#: Kind of donor, group of rows and block -> share of the way, size and number of pairs.
Found: TypeAlias = Mapping[tuple[str, str, str], tuple[Estimate, float, int]]


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    measured = measured_rows(table)
    found: dict[tuple[str, str, str], tuple[Estimate, float, int]] = {}
    if len(measured):
        for (kind, group, block), rows in measured.groupby(["kind", "group", "block"]):
            found[str(kind), str(group), str(block)] = (*shares(rows), len(rows))
    kinds = [kind for kind in ABOUT if kind in set(table["kind"])]
    on_file = is_recorded(provenance)
    prose = Prose(
        "patching",
        recorded=recorded(table, measured, provenance) if on_file else None,
        checkpoint=provenance.settings["checkpoint"],
        blocks=provenance.settings["blocks"],
        steps=provenance.settings["steps"],
        kinds=[described(kind, table, found, on_file) for kind in kinds],
        control=control(found, provenance, kinds),
        control_name=CONTROL,
    )
    return prose.section(pictures(prose, found, provenance, kinds), [grid(prose, found, provenance, kinds)])


def described(kind: str, table: pd.DataFrame, found: Found, on_file: bool) -> dict[str, Any]:
    """What the sentences on a kind of donor need."""
    measured = measured_rows(table)
    pairs = len(pairs_of(measured, kind))
    squares = measured.loc[measured["kind"] == kind, "squared_way"] if len(measured) else measured
    has_any = any(known == kind for known, _, _ in found)
    shares_by_group: list[tuple[str, Estimate | None]] = []
    for group in ("future", "state"):
        if (kind, group, ALL) in found:
            shares_by_group.append((group, found[kind, group, ALL][0]))
        elif has_any:  # there were pairs, but the head has no such rows
            shares_by_group.append((group, None))
    first = found.get((kind, "future", "0"))
    return {
        "name": kind,
        "about": ABOUT[kind],
        "pairs": pairs,
        "way": float(np.sqrt(squares).mean()) if len(squares) else None,
        "without_donor": without_donor(table, kind),
        "groups": shares_by_group,
        "first_block": None if first is None else first[0],
        "receivers": pairs if has_any and not on_file else None,  # a recording has its own cautions
    }


def control(found: Found, provenance: Provenance, kinds: Sequence[str]) -> dict[str, Any] | None:
    """The control that is furthest from 1, if it should be exact; None without one."""
    values = [found[kind, CONTROL, ALL][0].value for kind in kinds if (kind, CONTROL, ALL) in found]
    values = [value for value in values if math.isfinite(value)]
    if not values or not controls_are_exact(provenance):
        return None
    worst = max(values, key=lambda value: abs(value - 1))
    return {"value": worst, "is_exact": abs(worst - 1) < EXACT}


def shares(rows: pd.DataFrame) -> tuple[Estimate, float]:
    """How far the chunks moved towards the donors', over all pairs, and how far in any direction.

    Returns:
        The share of the way to the donors' chunks, each pair weighted by its squared distance, with a
        bootstrap interval over receivers. And the root of the summed squared changes divided by the summed
        squared distances.
    """
    rows = rows[rows["squared_way"] >= SAME]
    receivers = clusters_of(rows)
    way = rows["squared_way"].to_numpy(dtype=float)
    share = bootstrap_ratio(rows["toward"], way, receivers)
    size = math.sqrt(rows["squared_change"].sum() / way.sum()) if len(way) else math.nan
    return share, size


def measured_rows(table: pd.DataFrame) -> pd.DataFrame:
    """The rows that contain numbers and not a note."""
    return table[table["note"].isna()] if "group" in table else table.iloc[:0]


def pairs_of(rows: pd.DataFrame, kind: str) -> pd.DataFrame:
    """Receivers that had a donor of that kind, each once."""
    return rows.loc[rows["kind"] == kind, ["task", "seed"]].drop_duplicates()


def without_donor(table: pd.DataFrame, kind: str) -> list[dict[str, Any]]:
    """Why receivers had no donor of that kind: the reason, how many receivers, and their tasks."""
    of_kind = table[table["kind"] == kind]
    noted = of_kind[of_kind["note"].notna()]
    if "group" in table:
        noted = noted[noted["group"].isna()]
    return [
        {"note": note, "receivers": len(pairs_of(rows, kind)), "tasks": list(dict.fromkeys(rows["task"]))}
        for note, rows in noted.groupby("note")
    ]


def controls_are_exact(provenance: Provenance) -> bool:
    """Whether all rows after the last block were patched in every step, which gives the donor's chunk."""
    checkpoint = provenance.settings["checkpoint"]
    every_step = len(provenance.settings["steps"]) == checkpoint["num_steps"]
    return every_step and checkpoint["num_layers"] - 1 in provenance.settings["blocks"]


def pictures(
    prose: Prose,
    found: Found,
    provenance: Provenance,
    kinds: Sequence[str],
) -> list[Figure]:
    """Shares with all blocks patched, and for each kind of donor block by block."""
    # The actions are computed from the action rows after the last block only.
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
        drawn.append(Figure("together", prose.line("caption_together"), picture))
    blocks = [int(block) for block in provenance.settings["blocks"]]
    for kind in kinds:
        series = {
            group: [found[kind, group, str(block)][0] for block in blocks]
            for group in GROUPS
            if (kind, group, str(blocks[0])) in found
        }
        if series:
            picture = figures.lines(blocks, series, "patched after block", "share of the way", reference=0.0)
            caption = prose.line("caption_blocks", kind, ABOUT[kind])
            drawn.append(Figure(f"blocks-{kind}", caption, picture))
    return drawn


def grid(
    prose: Prose,
    found: Found,
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
    return Grid(prose.line("caption_all"), columns, rows)
