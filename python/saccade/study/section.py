"""A study's part of the report: its text, pictures and tables, and how numbers are written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure as Picture

from saccade.study.statistics import Estimate

LOSS_THAT_MATTERS = 0.05  # of success; "no difference" is not said where an interval reaches further
FEWEST = 10  # clusters for a bootstrap


@dataclass(frozen=True)
class Figure:
    """A picture in a section.

    Attributes:
        name: of its file, unique in its section: lower-case words with hyphens.
        caption: What is drawn, with units, and what the whiskers are.
        picture: From :mod:`saccade.study.figures`.
    """

    name: str
    caption: str
    picture: Picture


@dataclass(frozen=True)
class Grid:
    """A table for people.

    Attributes:
        caption: What its numbers are.
        columns: Headings.
        rows: As many texts each.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Section:
    """A study's part of the report. All text is plain, a paragraph each.

    Attributes:
        title: A few words.
        summary: What was done: on what, how much of it, how it was measured.
        figures, grids: What was found.
        concluded: What the intervals allow to be said.
        not_shown: What this study cannot show, whatever its numbers are.
    """

    title: str
    summary: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    grids: Sequence[Grid] = ()
    concluded: Sequence[str] = ()
    not_shown: Sequence[str] = ()


def number(estimate: Estimate, *, digits: int) -> str:
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
    """A share in percent with its interval.

    Example:
        >>> rate(Estimate(0.9, 0.699, 0.972))
        '90 (70 to 97)'
    """
    return number(Estimate(*(100 * part for part in (estimate.value, estimate.low, estimate.high))), digits=0)


def not_measured(reason: str) -> str:
    """What stands where there is no number."""
    return f"not measured, {reason}"


def effect(what: str, difference: Estimate) -> str:
    """What the interval of a difference of two rates allows to be said.

    Example:
        >>> effect("success", Estimate(-0.2, -0.31, -0.1))
        'success is lower by 20.0 points (95 % interval: lower by 10.0 to 31.0)'
        >>> effect("success", Estimate(-0.02, -0.08, 0.04))
        'no effect on success was found; a loss of up to 8.0 and a gain of up to 4.0 points are not excluded'
        >>> effect("success", Estimate(0.0, -0.04, 0.04))
        'no effect on success was found, and by itself this excludes one of 5 points or more (-4.0 to 4.0)'
        >>> effect("success", Estimate(0.0, math.nan, math.nan))
        'success: too few episodes for an interval, so nothing can be said'
    """
    if math.isnan(difference.low) or math.isnan(difference.high):
        return f"{what}: too few episodes for an interval, so nothing can be said"
    value, low, high = (100 * part for part in (difference.value, difference.low, difference.high))
    if high < 0 or low > 0:
        direction, near, far = ("lower", -high, -low) if high < 0 else ("higher", low, high)
        return (
            f"{what} is {direction} by {abs(value):.1f} points "
            f"(95 % interval: {direction} by {near:.1f} to {far:.1f})"
        )
    found = f"no effect on {what} was found"
    matters = 100 * LOSS_THAT_MATTERS
    if max(-low, high) < matters:
        return (
            f"{found}, and by itself this excludes one of {matters:.0f} points or more "
            f"({low:.1f} to {high:.1f})"
        )
    return f"{found}; a loss of up to {abs(low):.1f} and a gain of up to {high:.1f} points are not excluded"


def too_few(count: int, what: str) -> list[str]:
    """A warning where a bootstrap interval rests on too few of something.

    Example:
        >>> too_few(3, "episodes")
        ['Only 3 episodes: bootstrap intervals are too narrow below about 10.']
    """
    if count >= FEWEST:
        return []
    return [f"Only {count} {what}: bootstrap intervals are too narrow below about {FEWEST}."]
