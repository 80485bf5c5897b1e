"""One page of what was found: a section a study, from the tables alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure as Picture


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
