"""The report's section on tokens changed at run time: the values of its template, figures and a table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from saccade_lab.study import figures
from saccade_lab.study.arms import NO_TOKENS, ROUNDING
from saccade_lab.study.section import Figure, Grid, Prose, Section, number, points, rate
from saccade_lab.study.statistics import Estimate, bootstrap, paired_difference, scaled, wilson
from saccade_lab.study.table import Provenance, truths

BASELINE = "as learned"
TWICE, TWICE_EQUAL = "every token twice", "every token twice, equal mass"


@dataclass(frozen=True)
class Result:
    """What the table shows about one arm."""

    rate: Estimate
    successes: str
    difference: Estimate
    change: Estimate
    largest: float


def results_of(table: pd.DataFrame) -> dict[str, Result]:
    """The results of every arm but the baseline, compared with it on the same episodes."""
    by_arm = {str(arm): rows.set_index(["task", "seed"]) for arm, rows in table.groupby("arm", sort=False)}
    baseline = truths(by_arm[BASELINE]["success"])
    found = {}
    for arm, rows in by_arm.items():
        success = truths(rows["success"])
        shared = success.index.intersection(baseline.index)
        if arm != BASELINE and len(shared):
            found[arm] = Result(
                wilson(int(success.sum()), len(success)),
                f"{int(success.sum())}/{len(success)}",
                paired_difference(success[shared].tolist(), baseline[shared].tolist()).difference,
                bootstrap(rows["chunk_change"].to_numpy(), list(rows.index)),
                float(rows["chunk_change_max"].max()),
            )
    return found


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report on closed-loop episodes."""
    results: Mapping[str, Result] = {}
    baseline = truths(table.loc[table["arm"] == BASELINE, "success"].dropna())
    if len(baseline) and not table["note"].notna().any():
        results = dict(sorted(results_of(table).items(), key=lambda item: arm_order(item[0])))
    prose = Prose(
        "resized",
        arms=[{"label": arm, "is_control": arm == TWICE_EQUAL, **vars(one)} for arm, one in results.items()],
        unmeasured="" if len(baseline) else NO_TOKENS,
        checkpoint=provenance.settings["checkpoint"],
        episodes=len(baseline),
        baseline=wilson(int(baseline.sum()), len(baseline)),
        rounding=ROUNDING,
    )
    if not results:
        return prose.section()
    differences = figures.estimates(
        list(results), [scaled(one.difference) for one in results.values()], "points", reference=0.0
    )
    changes = figures.estimates(
        list(results), [one.change for one in results.values()], "mean |change of an action|"
    )
    columns = ("arm", "successes", "success, %", "difference, points", "change of the chunk")
    rows = [
        [arm, one.successes, rate(one.rate), points(one.difference), number(one.change, digits=4)]
        for arm, one in results.items()
    ]
    return prose.section(
        [
            Figure("difference", prose.line("caption_difference"), differences),
            Figure("change", prose.line("caption_change"), changes),
        ],
        [Grid(prose.line("caption_arms"), columns, rows)],
    )


def arm_order(arm: str) -> tuple[bool, int, str]:
    """A key for sorting: fewer tokens first, repeated ones last."""
    size = arm.split()[0]
    return (not size.isdigit(), int(size) if size.isdigit() else 0, arm)
