"""The pictures of the report, with the numbers of its tables."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from benches.peers.cases import COST, Case
from benches.peers.contenders import CONTENDERS
from benches.peers.results import Results
from benches.peers.text import plural, usual
from saccade_lab.timing import quartiles

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_figures(results: Results, folder: Path) -> None:
    """Writes what was measured: the whole head, and the cost model, each with the name of the CPU."""
    folder.mkdir(parents=True, exist_ok=True)
    if usual(results, "head"):
        head_figure(results).savefig(folder / f"performance-{results.slug}.png", dpi=130)
    if any(case.piece == "cost" for case in results.cases):
        cost_figure(results).savefig(folder / f"cost-{results.slug}.png", dpi=130)


def head_figure(results: Results) -> Figure:
    """Bars of the whole head in every engine, one panel per thread count.

    The numbers are those of the report's table: a bar ends at the median of `encode + sample`, and its dark
    part at the median of `sample`. The median of a sum is not the sum of the medians, so the light part is
    not exactly the median of `encode`.
    """
    from matplotlib.figure import Figure

    cases = usual(results, "head")
    names = [name for name in CONTENDERS if any(name in results.names(case) for case in cases)][::-1]
    figure = Figure(figsize=(5.5 * len(cases), 0.34 * len(names) + 1.2), layout="tight")
    axes = figure.subplots(1, len(cases), sharey=True, squeeze=False)
    for axis, case in zip(axes[0], cases, strict=True):
        for row, name in enumerate(names):
            if name in results.names(case):
                colour = "#1b6ca8" if name.startswith("saccade") else "#9a9a9a"
                both, sample = (
                    1e3 * quartiles(results.seconds(case, name, work))[1] for work in ("both", "sample")
                )
                axis.barh(row, both, color=colour, alpha=0.55)
                axis.barh(row, sample, color=colour)
                axis.text(both, row, f" {both:.0f}", va="center", fontsize=8)
        axis.set_title(f"{plural(case.threads)}: encode + sample (dark: sample)", fontsize=10)
        axis.set_xlabel("ms")
        axis.margins(x=0.12)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_yticks(range(len(names)), [CONTENDERS[name].label for name in names], fontsize=8)
    return figure


def cost_figure(results: Results) -> Figure:
    """Points and least-squares lines, one panel per size that varies."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 3.4), layout="tight")
    axes = figure.subplots(1, len(COST) + 1)
    case = next(case for case in results.cases if case.piece == "cost")
    for name in results.names(case):
        for axis, (title, points) in zip(axes, sorted(cost_lines(results, case, name).items()), strict=True):
            slope, start, fit = straight(points)
            xs = [0.0, max(x for x, _ in points)]
            (line,) = axis.plot(xs, [1e3 * (start + slope * x) for x in xs], linewidth=1)
            label = f"{CONTENDERS[name].label}, R² {fit:.4f}"
            axis.plot(
                [x for x, _ in points], [1e3 * y for _, y in points], "o", color=line.get_color(), label=label
            )
            axis.set_title(f"{title}, {plural(case.threads)}", fontsize=10)
            axis.set_ylim(bottom=0)
            axis.spines[["top", "right"]].set_visible(False)
            axis.legend(fontsize=7, frameon=False)
    axes[0].set_ylabel("ms")
    return figure


def cost_lines(results: Results, case: Case, name: str) -> dict[str, list[tuple[float, float]]]:
    """The points (size, median seconds) of each work, by `work, size`."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for work in case.works:
        seconds = results.seconds(case, name, work)
        if seconds:
            title, _, value = work.rpartition(" ")
            lines.setdefault(title, []).append((float(value), quartiles(seconds)[1]))
    return lines


def straight(points: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Slope, intercept and R² of the least-squares line."""
    xs, ys = zip(*points, strict=True)
    middle_x, middle_y = sum(xs) / len(xs), sum(ys) / len(ys)
    spread = sum((x - middle_x) ** 2 for x in xs)
    slope = sum((x - middle_x) * (y - middle_y) for x, y in points) / spread
    start = middle_y - slope * middle_x
    left = sum((y - start - slope * x) ** 2 for x, y in points)
    total = sum((y - middle_y) ** 2 for y in ys)
    return slope, start, 1.0 - left / total if total else 1.0
