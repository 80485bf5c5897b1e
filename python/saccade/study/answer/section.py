"""The report's section of `saccade study answer`: a few sentences, a figure, tables by stage."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade.study import figures
from saccade.study.answer.arms import ARMS
from saccade.study.answer.contrasts import ALL, MARGIN
from saccade.study.answer.measured_section import of_measured
from saccade.study.answer.measures import CUT, NAMES
from saccade.study.answer.plan import PILOT
from saccade.study.answer.results import (
    CORE_STAGE,
    Change,
    ContrastResult,
    Judged,
    Pilot,
    Relation,
    changes,
    confirmed,
    explored,
    judged,
    pilots,
    relations,
)
from saccade.study.section import Figure, Grid, Prose, Section, number, points
from saccade.study.sign_flip import sign_flip
from saccade.study.statistics import Estimate, scaled
from saccade.study.table import Provenance


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report.

    Args:
        table: Table of the study.
        provenance: Its provenance, whose settings say which episodes every policy runs.
    """
    tasks, seeds = provenance.settings["tasks"], provenance.settings["episodes"]
    of_pilots = [pilot_grid(found, tasks) for found in [pilots(table)] if found]
    trained = table[table["kind"] == "training"]
    trained = trained[trained["stage"] != PILOT] if len(trained) else trained
    if trained.empty:
        return Prose("answer", **EMPTY).section(grids=of_pilots)
    found = judged(table, tasks, seeds)
    tests, others = confirmed(found), explored(found)
    by_recipe = trained.groupby("recipe")["validation_loss"].mean()
    losses = {str(recipe): float(loss) for recipe, loss in by_recipe.items()}
    prose = Prose(
        "answer",
        tests=tests,
        explored=others,
        missing=found.missing,
        means={recipe: mean_of(rates) for recipe, rates in found.rates.items()},
        counts={recipe: len(rates) for recipe, rates in found.rates.items()},
        margin=f"{100 * MARGIN:.0f}",
        tasks=tasks,
        episodes=len(tasks) * len(seeds),
    )
    grids = [test_grid(prose, tests), policy_grid(prose, found, losses)]
    for place, (stage, results) in enumerate(others.items(), start=3):
        grids.append(contrast_grid(prose.line("caption_contrasts", place, stage), results))
    for stage, arms in ARMS.items():
        names = [arm.name for arm in arms]
        of_stage = [one for one in changes(table, found, tasks, seeds) if one.arm in names]
        if of_stage:
            grids.append(change_grid(prose.line("caption_changes", len(grids) + 1, stage), of_stage, names))
    related = relations(table, found, tasks, seeds)
    if related:
        of_core = relations(table, found, tasks, seeds, [CORE_STAGE])
        grids.append(relation_grid(prose.line("caption_relations", len(grids) + 1, CUT), of_core, related))
    shown = {recipe: found.rates[recipe] for recipe in ALL if recipe in found.rates}
    pictures = [Figure("success", prose.line("caption_success"), success_picture(shown))] if shown else []
    more_pictures, more_grids = of_measured(table, len(grids) + 1)
    return prose.section(pictures + more_pictures, grids + more_grids + of_pilots)


#: The values of the template where nothing is trained.
EMPTY = {
    "tests": [],
    "explored": {},
    "missing": [],
    "means": {},
    "counts": {},
    "margin": f"{100 * MARGIN:.0f}",
    "tasks": [],
    "episodes": 0,
}


def mean_of(rates: Mapping[int, float]) -> Estimate:
    """The mean over training seeds, with the interval of `sign_flip`."""
    return sign_flip(list(rates.values())).difference


def success_picture(shown: Mapping[str, Mapping[int, float]]) -> Picture:
    """Success over N: a line for each training seed, and the mean with its interval.

    Args:
        shown: Success by recipe of `ALL` and training seed.
    """
    picture, (axes,) = figures.new_picture(height=3.6)
    places = {recipe: place for place, recipe in enumerate(shown)}
    for seed in sorted({seed for rates in shown.values() for seed in rates}):
        have = [recipe for recipe in shown if seed in shown[recipe]]
        values = [100 * shown[recipe][seed] for recipe in have]
        axes.plot([places[one] for one in have], values, color="0.6", linewidth=0.9, marker="o", markersize=3)
    means = [scaled(mean_of(rates)) for rates in shown.values()]
    middle = np.array([mean.value for mean in means])
    bounds = np.array([[mean.low, mean.high] for mean in means]).T
    reach = np.nan_to_num(np.abs(bounds - middle))
    beside = np.arange(len(means)) + 0.08  # so that the bars do not cover the dots
    style: dict[str, Any] = {"linewidth": 2, "marker": "s", "markersize": 6, "capsize": 4, "zorder": 3}
    axes.errorbar(beside, middle, reach, color="black", **style)
    axes.set_xticks(list(places.values()), [str(ALL[recipe]) for recipe in shown])
    axes.set_xlabel("number of future tokens, N")
    axes.set_ylabel("success, %")
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    return picture


def policy_grid(prose: Prose, found: Judged, losses: Mapping[str, float]) -> Grid:
    """Success of every policy, recipe by recipe."""
    seeds = sorted({seed for rates in found.rates.values() for seed in rates})
    lines = []
    for recipe, rates in found.rates.items():
        shown = [f"{100 * rates[seed]:.1f}" if seed in rates else "" for seed in seeds]
        lines.append([recipe, points(mean_of(rates)), f"{losses[recipe]:.4f}", *shown])
    columns = ("recipe", "mean, %", "held-out loss", *(f"seed {seed}" for seed in seeds))
    return Grid(prose.line("caption_policies"), columns, lines)


def test_grid(prose: Prose, tests: Sequence[ContrastResult]) -> Grid:
    """The confirmatory tests."""
    lines = []
    for one in tests:
        numbers = ["", "", ""]
        if one.test is not None and one.corrected is not None:
            numbers = [percent(one), f"{one.test.p_value:.4f}", f"{one.corrected:.4f}"]
        lines.append([one.contrast.name, str(len(one.seeds)), *numbers, one.finding])
    columns = ("contrast", "pairs", "points (95 % interval)", "p", "p after Holm", "finding")
    return Grid(prose.line("caption_tests"), columns, lines)


def contrast_grid(caption: str, results: Sequence[ContrastResult]) -> Grid:
    """The exploratory contrasts of a stage."""
    lines = [[one.contrast.name, str(len(one.seeds)), percent(one), one.finding] for one in results]
    return Grid(caption, ("contrast", "pairs", "points (95 % interval)", "finding"), lines)


def change_grid(caption: str, changed: Sequence[Change], arms: Sequence[str]) -> Grid:
    """What the arms of a stage change: a row for each recipe, a column for each arm."""
    lines = []
    for recipe in dict.fromkeys(one.recipe for one in changed):
        by_arm = {one.arm: points(one.test.difference) for one in changed if one.recipe == recipe}
        lines.append([recipe, *(by_arm.get(arm, "") for arm in arms)])
    return Grid(caption, ("recipe", *arms), lines)


def relation_grid(caption: str, of_core: Sequence[Relation], of_all: Sequence[Relation]) -> Grid:
    """What the measures predict, over the policies of the core and over all: a row for each."""
    core = {one.measure: one for one in of_core}
    lines = []
    for one in of_all:
        shown = [
            [str(found.policies), number(found.correlation, digits=2)] if found else ["0", ""]
            for found in (core.get(one.measure), one)
        ]
        lines.append([NAMES[one.measure], *itertools.chain.from_iterable(shown)])
    numbers = "rank correlation (95 % interval)"
    return Grid(caption, ("measure", "of the core", numbers, "of all", numbers), lines)


def pilot_grid(found: Sequence[Pilot], tasks: Sequence[str]) -> Grid:
    """The pilots: a row for each policy, a column for each task."""
    lines = []
    for one in found:
        rates = [f"{100 * one.rates[task]:.0f}" if task in one.rates else "" for task in tasks]
        lines.append([one.policy, f"{one.loss:.4f}", *rates])
    return Grid(Prose("answer").line("caption_pilots"), ("policy", "held-out loss", *tasks), lines)


def percent(result: ContrastResult) -> str:
    """A contrast in percentage points with its interval."""
    assert result.test is not None
    return number(scaled(result.test.difference), digits=1)
