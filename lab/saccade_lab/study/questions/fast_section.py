"""The report's section on fast modes: the values of its template, its figures and its tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade._internal.arrays import PRECISIONS
from saccade_lab.study import changes, figures
from saccade_lab.study.questions.fast_results import (
    BASELINE,
    ONE_STEP,
    SIZES,
    ModeResult,
    by_time,
    counts,
    frontier,
    part,
    recommended,
    results_of,
    separations,
    timed_sizes,
)
from saccade_lab.study.section import Figure, Grid, Prose, Section, number, points, rate
from saccade_lab.study.statistics import Estimate, PairedDifference, scaled
from saccade_lab.study.table import Provenance, is_recorded, truths


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report."""
    results = results_of(table)
    prose = Prose("fast", **values(table, provenance, results))
    grids = [success_grid(prose, table, results), chunk_grid(prose, results)]
    return prose.section(pictures(prose, results), [grid for grid in grids if grid is not None])


def values(table: pd.DataFrame, provenance: Provenance, results: Mapping[str, ModeResult]) -> dict[str, Any]:
    """What the template prints."""
    chunks, episodes, times = (part(table, name) for name in ("chunks", "episodes", "time"))
    calibrated = part(table, "calibrate")
    of_baseline = chunks[chunks["mode"] == BASELINE]
    recorded = is_recorded(provenance)
    separated = {} if recorded else separations(table)
    judged = [one for one in results.values() if one.judged and not recorded]
    screened = [one for name, one in results.items() if recorded and name != BASELINE and one.change]
    pairs = [one.pairs.pairs for one in judged if one.pairs]
    return {
        "baseline": BASELINE,
        "one_step": ONE_STEP,
        "checkpoint": provenance.settings["checkpoint"],
        "recorded": changes.recorded(of_baseline, of_baseline, provenance) if recorded else None,
        "num_observations": 0 if chunks.empty else int(of_baseline["num_observations"].sum()),
        "episodes": not episodes.empty,
        "sizes": [
            {"label": SIZES[size], **one_size(times[times["task"] == size])} for size in timed_sizes(results)
        ],
        "step_times": step_times(calibrated[calibrated["task"] == "times"]),
        "mass": held_mass(calibrated[calibrated["task"] == "mass"]),
        "gates": [(task, gate(one)) for task, one in separated.items()],
        "judged": [judgement(results, one) for one in judged],
        "doubtful": [
            judgement(results, one) for one in judged if one.verdict != "undecided" and not one.significant
        ],
        "pairs": min(pairs, default=0),
        "recommended": recommended(results) if judged else [],
        "screened": [
            {"name": one.name, "change": one.change, "ratio": one.ratio, "times": saved(results, one.name)}
            for one in screened
        ],
    }


def one_size(rows: pd.DataFrame) -> dict[str, Any]:
    """What was timed at one size."""
    first = rows.iloc[0]
    return {
        "num_vl_tokens": int(first["num_vl_tokens"]),
        "num_threads": int(first["num_threads"]),
        "isa": first["isa"],
        "rounds": int(rows["rounds"].min()),
    }


def step_times(rows: pd.DataFrame) -> list[tuple[str, list[str]]]:
    """The number of steps, and the times found for it."""
    return [
        (str(steps), [f"{value:g}" for value in found.sort_values("index")["value"]])
        for steps, found in rows.groupby(rows["seed"].astype(str))
    ]


def held_mass(rows: pd.DataFrame) -> list[tuple[int, str]]:
    """A percentage of the tokens, those with the least attention, and the percentage that they receive."""
    mass = np.sort(rows["value"].to_numpy(dtype=float))
    if not len(mass):
        return []
    return [
        (percent, f"{100 * mass[: len(mass) * percent // 100].sum() / mass.sum():.0f}")
        for percent in (25, 50, 75)
    ]


def gate(one: PairedDifference) -> dict[str, Any]:
    """What decides whether a task counts."""
    return {
        "counts": counts(one),
        "pairs": one,
        "step": f"{100 * (one.both + one.only_first) / one.pairs:.0f}",
        "baseline": f"{100 * (one.both + one.only_second) / one.pairs:.0f}",
    }


def judgement(results: Mapping[str, ModeResult], one: ModeResult) -> dict[str, Any]:
    """What a sentence on a judged mode needs."""
    assert one.pairs is not None
    return {"name": one.name, "difference": one.pairs.difference, "times": saved(results, one.name)}


def saved(results: Mapping[str, ModeResult], name: str) -> list[tuple[str, float]]:
    """The time of a chunk relative to the baseline's, by the label of each size."""
    found = []
    for size in timed_sizes(results):
        one, base = (
            result.times.get(size) if result.times else None for result in (results[name], results[BASELINE])
        )
        if one and base:
            found.append((SIZES[size], one.chunk.value / base.chunk.value))
    return found


def success_grid(prose: Prose, table: pd.DataFrame, results: Mapping[str, ModeResult]) -> Grid | None:
    """Success and time of each mode that ran in closed loop, by task and over the tasks that count."""
    episodes = part(table, "episodes")
    if episodes.empty:
        return None
    tasks = [str(task) for task in dict.fromkeys(episodes["task"])]
    sizes = timed_sizes(results)
    best = frontier(by_time(results))
    rows = []
    for name, one in results.items():
        of_mode = episodes[episodes["mode"] == name]
        if of_mode.empty:
            continue
        by_task = [truths(of_mode.loc[of_mode["task"] == task, "success"]) for task in tasks]
        rows.append(
            [
                name,
                *(f"{int(found.sum())}/{len(found)}" for found in by_task),
                rate(one.rate) if one.episodes else "",
                "" if one.pairs is None else points(one.pairs.difference),
                "" if one.pairs is None else f"{one.pairs.only_second} / {one.pairs.only_first}",
                "" if one.p_loss is None else f"{one.p_loss:.2g}",
                one.verdict or "",
                "" if one.verdict in (None, "undecided") else "yes" if one.significant else "no",
                *(milliseconds(one, size) for size in sizes),
                "yes" if name in best else "",
            ]
        )
    columns = (
        "mode",
        *tasks,
        "success, %",
        "difference, points",
        "lost / won",
        "p of a loss",
        "verdict",
        "after Holm",
        *(f"ms, {SIZES[size]}" for size in sizes),
        "frontier",
    )
    return Grid(prose.line("caption_success"), columns, rows)


def milliseconds(one: ModeResult, size: str) -> str:
    """The time of a chunk, and in brackets those of encode and sample."""
    found = one.times.get(size) if one.times else None
    return "" if found is None else f"{found.chunk.value:.3g} ({found.encode:.3g} + {found.sample:.3g})"


def chunk_grid(prose: Prose, results: Mapping[str, ModeResult]) -> Grid | None:
    """The error of the chunks and the time of every mode."""
    sizes = timed_sizes(results)
    rows = [
        [
            name,
            "" if one.change is None else number(one.change, digits=4),
            "" if one.ratio is None else number(one.ratio, digits=2),
            "" if one.error is None else number(one.error, digits=4),
            *(milliseconds(one, size) for size in sizes),
        ]
        for name, one in results.items()
        if one.change is not None or one.times
    ]
    if not rows:
        return None
    columns = (
        "mode",
        f"from {BASELINE}",
        "relative to another noise",
        "from many steps",
        *(f"ms, {SIZES[size]}" for size in sizes),
    )
    return Grid(prose.line("caption_chunks"), columns, rows)


def pictures(prose: Prose, results: Mapping[str, ModeResult]) -> list[Figure]:
    """Success against time at each size, and the error of the chunks against time."""
    found = []
    for size in timed_sizes(results):
        success = {
            name: (one.times[size].chunk, scaled(one.rate))
            for name, one in results.items()
            if one.times and size in one.times and one.episodes
        }
        if success:
            caption = prose.line("caption_frontier", SIZES[size])
            picture = scattered(success, "success, %")
            found.append(Figure(f"frontier-{size.replace('.', '')}", caption, picture))
    for size in timed_sizes(results)[:1]:
        errors = {
            name: (one.times[size].chunk, one.change)
            for name, one in results.items()
            if one.times and size in one.times and one.change is not None and name != BASELINE
        }
        if errors:
            caption = prose.line("caption_errors", SIZES[size])
            picture = scattered(errors, "|difference| of an action", falling=True)
            found.append(Figure("errors", caption, picture))
    return found


def scattered(
    measured: Mapping[str, tuple[Estimate, Estimate]], y_label: str, *, falling: bool = False
) -> Picture:
    """Points with error bars over a logarithmic time axis, numbered by time; a line connects the frontier.

    Args:
        measured: Milliseconds per chunk, and value, of each name.
        y_label: Label of the values' axis, with units.
        falling: Small values are good, and the vertical axis is logarithmic too.
    """
    picture, (axes,) = figures.new_picture(height=4.6)
    colours = dict(zip(PRECISIONS, figures.COLOURS, strict=False))
    sign = -1 if falling else 1
    best = frontier({name: (x.value, sign * y.value) for name, (x, y) in measured.items()})
    axes.plot(
        *zip(*[(measured[name][0].value, measured[name][1].value) for name in best], strict=True),
        "-",
        color="0.8",
    )
    ordered = sorted(measured.items(), key=lambda point: point[1][0].value)
    for rank, (name, (x, y)) in enumerate(ordered, 1):
        precision = name.partition("-")[0]
        whiskers = [[[one.value - one.low], [one.high - one.value]] for one in (x, y)]
        axes.errorbar(
            x.value,
            y.value,
            whiskers[1],
            whiskers[0],
            "o",
            color=colours[precision],
            markersize=4,
            linewidth=1,
        )
        axes.annotate(str(rank), (x.value, y.value), (3, 3), textcoords="offset points", fontsize=7)
        # Names next to the points would overlap where modes are alike.
        axes.text(
            1.03,
            1 - rank / (len(ordered) + 1),
            f"{rank}  {name}",
            transform=axes.transAxes,
            fontsize=8,
            color=colours[precision],
            fontweight="bold" if name in best else "normal",
            verticalalignment="center",
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.tick_params(axis="x", which="both", labelsize=7)
    if falling:
        axes.set_yscale("log")
    axes.set_xlabel("milliseconds per chunk")
    axes.set_ylabel(y_label)
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    return picture
