"""The report's section on probes: the values of its template, its figures and its tables."""

from __future__ import annotations

from typing import Any

import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade.head.intervention import ROW_GROUPS
from saccade_lab.study import figures
from saccade_lab.study.linear_probes import FOLDS, PROPRIO, VL, Input
from saccade_lab.study.section import Figure, Grid, Prose, Section, number
from saccade_lab.study.statistics import Estimate
from saccade_lab.study.table import Provenance

SEEN = ("object", "goal")  # targets that are not in the proprioception
ALL_TASKS = "all"


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    probes = table[table["kind"] == "probe"]
    scope = "" if probes.empty else str(probes["task"].iloc[0])
    if (probes["task"] == ALL_TASKS).any():
        scope = ALL_TASKS
    chosen = probes[probes["task"] == scope]
    has_future = bool(len(chosen)) and bool((chosen["rows"] == "future").any())
    prose = Prose(
        "probes",
        measured=not probes.empty,
        has_future=has_future,
        checkpoint=provenance.settings["checkpoint"],
        episodes=0 if probes.empty else int(probes["episodes"].max()),
        frames=0 if probes.empty else int(probes["frames"].max()),
        step=provenance.settings["step"],
        folds=FOLDS,
        targets=[described(chosen, target) for target in SEEN] if has_future else [],
    )
    if probes.empty:
        return prose.section()
    pictures = [
        Figure(
            str(target),
            prose.line("caption_target", target),
            block_picture(chosen[chosen["target"] == target]),
        )
        for target in chosen["target"].unique()
    ]
    return prose.section(pictures, [input_grid(prose, chosen, scope), task_grid(prose, probes)])


def described(rows: pd.DataFrame, target: str) -> dict[str, Any]:
    """What a sentence on a target needs: whether the future rows carry it, and from which block on."""
    of_target = rows[rows["target"] == target]
    if of_target.empty:
        return {"target": target, "is_still": True}
    future = of_target[(of_target["rows"] == "future") & (of_target["tokens"] == "mean")]
    future = future.sort_values("block")
    carries = (future["over_proprio_low"] > 0) & (future["r2_low"] > future["shuffled_high"])
    shown = future[carries].head(1) if carries.any() else future.sort_values("r2").tail(1)
    block = int(shown["block"].iloc[0])
    found: dict[str, Any] = {
        "target": target,
        "is_still": False,
        "blocks": [int(number) for number in future.loc[carries, "block"]],
        "block": block,
        "gain": one_of(shown, "over_proprio"),
    }
    if carries.any():
        found |= {
            "r2": one_of(shown),
            "over_vl": one_of(shown, "over_vl"),
            "shuffled": one_of(shown, "shuffled"),
            "state": one_of(of_input(of_target, ("state", block, "all"))),
            "last": one_of(future.tail(1)),
        }
    return found


def one_of(rows: pd.DataFrame, column: str = "r2") -> Estimate:
    """The estimate in the first of the rows."""
    row = rows.iloc[0]
    return Estimate(float(row[column]), float(row[f"{column}_low"]), float(row[f"{column}_high"]))


def of_input(rows: pd.DataFrame, source: Input) -> pd.DataFrame:
    """The rows of one input."""
    name, block, tokens = source
    return rows[(rows["rows"] == name) & (rows["block"] == block) & (rows["tokens"] == tokens)]


def block_picture(rows: pd.DataFrame) -> Picture:
    """R² of one target over the blocks."""
    blocks = sorted(int(block) for block in rows["block"].unique() if block >= 0)
    series = {}
    for group in ROW_GROUPS:
        for tokens in ("all", "mean"):
            if not of_input(rows, (group, blocks[0], tokens)).empty:
                name = group if group == "state" else f"{group} ({tokens})"
                series[name] = [one_of(of_input(rows, (group, block, tokens))) for block in blocks]
    for source, name in ((VL, "vl_embs"), (PROPRIO, "proprioception")):
        series[name] = [one_of(of_input(rows, source))] * len(blocks)
    picture = figures.lines(blocks, series, "after block", "R² on held-out episodes", reference=0)
    legend = picture.axes[0].get_legend()
    assert legend is not None
    legend.remove()  # it would cover lines; there is room below the plot
    picture.legend(loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    return picture


def input_grid(prose: Prose, rows: pd.DataFrame, scope: str) -> Grid:
    """All inputs and targets, of one task or of all together."""
    targets = list(rows["target"].unique())
    lines = []
    for source in rows[["rows", "block", "tokens"]].drop_duplicates().itertuples(index=False):
        found = of_input(rows, tuple(source)).set_index("target")
        where = "input" if source[1] < 0 else f"block {int(source[1])}"
        values = [number(one_of(found.loc[[target]]), digits=2) for target in targets]
        controls = "; ".join(f"{found.loc[target, 'shuffled']:.2f}" for target in targets)
        lines.append([str(source[0]), where, str(source[2]), *values, controls])
    return Grid(
        prose.line("caption_inputs", scope),
        ("rows", "after", "tokens", *targets, "shuffled"),
        lines,
    )


def task_grid(prose: Prose, probes: pd.DataFrame) -> Grid:
    """R² of object and goal by task: from the hand, from the best block of future rows, from the tokens."""
    lines = []
    for (task, target), rows in probes.groupby(["task", "target"], sort=False):
        if target not in SEEN:
            continue
        future = rows[(rows["rows"] == "future") & (rows["tokens"] == "mean")]
        best = future.sort_values("r2").tail(1)
        lines.append(
            [
                str(task),
                str(target),
                f"{100 * float(rows['spread'].iloc[0]):.1f}",
                number(one_of(of_input(rows, PROPRIO)), digits=2),
                f"{number(one_of(best), digits=2)}, block {int(best['block'].iloc[0])}"
                if len(best)
                else "no tokens",
                number(one_of(of_input(rows, VL)), digits=2),
            ]
        )
    columns = ("task", "target", "spread", "proprioception", "future rows", "vl_embs")
    return Grid(prose.line("caption_tasks"), columns, lines)
