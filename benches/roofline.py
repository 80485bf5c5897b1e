"""The roofline: what each part of a call reaches, and what multiply-adds and memory allow.

    python -m benches.roofline --version n1.5 --precisions bfloat16 --figure roofline.png

A part that does `x` multiply-adds for each byte that it reads can do `x` times the memory's bandwidth at
most, and never more than the peak of its arithmetic. Both axes are logarithmic.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saccade_lab.cli import bench
from saccade_lab.timing import Machine, arithmetic_of

#: Columns and rows of the picture in text.
WIDTH, HEIGHT = 64, 16


@dataclass(frozen=True)
class Point:
    """One part of a call.

    Attributes:
        part: Its name.
        runs_in: Its arithmetic.
        intensity: Multiply-adds for each byte of weights, or of keys and values, that it reads.
        rate: Multiply-adds per second.
        share: The floor of its time, divided by its time.
        limit: ``"arithmetic"`` or ``"memory"``, whichever sets the floor.
    """

    part: str
    runs_in: str
    intensity: float
    rate: float
    share: float
    limit: str


def points(machine: Machine, precision: str, parts: Iterable[Mapping[str, Any]]) -> list[Point]:
    """The points of a profile, slowest part first.

    Args:
        machine: The machine, measured in the same run.
        precision: Precision of the head.
        parts: Records with `part`, `seconds`, `multiply_adds` and `bytes`; those without multiply-adds or
            bytes have no place in the picture.
    """
    made = []
    for record in sorted(parts, key=lambda record: -record["seconds"]):
        work, read, seconds = record["multiply_adds"], record["bytes"], record["seconds"]
        if work and read and seconds:
            runs_in = arithmetic_of(record["part"], precision)
            least = machine.floor(runs_in, work, read)
            made.append(
                Point(
                    record["part"],
                    runs_in,
                    work / read,
                    work / seconds,
                    least / seconds,
                    machine.limit(runs_in, work, read),
                )
            )
    return made


def roof(machine: Machine, runs_in: str, intensity: float) -> float:
    """The most multiply-adds per second at this intensity."""
    return min(machine.macs_per_second[runs_in], intensity * machine.read_bytes_per_second)


@dataclass(frozen=True)
class Range:
    """The part of the plane that a picture shows."""

    least_intensity: float
    most_intensity: float
    least_rate: float
    most_rate: float

    @classmethod
    def of(cls, machine: Machine, shown: Sequence[Point]) -> Range:
        """Whole powers of two around all points, and around the corners of the roofs."""
        corners = [
            machine.macs_per_second[runs_in] / machine.read_bytes_per_second
            for runs_in in {point.runs_in for point in shown}
        ]
        intensities = [point.intensity for point in shown] + [corner / 2 for corner in corners]
        intensities += [2 * corner for corner in corners]
        low, high = _below(min(intensities)), _above(max(intensities))
        rates = [point.rate for point in shown]
        rates += [roof(machine, point.runs_in, high) for point in shown]
        return cls(low, high, _below(min(rates)), _above(max(rates)))

    def column(self, intensity: float) -> int:
        """Where an intensity is, from 0 to `WIDTH - 1`."""
        return _place(intensity, self.least_intensity, self.most_intensity, WIDTH)

    def row(self, rate: float) -> int:
        """Where a rate is, from 0 at the bottom to `HEIGHT - 1`."""
        return _place(rate, self.least_rate, self.most_rate, HEIGHT)

    def intensity(self, column: int) -> float:
        """The intensity of a column."""
        ratio = self.most_intensity / self.least_intensity
        return float(self.least_intensity * ratio ** (column / (WIDTH - 1)))


def text(machine: Machine, shown: Sequence[Point]) -> list[str]:
    """The picture as lines, with a legend: a letter for each part, `/` and `-` for the roofs."""
    if not shown:
        return ["no part has both multiply-adds and bytes"]
    plane = Range.of(machine, shown)
    grid = [[" "] * WIDTH for _ in range(HEIGHT)]
    for runs_in in sorted({point.runs_in for point in shown}):
        peak = machine.macs_per_second[runs_in]
        for column in range(WIDTH):
            rate = roof(machine, runs_in, plane.intensity(column))
            if plane.least_rate <= rate <= plane.most_rate:
                grid[plane.row(rate)][column] = "-" if rate == peak else "/"
    letters = [_letter(index) for index in range(len(shown))]
    for letter, point in reversed(list(zip(letters, shown, strict=True))):
        grid[plane.row(point.rate)][plane.column(point.intensity)] = letter
    lines = [f"{'GMAC/s':>9}"]
    for row in reversed(range(HEIGHT)):
        height = plane.least_rate * (plane.most_rate / plane.least_rate) ** (row / (HEIGHT - 1))
        label = f"{height / 1e9:9.3g}" if row % 5 == 0 else " " * 9
        lines.append(f"{label} |{''.join(grid[row]).rstrip()}")
    low, high = f"{plane.least_intensity:.3g}", f"{plane.most_intensity:.3g}"
    lines.append(" " * 10 + "+" + "-" * WIDTH)
    lines.append(" " * 11 + low + "multiply-adds a byte".center(WIDTH - len(low) - len(high)) + high)
    head = f"{'':<4}{'part':<20}{'arithmetic':<12}{'a byte':>9}{'GMAC/s':>10}{'roof':>10}{'of it':>8}  limit"
    lines += ["", head]
    for letter, point in zip(letters, shown, strict=True):
        most = roof(machine, point.runs_in, point.intensity) / 1e9
        lines.append(
            f"{letter:<4}{point.part:<20}{point.runs_in:<12}{point.intensity:>9.1f}{point.rate / 1e9:>10.1f}"
            f"{most:>10.1f}{point.share:>8.0%}  {point.limit}"
        )
    return lines


def write_figure(machine: Machine, shown: Mapping[str, Sequence[Point]], path: Path) -> None:
    """Writes the picture as an image, a panel for each call, in the format that the name says."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5 * len(shown), 4.2), layout="tight")
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axis, (title, parts) in zip(panels, shown.items(), strict=True):
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("multiply-adds a byte")
        axis.spines[["top", "right"]].set_visible(False)
        if not parts:
            continue
        plane = Range.of(machine, parts)
        intensities = [plane.intensity(column) for column in range(WIDTH)]
        for runs_in in sorted({point.runs_in for point in parts}):
            rates = [roof(machine, runs_in, intensity) / 1e9 for intensity in intensities]
            axis.plot(intensities, rates, color="#9a9a9a", linewidth=1)
            axis.text(intensities[-1], rates[-1], runs_in, fontsize=7, ha="right", va="bottom")
        for point in parts:
            axis.plot(point.intensity, point.rate / 1e9, "o", color="#1b6ca8", markersize=4)
            label = f" {point.part} {point.share:.0%}"
            axis.text(point.intensity, point.rate / 1e9, label, fontsize=7, va="center")
        axis.set_xscale("log")
        axis.set_yscale("log")
    panels[0].set_ylabel("GMAC/s")
    figure.savefig(path, dpi=130)


def _below(value: float) -> float:
    return float(2.0 ** math.floor(math.log2(value)))


def _above(value: float) -> float:
    return float(2.0 ** math.ceil(math.log2(value)))


def _place(value: float, least: float, most: float, count: int) -> int:
    along = math.log(value / least) / math.log(most / least)
    return min(count - 1, max(0, round(along * (count - 1))))


def _letter(index: int) -> str:
    """`a` to `z`, then `*`: no head has more parts."""
    return chr(ord("a") + index) if index < 26 else "*"


def main(arguments: list[str] | None = None) -> int:
    """Measures and prints; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benches.roofline", description="Draws the roofline.")
    bench.add_head_arguments(parser)
    parser.add_argument("--figure", type=Path, metavar="FILE", help="an image too (needs matplotlib)")
    args = parser.parse_args(arguments)
    heads, _, call = bench.prepared(args)
    machine = bench.measured(heads)
    shown = {
        f"{one['precision']} {one['call']}": points(machine, one["precision"], one["parts"])
        for one in bench.profiles(heads, call, machine, args.rounds)
    }
    for title, parts in shown.items():
        print("\n".join([f"{title}, roofline", "", *text(machine, parts), ""]))
    if args.figure is not None:
        write_figure(machine, shown, args.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
