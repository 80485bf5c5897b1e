"""The plots of reports: estimates with intervals, lines with error bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from saccade_lab.study.statistics import Estimate

# Dark enough on white, and distinguishable by colour-blind readers (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
WIDTH = 7.0  # inches


def new_picture(height: float = 3.2, columns: int = 1) -> tuple[Picture, list[Axes]]:
    """An empty picture with plots side by side, made without pyplot, so that nothing stays open."""
    picture = Picture(figsize=(WIDTH, height), layout="constrained")
    axes = list(np.atleast_1d(picture.subplots(1, columns)))
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
    return picture, axes


def estimates(
    labels: Sequence[str],
    values: Sequence[Estimate],
    x_label: str,
    *,
    reference: float | None = None,
    colour: str = COLOURS[0],
) -> Picture:
    """One row per estimate, from top to bottom: the value as a dot, its interval as a line.

    Args:
        labels: Labels of the rows.
        values: NaN values and unknown intervals are left out.
        x_label: Label of the axis, with the unit.
        reference: Position of a dotted vertical line, for "no difference".
        colour: Of the dots and lines.
    """
    picture, (axes,) = new_picture(height=0.9 + 0.28 * len(labels))
    if reference is not None:
        axes.axvline(reference, color="0.5", linewidth=1, linestyle=":")
    for row, value in enumerate(values):
        axes.plot([value.low, value.high], [row, row], color=colour, linewidth=2)
        axes.plot([value.value], [row], "o", color=colour, markersize=5)
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlabel(x_label)
    axes.grid(axis="x", color="0.9")
    axes.set_axisbelow(True)
    return picture


def lines(
    x: Sequence[float],
    series: Mapping[str, Sequence[Estimate]],
    x_label: str,
    y_label: str,
    *,
    reference: float | None = None,
) -> Picture:
    """One line per series of estimates, with error bars for the intervals, and a legend.

    Args:
        x: Positions of the estimates; there is a tick at each.
        series: An estimate for each ``x``, by name of the series.
        x_label, y_label: Labels of the axes, with units.
        reference: Position of a dotted horizontal line.
    """
    picture, (axes,) = new_picture()
    if reference is not None:
        axes.axhline(reference, color="0.5", linewidth=1, linestyle=":")
    ticks = np.asarray(x, dtype=float)
    gap = float(np.diff(np.unique(ticks)).min()) if len(np.unique(ticks)) > 1 else 1.0
    for number, (name, values) in enumerate(series.items()):
        # Shifted sideways, so that error bars do not cover each other.
        places = ticks + 0.04 * gap * (number - (len(series) - 1) / 2)
        middle = np.array([value.value for value in values])
        reach = [
            middle - np.array([value.low for value in values]),
            np.array([value.high for value in values]) - middle,
        ]
        colour = COLOURS[number % len(COLOURS)]
        axes.errorbar(places, middle, reach, color=colour, marker="o", markersize=4, capsize=2, label=name)
    axes.set_xticks(ticks)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    if len(series) > 1:
        axes.legend(frameon=False, fontsize="small")
    return picture
