"""One section of a report: its text from a template, its figures, its tables, and how numbers are written."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure as Picture

from saccade_lab.study.statistics import LOSS_THAT_MATTERS, Estimate, scaled, verdict

FEWEST = 10  # clusters that a bootstrap needs
PACKAGE = "saccade_lab.study"  # whose folder `pages` has the templates of the general questions


@dataclass(frozen=True)
class Figure:
    """A picture in a section.

    Attributes:
        name: Name of its file, unique in its section: lower-case words separated by hyphens.
        caption: Description of the drawing, with units, and of the error bars.
        picture: Drawn by :mod:`saccade_lab.study.figures`.
    """

    name: str
    caption: str
    picture: Picture


@dataclass(frozen=True)
class Grid:
    """A table for readers.

    Attributes:
        caption: Description of its numbers.
        columns: Headings.
        rows: One text per column in each row.
        note: A paragraph below it, or nothing.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A study's part of the report. All text is Markdown without line breaks.

    Attributes:
        title: A few words.
        summary: Paragraphs that say what was measured, on what, and how.
        figures, grids: The results.
        concluded: Sentences that say what the intervals show.
        not_shown: Sentences that say what the study cannot show.
    """

    title: str
    summary: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    grids: Sequence[Grid] = ()
    concluded: Sequence[str] = ()
    not_shown: Sequence[str] = ()


def number(estimate: Estimate, digits: int) -> str:
    """A number with its interval.

    Example:
        >>> number(Estimate(-0.5, -1.25, 0.25), digits=2)
        '-0.50 (-1.25 to 0.25)'
        >>> number(Estimate(2.0, math.nan, math.nan), digits=0)
        '2 (no interval)'
    """
    if math.isnan(estimate.low):
        return f"{estimate.value:.{digits}f} (no interval)"
    return f"{estimate.value:.{digits}f} ({estimate.low:.{digits}f} to {estimate.high:.{digits}f})"


def rate(estimate: Estimate) -> str:
    """A rate in percent with its interval.

    Example:
        >>> rate(Estimate(0.9, 0.699, 0.972))
        '90 (70 to 97)'
    """
    return number(scaled(estimate), digits=0)


def points(difference: Estimate) -> str:
    """A difference of rates in percentage points with its interval.

    Example:
        >>> points(Estimate(-0.2, -0.31, -0.1))
        '-20.0 (-31.0 to -10.0)'
    """
    return number(scaled(difference), digits=1)


@functools.cache
def templates(package: str = PACKAGE) -> Environment:
    """The templates of a package's folder ``pages``, with the filters that write numbers."""
    environment = Environment(
        loader=PackageLoader(package, "pages"),
        autoescape=lambda name: bool(name and name.endswith(".html.jinja")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": number,
        "points": points,
        "rate": rate,
        "row": markdown_row,
        "verdict": verdict,
    }
    environment.globals |= {"margin": f"{100 * LOSS_THAT_MATTERS:.0f}", "fewest": FEWEST}
    return environment


class Prose:
    """The text of a section: the macros of ``pages/NAME.md.jinja``, with the values that they print.

    A macro's text may be wrapped over lines: ``paragraphs`` are separated by blank lines, and each of the
    ``points`` begins with a hyphen.

    Args:
        name: Name of the template.
        package: The package that has it.
        values: Variables of the template.

    Example:
        >>> Prose("words").line("not_measured", "there are no demonstrations")
        'not measured, there are no demonstrations'
    """

    def __init__(self, name: str, *, package: str = PACKAGE, **values: Any) -> None:
        self._module = templates(package).get_template(f"{name}.md.jinja").make_module(values)

    def line(self, macro: str, *arguments: Any, **named: Any) -> str:
        """The text of a macro on one line."""
        return " ".join(self._text(macro, *arguments, **named).split())

    def paragraphs(self, macro: str, *arguments: Any) -> list[str]:
        """The paragraphs of a macro, each on one line."""
        return [" ".join(one.split()) for one in self._text(macro, *arguments).split("\n\n") if one.strip()]

    def points(self, macro: str, *arguments: Any) -> list[str]:
        """The points of a macro's list, each on one line and without its hyphen."""
        found = f"\n{self._text(macro, *arguments)}".split("\n- ")
        return [" ".join(one.split()) for one in found if one.strip()]

    def section(self, figures: Sequence[Figure] = (), grids: Sequence[Grid] = ()) -> Section:
        """The section that the macros ``title``, ``summary``, ``concluded`` and ``not_shown`` describe."""
        return Section(
            title=self.line("title"),
            summary=self.paragraphs("summary"),
            figures=figures,
            grids=grids,
            concluded=self.points("concluded"),
            not_shown=self.points("not_shown"),
        )

    def _text(self, macro: str, *arguments: Any, **named: Any) -> str:
        return str(getattr(self._module, macro)(*arguments, **named))


def effect(what: str, difference: Estimate) -> str:
    """A verdict on a difference of two rates, with the numbers that it follows from.

    Example:
        >>> effect("success", Estimate(-0.2, -0.31, -0.1))
        'success: worse, -20.0 points (-31.0 to -10.0)'
        >>> effect("success", Estimate(-0.02, -0.08, 0.04))
        'success: undecided, -2.0 points (-8.0 to 4.0)'
        >>> effect("success", Estimate(0.0, math.nan, math.nan))
        'success: undecided, too few episodes for an interval'
    """
    return Prose("words").line("effect", what, difference)


def not_measured(reason: str) -> str:
    """What is written where there is no number."""
    return Prose("words").line("not_measured", reason)


def markdown_row(cells: Sequence[str]) -> str:
    r"""A row of a Markdown table.

    Example:
        >>> markdown_row(["a", "|b|"])
        '| a | \\|b\\| |'
    """
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
