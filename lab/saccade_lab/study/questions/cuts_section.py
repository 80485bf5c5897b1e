"""The report's section on cuts: the values of its template, its figures and its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from saccade_lab.study import figures
from saccade_lab.study.arms import ROUNDING, Arm
from saccade_lab.study.section import Figure, Grid, Prose, Section, not_measured, number, points, rate
from saccade_lab.study.statistics import (
    CONFIDENCE,
    Estimate,
    PairedDifference,
    bootstrap_ratio,
    detectable_difference,
    holm,
    paired_difference,
    scaled,
    verdict,
    wilson,
)
from saccade_lab.study.table import Provenance, truths

BASELINE, SHUFFLED = "none", "future-shuffled"
SHARES = (0.1, 0.25)  # of discordant pairs, for what can be detected


@dataclass(frozen=True)
class ArmResult:
    """What the table shows about one arm; None or NaN where it was not measured.

    Attributes:
        name: Name of the arm.
        rate, episodes: Success, and the number of episodes.
        pairs: The comparison with the unchanged policy.
        change: Mean absolute change of an action.
        note: Why it was not measured.
        corrected_p: P value of McNemar's test, corrected by Holm for all arms except the control.
    """

    name: str
    rate: Estimate
    episodes: int
    pairs: PairedDifference | None
    change: Estimate | None
    note: str | None
    corrected_p: float | None = None

    @property
    def doubtful(self) -> bool:
        """Whether it is better or worse by its own interval, but not after Holm's correction."""
        if self.pairs is None or self.corrected_p is None:
            return False
        differs = verdict(self.pairs.difference) in ("better", "worse")
        return differs and self.corrected_p >= 1 - CONFIDENCE


def section(arms: Mapping[str, Arm], table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report on closed-loop episodes.

    Args:
        arms: Arms by name, in the order of the report.
        table, provenance: Table of the study and its provenance.
    """
    results = arm_results(table, list(arms))
    labels = {name: arm.label for name, arm in arms.items()}
    measured = [result for result in results if result.episodes]
    compared = [result for result in measured if result.pairs is not None]
    pairs = min((result.pairs.pairs for result in compared if result.pairs), default=0)
    prose = Prose(
        "cuts",
        arms=[arms[result.name] for result in results],
        checkpoint=provenance.settings["checkpoint"],
        engine=provenance.settings["engine"],
        episodes=max(result.episodes for result in results),
        tasks=list(dict.fromkeys(table["task"])),
        results=[described(result, labels[result.name], table) for result in results],
        pairs=pairs,
        detectable=detectable(pairs) if pairs else [],
        rounding=ROUNDING,
    )
    grids = [arm_grid(prose, results, labels), task_grid(prose, table, measured, labels)]
    return prose.section(pictures(prose, measured, compared, labels), grids)


def described(result: ArmResult, label: str, table: pd.DataFrame) -> dict[str, Any]:
    """What a sentence on an arm needs."""
    changes = table.loc[table["arm"] == result.name, "chunk_change_max"] if result.note is None else None
    return {
        "label": label,
        "note": result.note,
        "is_control": result.name == SHUFFLED,
        "largest": None if changes is None else float(changes.max()),
        "difference": result.pairs.difference if result.pairs and result.change else None,
        "change": result.change,
        "doubtful": result.doubtful,
        "corrected_p": result.corrected_p,
        "lost": where_lost(table, result) if result.pairs else None,
    }


def detectable(pairs: int) -> list[tuple[str, str]]:
    """Percentages of discordant pairs, and the points that are then detectable; no points if nothing is."""
    found = [(share, detectable_difference(pairs, share)) for share in SHARES]
    return [
        (f"{100 * share:.0f}", f"{100 * least:.0f}" if np.isfinite(least) else "") for share, least in found
    ]


def arm_results(table: pd.DataFrame, order: Sequence[str]) -> list[ArmResult]:
    """One for each arm of the table, in the given order."""
    by_arm = {str(name): rows.set_index(["task", "seed"]) for name, rows in table.groupby("arm")}
    baseline = by_arm.get(BASELINE, pd.DataFrame(columns=["success"]))["success"].dropna()
    results = []
    for name in sorted(by_arm, key=order.index):
        rows = by_arm[name]
        measured = rows[rows["success"].notna()]
        note = None if len(measured) else str(rows["note"].iloc[0])
        success = truths(measured["success"])
        shared = success.index.intersection(baseline.index)
        pairs = None
        if name != BASELINE and len(shared):
            pairs = paired_difference(success.loc[shared].tolist(), truths(baseline.loc[shared]).tolist())
        change = None
        if name != BASELINE and len(measured):
            changes = measured["chunk_change"].to_numpy(dtype=float)
            change = bootstrap_ratio(changes, np.ones_like(changes), list(measured.index))
        results.append(
            ArmResult(name, wilson(int(success.sum()), len(success)), len(success), pairs, change, note)
        )
    p_values = {one.name: one.pairs.p_value for one in results if one.pairs and one.name != SHUFFLED}
    corrected = dict(zip(p_values, holm(list(p_values.values())), strict=True))
    return [replace(one, corrected_p=corrected.get(one.name)) for one in results]


def where_lost(table: pd.DataFrame, result: ArmResult) -> tuple[int, int, str] | None:
    """The task with more than half of the lost episodes: how many there, of how many; None without one."""
    success = table[table["success"].notna()].set_index(["task", "seed", "arm"])["success"]
    both = truths(success).unstack("arm")[[BASELINE, result.name]].dropna().astype(bool)
    lost = both.index[both[BASELINE] & ~both[result.name]].get_level_values("task").value_counts()
    if len(both.index.unique("task")) < 2 or lost.sum() < 3 or 2 * lost.iloc[0] <= lost.sum():
        return None
    return int(lost.iloc[0]), int(lost.sum()), str(lost.index[0])


def pictures(
    prose: Prose,
    measured: Sequence[ArmResult],
    compared: Sequence[ArmResult],
    labels: Mapping[str, str],
) -> list[Figure]:
    """Success, difference and change by arm."""
    found = []
    if measured:
        names = [labels[result.name] for result in measured]
        picture = figures.estimates(names, [scaled(result.rate) for result in measured], "success, %")
        found.append(Figure("success", prose.line("caption_success"), picture))
    if compared:
        names = [labels[result.name] for result in compared]
        differences = [scaled(result.pairs.difference) for result in compared if result.pairs]
        picture = figures.estimates(
            names, differences, "difference of success from the unchanged policy, points", reference=0.0
        )
        found.append(Figure("difference", prose.line("caption_difference"), picture))
        changes = [result.change for result in compared if result.change]
        picture = figures.estimates(names, changes, "mean |change of an action|", reference=0.0)
        found.append(Figure("change", prose.line("caption_change"), picture))
    return found


def arm_grid(prose: Prose, results: Sequence[ArmResult], labels: Mapping[str, str]) -> Grid:
    """All numbers by arm."""
    rows = []
    for result in results:
        cells = [labels[result.name]]
        if result.note is not None:
            cells += [not_measured(result.note)] + [""] * 6
        else:
            pairs = result.pairs
            cells += [
                f"{round(result.rate.value * result.episodes)}/{result.episodes}",
                rate(result.rate),
                "" if pairs is None else points(pairs.difference),
                "" if pairs is None else f"{pairs.only_second} / {pairs.only_first}",
                "" if pairs is None else f"{pairs.p_value:.2g}",
                "" if result.corrected_p is None else f"{result.corrected_p:.2g}",
                "" if result.change is None else number(result.change, digits=4),
            ]
        rows.append(cells)
    columns = (
        "arm",
        "successes",
        "success, %",
        "difference, points",
        "lost / won",
        "p",
        "p corrected",
        "change of the chunk",
    )
    return Grid(prose.line("caption_arms"), columns, rows)


def task_grid(
    prose: Prose, table: pd.DataFrame, measured: Sequence[ArmResult], labels: Mapping[str, str]
) -> Grid:
    """Successes by arm and task."""
    tasks = list(dict.fromkeys(table["task"]))
    rows = []
    for result in measured:
        of_arm = table[(table["arm"] == result.name) & table["success"].notna()]
        counts = [truths(of_arm.loc[of_arm["task"] == task, "success"]) for task in tasks]
        rows.append([labels[result.name], *(f"{int(found.sum())}/{len(found)}" for found in counts)])
    return Grid(prose.line("caption_tasks"), ("arm", *tasks), rows)
