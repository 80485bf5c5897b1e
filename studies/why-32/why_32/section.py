"""The report's section: a few sentences, a figure, tables by stage."""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from saccade.errors import InputError
from saccade_lab.study import figures
from saccade_lab.study.section import Figure, Grid, Prose, number, points
from saccade_lab.study.sign_flip import sign_flip
from saccade_lab.study.statistics import Estimate, scaled
from saccade_lab.study.table import Provenance
from why_32 import report
from why_32.arms import ARMS
from why_32.contrasts import CORE, LONGER, MARGIN, NEW_SEEDS, SCALED
from why_32.measured_section import of_measured
from why_32.measures import CUT, MEASURES, NAMES
from why_32.plan import CORE_STAGE, Plan
from why_32.relations import Relation, relations
from why_32.report import Answered
from why_32.results import (
    PLATEAU,
    Change,
    ContrastResult,
    Judged,
    Losses,
    Pilot,
    Progress,
    changes,
    confirmed,
    explored,
    judged,
    judged_by_task,
    losses,
    over_seeds,
    pilots,
    progress,
    stopped,
)

#: What the sentences of the answer are about, beside the tests: names of exploratory contrasts, and recipes
#: under arms.
CONTRASTS = (
    "n-32-scaled minus n-0-scaled",
    "n-32-scaled minus n-4-scaled",
    "n-32-long minus n-0-long, new six: tested",
    "n-32-long minus n-0-long, all twelve: estimate",
)
CHANGED = (("n-4", CUT), ("n-32", CUT), ("n-32", "1 merged"), ("n-32", "mass of 4"))


def section(table: pd.DataFrame, provenance: Provenance, plan: Plan) -> Answered:
    """The report's section.

    Args:
        table: Table of the study.
        provenance: Its provenance, whose settings say which episodes every policy runs.
        plan: The plan, which says which policies there should be.

    Raises:
        InputError: The core is not complete, before which nothing is judged, or what the answer is about was
            not measured.
    """
    tasks, seeds = provenance.settings["tasks"], provenance.settings["episodes"]
    found = judged(table, tasks, seeds)
    stages = progress(table, found, plan, tasks, seeds)
    core = next(one for one in stages if one.stage == CORE_STAGE)
    tests, others = confirmed(found), explored(found)
    changed = changes(table, found, tasks, seeds)
    contrasts = {one.contrast.name: (one, stage) for stage, of in others.items() for one in of}
    arms = {(one.recipe, one.arm): one for one in changed}
    everywhere = relations(table, found, tasks, seeds)
    related = relations(table, found, tasks, seeds, [CORE_STAGE])
    check_complete(core, contrasts, arms, related)
    of_stages = {stage: [arm.name for arm in of_stage] for stage, of_stage in ARMS.items()}
    by_stage = {stage: [one for one in changed if one.arm in of_stages[stage]] for stage in of_stages}
    by_stage = {stage: of_stage for stage, of_stage in by_stage.items() if of_stage}
    names = ["tests", "policies", *others, *by_stage, MEASURES]
    places = {name: place for place, name in enumerate(names, start=1)}
    of_core, by_task = losses(table, found), judged_by_task(table, tasks, seeds)
    prose = report.prose(
        "answer",
        **known_facts(plan, found, core, tasks, seeds),
        places=places,
        tests=tests,
        arms=arms,
        contrasts=contrasts,
        related=related,
        of_loss=of_core.correlation,
        stopped=functools.partial(stopped, table),
        **functions(plan, contrasts),
    )
    grids = [test_grid(prose, tests, by_task), policy_grid(prose, found, by_task, table)]
    for stage, compared in others.items():
        grids.append(contrast_grid(prose.line("caption_contrasts", places[stage], stage), compared, by_task))
    for stage, of_stage in by_stage.items():
        caption = prose.line("caption_changes", places[stage], stage)
        grids.append(change_grid(caption, of_stage, of_stages[stage]))
    grids.append(relation_grid(prose.line("caption_relations", places[MEASURES], CUT), related, everywhere))
    pictures, more_grids, above = of_measured(table, len(grids) + 1)
    grids += more_grids
    grids.append(progress_grid(prose.line("caption_progress", len(grids) + 1), stages))
    of_success = Figure("success", prose.line("caption_success"), success_picture(found))
    of_loss = Figure("losses", prose.line("caption_losses"), loss_picture(of_core))
    return Answered(
        title=prose.line("title"),
        summary=prose.paragraphs("summary"),
        figures=[of_success, of_loss, *pictures],
        grids=[*grids, pilot_grid(pilots(table), tasks)],
        not_shown=prose.points("not_shown"),
        answer=prose.points("answer"),
        commands=COMMANDS,
        reproduction=prose.paragraphs("reproduction"),
        comparisons=prose.points("comparisons"),
        above={"losses": f"Table {places['policies']}", **above},
    )


def check_complete(
    core: Progress,
    contrasts: Collection[str],
    arms: Collection[tuple[str, str]],
    related: Sequence[Relation],
) -> None:
    """Refuses a table without all that the answer is about; arguments as `section` has them.

    Raises:
        InputError: The core is not complete, or something is missing.
    """
    if core.done != core.planned:
        raise InputError(
            f"the table has {core.done} policies of the core with all episodes, expected {core.planned}"
        )
    lacking = [name for name in CONTRASTS if name not in contrasts]
    lacking += [" ".join(one) for one in CHANGED if one not in arms]
    lacking += [] if related else [MEASURES]
    if lacking:
        raise InputError(f"the table lacks {', '.join(lacking)}")


COMMANDS = ("python -m why_32 run --out DIR", "python -m why_32 report DIR")


def known_facts(
    plan: Plan, found: Judged, core: Progress, tasks: Sequence[str], seeds: Sequence[int]
) -> dict[str, Any]:
    """The values of the template that are no results."""
    policies = list(plan.policies(CORE_STAGE))
    return {
        "tasks": tasks,
        "episodes": len(tasks) * len(seeds),
        "margin": f"{100 * MARGIN:.0f}",
        "labels": NAMES,
        "planned": core.planned,
        "core": sorted({one.training.num_future_tokens for one in policies}),
        "num_seeds": len({one.seed for one in policies}),
        "head": policies[0].training,
        "scaled": next((one.training for one in plan.recipes if one.stage == "scaled"), None),
        "longer": next((one.training for one in plan.recipes if one.name in LONGER), None),
        "new_seeds": NEW_SEEDS,
        "plateau": PLATEAU,
        "counts": CORE,
        "backbone": policies[0].backbone.training,
        "missing": found.missing,
    }


def functions(plan: Plan, contrasts: Mapping[str, tuple[ContrastResult, str]]) -> dict[str, Any]:
    """The functions of the template.

    Args:
        plan: The plan of the study.
        contrasts: The exploratory contrasts and their stages, by name.
    """

    def stages_of(recipes: Collection[str]) -> str:
        """The stages that train recipes, as the command takes them."""
        return ",".join(dict.fromkeys(one.stage for one in plan.recipes if one.name in recipes))

    def findings(names: Collection[str]) -> Counter[str]:
        """How often contrasts have each finding."""
        return Counter(contrasts[name][0].finding for name in names)

    def stages_with(names: Collection[str]) -> list[str]:
        """The stages in whose tables contrasts are."""
        return list(dict.fromkeys(stage for name, (_, stage) in contrasts.items() if name in names))

    return {"stages_of": stages_of, "findings": findings, "stages_with": stages_with}


def mean_losses(table: pd.DataFrame) -> dict[str, float]:
    """The mean held-out loss of each recipe."""
    by_recipe = table[table["kind"] == "training"].groupby("recipe")["validation_loss"].mean()
    return {str(recipe): float(loss) for recipe, loss in by_recipe.items()}


def mean_of(rates: Mapping[int, float]) -> Estimate:
    """The mean over training seeds, with the interval of `sign_flip`."""
    return sign_flip(list(rates.values())).difference


def success_picture(found: Judged) -> Picture:
    """Success over N: in the core, with larger first weights, and with longer training.

    What is not there is left out. There is a line for each training seed, and the means with their intervals,
    filled in the core.
    """
    plots = {"core": CORE, "scaled (exploratory)": SCALED, "longer (exploratory)": LONGER}
    plots = {title: {one: n for one, n in of.items() if one in found.rates} for title, of in plots.items()}
    plots = {title: counts for title, counts in plots.items() if counts}
    picture, all_axes = figures.new_picture(height=4.0, columns=len(plots))
    for axes, (title, counts) in zip(all_axes, plots.items(), strict=True):
        in_core = counts.keys() <= CORE.keys()
        show_success(axes, {recipe: found.rates[recipe] for recipe in counts}, filled=in_core)
        axes.set_xticks(range(len(counts)), [str(count) for count in counts.values()])
        axes.set_xlim(-0.5, len(counts) - 0.5)
        axes.set_xlabel("future tokens, N")
        axes.set_title(title, fontsize="medium")
    all_axes[0].set_ylabel("success, %")
    return picture


def show_success(axes: Axes, shown: Mapping[str, Mapping[int, float]], *, filled: bool) -> None:
    """Draws the success of recipes from left to right.

    Args:
        axes: Where.
        shown: Success by recipe and training seed.
        filled: Whether the squares of the means are filled.
    """
    places = {recipe: place for place, recipe in enumerate(shown)}
    for seed in sorted({seed for rates in shown.values() for seed in rates}):
        have = [recipe for recipe in shown if seed in shown[recipe]]
        values = [100 * shown[recipe][seed] for recipe in have]
        axes.plot([places[one] for one in have], values, color="0.6", linewidth=0.9, marker="o", markersize=3)
    style: dict[str, Any] = {"color": "black", "linewidth": 2, "markersize": 7, "capsize": 4, "zorder": 3}
    for recipe, rates in shown.items():
        mean = scaled(mean_of(rates))
        reach = np.nan_to_num([[mean.value - mean.low], [mean.high - mean.value]])
        inner = "black" if filled else "white"
        beside = places[recipe] + 0.1  # so that the bars do not cover the dots
        axes.errorbar([beside], [mean.value], reach, marker="s", markerfacecolor=inner, **style)
    axes.set_ylim(0, 100)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)


def loss_picture(of_core: Losses) -> Picture:
    """Success of the core's policies over their held-out loss; N by the form of the dots."""
    picture, (axes,) = figures.new_picture(height=3.6)
    fills = ("white", "0.6", "black")
    for (recipe, pairs), marker, fill in zip(of_core.policies.items(), "o^s", fills, strict=False):
        style: dict[str, Any] = {"marker": marker, "facecolors": fill, "edgecolors": "black", "zorder": 3}
        axes.scatter(pairs[:, 0], 100 * pairs[:, 1], s=36, label=f"N = {CORE[recipe]}", **style)
    axes.axvline(PLATEAU, color="0.5", linewidth=1, linestyle=":")
    axes.set_xlabel("held-out loss")
    axes.set_ylim(0, 100)
    axes.set_ylabel("success, %")
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.legend(frameon=False)
    return picture


def policy_grid(prose: Prose, found: Judged, by_task: Mapping[str, Judged], table: pd.DataFrame) -> Grid:
    """Success of every policy, recipe by recipe, the means in each task, and the held-out losses."""
    losses = mean_losses(table)
    seeds = sorted({seed for rates in found.rates.values() for seed in rates})
    lines = []
    for recipe, rates in found.rates.items():
        shown = [f"{100 * rates[seed]:.1f}" if seed in rates else "" for seed in seeds]
        means = [points(mean_of(one.rates[recipe])) for one in by_task.values()]
        of_loss = [f"{losses[recipe]:.4f}", "{} of {}".format(*stopped(table, [recipe]))]
        lines.append([recipe, points(mean_of(rates)), *means, *of_loss, *shown])
    of_loss = ["held-out loss", f"above {PLATEAU:g}"]
    columns = ("recipe", "mean, %", *by_task, *of_loss, *(f"seed {seed}" for seed in seeds))
    return Grid(prose.line("caption_policies", 2), columns, lines)


def test_grid(prose: Prose, tests: Sequence[ContrastResult], by_task: Mapping[str, Judged]) -> Grid:
    """The confirmatory tests, and the same contrasts in each task alone."""
    lines = []
    for one in tests:
        numbers = ["", "", ""]
        if one.test is not None and one.corrected is not None:
            numbers = [percent(one), f"{one.test.p_value:.4f}", f"{one.corrected:.4f}"]
        of_tasks = in_tasks(one, by_task)
        lines.append([one.contrast.name, str(len(one.seeds)), *numbers, one.finding, *of_tasks])
    columns = ("contrast", "pairs", "points (95 % interval)", "p", "p after Holm", "finding", *by_task)
    return Grid(prose.line("caption_tests", 1), columns, lines)


def contrast_grid(caption: str, results: Sequence[ContrastResult], by_task: Mapping[str, Judged]) -> Grid:
    """The exploratory contrasts of a stage, together and in each task alone; p values if there are tests."""
    tested = any(one.contrast.use == "test" for one in results)
    lines = []
    for one in results:
        p_values = [p_value(one)] if tested else []
        numbers = [str(len(one.seeds)), percent(one), *p_values, one.finding]
        lines.append([one.contrast.name, *numbers, *in_tasks(one, by_task)])
    p_column = ["p"] if tested else []
    columns = ("contrast", "pairs", "points (95 % interval)", *p_column, "finding", *by_task)
    return Grid(caption, columns, lines)


def p_value(result: ContrastResult) -> str:
    """The p value of a contrast with a test of its own; nothing for others."""
    return f"{result.test.p_value:.4f}" if result.test and result.contrast.use == "test" else ""


def in_tasks(result: ContrastResult, by_task: Mapping[str, Judged]) -> list[str]:
    """The same contrast in each task alone."""
    alone = [over_seeds(found, result.contrast) for found in by_task.values()]
    return [percent(one) if one.test is not None else "" for one in alone]


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
            [str(found.policies), *(number(each, digits=2) for each in (found.within, found.together))]
            if found
            else ["0", "", ""]
            for found in (core.get(one.measure), one)
        ]
        lines.append([NAMES[one.measure], *itertools.chain.from_iterable(shown)])
    numbers = ("within recipes (95 % interval)", "of all N together")
    return Grid(caption, ("measure", "of the core", *numbers, "of all", *numbers), lines)


def progress_grid(caption: str, stages: Sequence[Progress]) -> Grid:
    """How much is there: a row for each stage."""
    lines = [[one.stage, str(one.done), str(one.planned)] for one in stages]
    return Grid(caption, ("stage", "done", "planned"), lines)


def pilot_grid(found: Sequence[Pilot], tasks: Sequence[str]) -> Grid:
    """The pilots: a row for each policy, a column for each task."""
    lines = []
    for one in found:
        rates = [f"{100 * one.rates[task]:.0f}" if task in one.rates else "" for task in tasks]
        lines.append([one.policy, f"{one.loss:.4f}", *rates])
    return Grid(report.prose("answer").line("caption_pilots"), ("policy", "held-out loss", *tasks), lines)


def percent(result: ContrastResult) -> str:
    """A contrast in percentage points with its interval."""
    assert result.test is not None
    return number(scaled(result.test.difference), digits=1)
