"""How the report's pictures look: estimates with intervals, lines with bands, shaded grids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from saccade.study.statistics import Estimate

# Dark enough on white, and told apart by colour-blind readers (Okabe and Ito).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
WIDTH = 7.0  # inches


def new_picture(height: float = 3.2, columns: int = 1) -> tuple[Picture, list[Axes]]:
    """An empty picture with plots side by side, outside pyplot, so that nothing is kept open."""
    picture = Picture(figsize=(WIDTH, height), layout="constrained")
    axes = list(np.atleast_1d(picture.subplots(1, columns)))
    for one in axes:
        one.spines[["top", "right"]].set_visible(False)
    return picture, axes


def estimates(
    labels: Sequence[str], values: Sequence[Estimate], x_label: str, *, reference: float | None = None
) -> Picture:
    """A row each: the value as a dot, its interval as a line; from top to bottom.

    Args:
        labels: of the rows.
        values: a NaN is left out, and so is an interval that is not known.
        x_label: with the unit.
        reference: where a dotted line stands, for "no difference".
    """
    picture, (axes,) = new_picture(height=0.9 + 0.28 * len(labels))
    if reference is not None:
        axes.axvline(reference, color="0.5", linewidth=1, linestyle=":")
    for row, value in enumerate(values):
        axes.plot([value.low, value.high], [row, row], color=COLOURS[0], linewidth=2)
        axes.plot([value.value], [row], "o", color=COLOURS[0], markersize=5)
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
    """A line each through estimates over `x`, with whiskers for the intervals, and a legend.

    Args:
        x: where the estimates stand; drawn as given, with a tick at each.
        series: by name, an estimate for each `x`.
        x_label, y_label: with units.
        reference: where a dotted horizontal line stands.
    """
    picture, (axes,) = new_picture()
    if reference is not None:
        axes.axhline(reference, color="0.5", linewidth=1, linestyle=":")
    ticks = np.asarray(x, dtype=float)
    gap = float(np.diff(np.unique(ticks)).min()) if len(np.unique(ticks)) > 1 else 1.0
    for number, (name, values) in enumerate(series.items()):
        # Side by side, so that whiskers do not hide each other.
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


def shaded(
    values: npt.ArrayLike,
    row_labels: Sequence[str],
    column_labels: Sequence[str],
    x_label: str,
    *,
    low: float,
    high: float,
    digits: int = 2,
) -> Picture:
    """A grid of numbers `(rows, columns)`, shaded from `low` to `high` and written out; NaN is left blank."""
    numbers = np.asarray(values, dtype=float)
    picture, (axes,) = new_picture(height=1.0 + 0.32 * len(row_labels))
    axes.imshow(np.ma.masked_invalid(numbers), cmap="Blues", vmin=low, vmax=high, aspect="auto")
    for (row, column), number in np.ndenumerate(numbers):
        if np.isfinite(number):
            colour = "white" if number > (low + high) / 2 else "black"
            axes.text(column, row, f"{number:.{digits}f}", ha="center", va="center", color=colour, fontsize=8)
    axes.set_yticks(range(len(row_labels)), row_labels)
    axes.set_xticks(range(len(column_labels)), column_labels)
    axes.set_xlabel(x_label)
    axes.tick_params(length=0)
    return picture
