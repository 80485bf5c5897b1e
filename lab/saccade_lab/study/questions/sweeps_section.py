"""The report's section on a sweep: the values of its template, its figures and its tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.figure import Figure as Picture

from saccade_lab.study import figures
from saccade_lab.study.questions.sweeps_results import (
    PLAIN,
    Varied,
    complete_policies,
    differences,
    mass_differences,
    point_order,
    policies_of,
    wilson_of,
)
from saccade_lab.study.section import Figure, Grid, Prose, Section, number, points, rate
from saccade_lab.study.statistics import Estimate
from saccade_lab.study.table import truths


def detectable_lines(rows: Iterable[Mapping[Any, Any]]) -> list[str]:
    """What can be detected, a line for each assumption."""
    return Prose("sweeps", detectable=list(rows)).points("detectable_lines")


def section(name: str, varied: Varied, table: pd.DataFrame) -> Section:
    """A sweep's part of the report.

    Args:
        name: Name of the study.
        varied: What defines a point.
        table: Table of the study.
    """
    kinds = {str(kind): rows.dropna(axis=1, how="all") for kind, rows in table.groupby("kind")}
    trained = kinds.get("training", pd.DataFrame())
    episodes = kinds.get("episode", pd.DataFrame())
    partial: list[tuple[str, int, int]] = []
    if not episodes.empty:
        episodes = episodes.assign(
            success=truths(episodes["success"]).astype(float),
            point=[varied.label(row) for row in episodes.to_dict("records")],
        )
        whole, partial = complete_policies(episodes[episodes["arm"] == PLAIN])
        episodes = episodes[episodes["policy"].isin(whole)]
    plain = episodes if episodes.empty else episodes[episodes["arm"] == PLAIN]
    ordered = [] if plain.empty else point_order(plain, varied)
    prose = Prose(
        "sweeps",
        study=name,
        detectable=kinds["before"].to_dict("records"),
        points=ordered,
        compared=[] if plain.empty else comparisons(plain, varied),
        masses=mass_differences(episodes, ordered),
        partial=partial,
        in_training=in_training(trained),
        has_episodes=not kinds.get("episode", pd.DataFrame()).empty,
    )
    if plain.empty:
        return prose.section()
    pictures = [Figure("success", prose.line("caption_success"), policy_picture(plain, ordered))]
    grids = [policy_grid(prose, plain, trained, ordered), difference_grid(prose, plain, varied)]
    if (episodes["arm"] != PLAIN).any():
        grids.append(mass_grid(prose, episodes, ordered))
    if "cost" in kinds:
        grids.append(cost_grid(prose, kinds["cost"], varied))
    return prose.section(pictures, grids)


def comparisons(plain: pd.DataFrame, varied: Varied) -> list[dict[str, Any]]:
    """What a sentence on two points needs."""
    return [
        {
            "first": first,
            "second": second,
            "these": these,
            "trained": trained,
            "has_interval": not math.isnan(trained.low),
            "runs": [len(policies_of(plain[plain["point"] == point])) for point in (first, second)],
        }
        for first, second, these, trained in differences(plain, varied)
    ]


def in_training(trained: pd.DataFrame) -> list[tuple[str, str]]:
    """Policies that are not finished, and why they were not measured."""
    if "note" not in trained:
        return []
    rows = trained[trained["note"].notna()]
    return list(zip(rows["policy"], rows["note"], strict=True))


def policy_picture(plain: pd.DataFrame, ordered: Sequence[str]) -> Picture:
    """Success of every policy."""
    labels, values = [], []
    for point in ordered:
        of_point = plain[plain["point"] == point]
        for name in policies_of(of_point):
            rows = of_point[of_point["policy"] == name]
            labels.append(f"{point}, seed {int(rows['training_seed'].iloc[0])}")
            values.append(wilson_of(rows))
    return figures.estimates(labels, values, "success rate")


def policy_grid(prose: Prose, plain: pd.DataFrame, trained: pd.DataFrame, ordered: Sequence[str]) -> Grid:
    """Every policy: validation loss, success over all and by task."""
    tasks = list(dict.fromkeys(plain["task"]))
    losses = dict(zip(trained["policy"], trained["validation_loss"], strict=True))
    lines = []
    for point in ordered:
        of_point = plain[plain["point"] == point]
        for name in policies_of(of_point):
            rows = of_point[of_point["policy"] == name]
            by_task = [rows.loc[rows["task"] == task, "success"] for task in tasks]
            counts = [f"{int(found.sum())}/{len(found)}" for found in by_task]
            seed = str(int(rows["training_seed"].iloc[0]))
            lines.append([point, seed, f"{losses[name]:.3f}", rate(wilson_of(rows)), *counts])
    columns = ("policy", "training seed", "validation loss", "success, %", *tasks)
    return Grid(prose.line("caption_policies"), columns, lines)


def difference_grid(prose: Prose, plain: pd.DataFrame, varied: Varied) -> Grid:
    """Differences between points, in percentage points of success."""
    lines = [
        [second, first, points(these), points(trained)]
        for first, second, these, trained in differences(plain, varied)
    ]
    return Grid(
        prose.line("caption_differences"),
        ("policies", "minus", "these policies", "over training runs"),
        lines,
    )


def mass_grid(prose: Prose, episodes: pd.DataFrame, ordered: Sequence[str]) -> Grid:
    """The controls of equal mass."""
    lines = [[point, arm, points(one)] for point, arm, one in mass_differences(episodes, ordered)]
    return Grid(
        prose.line("caption_mass"),
        ("policies", "future keys with the", "difference"),
        lines,
    )


def cost_grid(prose: Prose, cost: pd.DataFrame, varied: Varied) -> Grid:
    """Latency and memory."""
    lines = []
    for row in cost.sort_values(list(varied.names)).to_dict("records"):
        ratios = [
            number(
                Estimate(row[f"{part}_ratio"], row[f"{part}_ratio_low"], row[f"{part}_ratio_high"]), digits=2
            )
            for part in ("encode", "sample")
        ]
        lines.append(
            [
                varied.label(row),
                f"{row['encode_ms']:.2f}",
                ratios[0],
                f"{row['sample_ms']:.2f}",
                ratios[1],
                f"{row['head_bytes'] / 1e6:.2f}",
                f"{row['context_bytes'] / 1e3:.1f}",
            ]
        )
    return Grid(
        prose.line("caption_cost"),
        ("policies", "encode, ms", "ratio", "sample, ms", "ratio", "weights, MB", "context, kB"),
        lines,
    )
