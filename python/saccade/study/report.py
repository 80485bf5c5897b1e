"""One page of what was found: a section a study, from the tables alone."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import matplotlib as mpl
from jinja2 import Environment
from matplotlib.figure import Figure as Picture

from saccade._files import writable_directory, write_atomically
from saccade.errors import InputError
from saccade.study import STUDIES, load_study
from saccade.study.statistics import Estimate
from saccade.study.tables import Provenance, provenance_path, read_study, table_path

TITLE = "What do the future tokens do?"
# A study that asks something else, and the page's title where it stands alone.
ALONE = {"fast": "What do faster modes cost, and what do they save?"}
PREAMBLE = (
    "Each section is made from the study's table beside this page. Intervals are 95 % intervals. Where an "
    "interval holds zero, no effect was found, which is not the same as no effect: what it leaves open is "
    "said."
)
ATTENTION = "attention"
LOSS_THAT_MATTERS = 0.05  # of success; "no difference" is not said where an interval reaches further
FEWEST = 10  # clusters for a bootstrap
PNG_DOTS_PER_INCH = 130


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


@dataclass(frozen=True)
class Drawn:
    """A picture: where its file lies, for the Markdown, and all of it in a link, for the page."""

    caption: str
    file: str
    data: str


@dataclass(frozen=True)
class Part:
    """A section as it stands on the page.

    Attributes:
        name: Of the study.
        section: Its text.
        drawn: Its pictures.
        measured: Whether there is a table.
        unfinished: What is missing from it, if anything is.
        source: Where its numbers come from.
    """

    name: str
    section: Section
    drawn: Sequence[Drawn] = ()
    measured: bool = True
    unfinished: str = ""
    source: str = ""


def write_report(directory: Path) -> tuple[Path, Path]:
    """Writes `report.html`, one file that needs nothing else, and `report.md` with `figures/*.png`.

    Returns:
        The paths of page and Markdown.

    Raises:
        NotADirectoryError, FileNotFoundError: there is no such directory.
        InputError: it holds no study, or a table is not what its study wrote.
    """
    if not directory.is_dir():
        kind = NotADirectoryError if directory.exists() else FileNotFoundError
        raise kind(f"{directory}: no such directory; expected what the studies had as --out")
    if not any(provenance_path(directory, name).exists() for name in STUDIES):
        raise InputError(
            f"{directory}: holds no study; expected a table such as {next(iter(STUDIES))}.csv, "
            "written by `saccade study`"
        )
    measured = [name for name in STUDIES if provenance_path(directory, name).exists()]
    alone = set(measured) <= set(ALONE)
    title = ALONE[measured[0]] if alone else TITLE
    parts = [make_part(directory, name) for name in (measured if alone else STUDIES)]
    if (directory / ATTENTION).is_dir():
        parts.append(attention_part(directory))
    page, markdown = directory / "report.html", directory / "report.md"
    template = resources.files("saccade.study").joinpath("report.html.jinja").read_text(encoding="utf-8")
    rendered = (
        Environment(autoescape=True).from_string(template).render(title=title, preamble=PREAMBLE, parts=parts)
    )
    for path, text in ((page, rendered), (markdown, to_markdown(title, parts))):
        with write_atomically(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return page, markdown


def make_part(directory: Path, name: str) -> Part:
    """A study's part, or one that says that it was not measured."""
    absent = STUDIES[name][1][0].upper() + STUDIES[name][1][1:]
    if not provenance_path(directory, name).exists():
        return Part(name, Section(absent, concluded=["Not measured."]), measured=False)
    table, provenance = read_study(directory, name)
    if table.empty:
        nothing = Section(absent, concluded=["Not measured: no cell is done yet."])
        return Part(name, nothing, measured=False, unfinished=unfinished(provenance))
    try:
        section = load_study(name).section(table, provenance)
    except InputError as error:
        raise InputError(f"{table_path(directory, name)}: {error}") from None
    except KeyError as error:
        raise InputError(
            f"{table_path(directory, name)}: not written by this study: {error} is missing"
        ) from None
    except ValueError as error:  # text in a column of numbers
        raise InputError(f"{table_path(directory, name)}: not written by this study: {error}") from None
    drawn = [draw(directory, name, figure) for figure in section.figures]
    return Part(name, section, drawn, unfinished=unfinished(provenance), source=source(provenance))


def attention_part(directory: Path) -> Part:
    """What `saccade attention` left in the directory: its sheets, and where its pages are."""
    sheets = sorted((directory / ATTENTION).rglob("*.png"))
    pages = sorted((directory / ATTENTION).rglob("*.html"))
    drawn = []
    for sheet in sheets:
        data = "data:image/png;base64," + base64.b64encode(sheet.read_bytes()).decode("ascii")
        file = sheet.relative_to(directory).as_posix()
        drawn.append(Drawn(f"Attention maps: {file}.", file, data))
    lines = [
        f"To pick block, step, head and token on the image: {page.relative_to(directory).as_posix()}."
        for page in pages
    ]
    caveat = (
        "Attention is where a row looks, not what it takes from there or what comes of it. After VL "
        "self-attention a position is not only its patch."
    )
    return Part(
        ATTENTION, Section("Attention", summary=lines, not_shown=[caveat]), drawn, measured=bool(sheets)
    )


def draw(directory: Path, study: str, figure: Figure) -> Drawn:
    """Writes the picture as PNG for the Markdown; returns it with itself as SVG for the page."""
    name = f"{study}-{figure.name}"
    # With a fixed salt and without dates the same table gives the same files each time.
    with mpl.rc_context({"svg.hashsalt": "saccade"}):
        with write_atomically(writable_directory(directory / "figures") / f"{name}.png") as temporary:
            figure.picture.savefig(temporary, dpi=PNG_DOTS_PER_INCH, metadata={"Software": None})
        buffer = io.BytesIO()
        figure.picture.savefig(buffer, format="svg", metadata={"Date": None})
    data = "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
    return Drawn(figure.caption, f"figures/{name}.png", data)


def unfinished(provenance: Provenance) -> str:
    """What is missing from a table; empty if nothing is."""
    if provenance.complete:
        return ""
    text = (
        f"Unfinished: {provenance.done} of {provenance.total} cells are done; what follows is of these alone."
    )
    if provenance.failed:
        first = provenance.failed[0]
        name = " ".join(str(part) for part in first["key"])
        text += (
            f" {len(provenance.failed)} failed in the last run, the first of them {name}: {first['error']}"
        )
    return text


def source(provenance: Provenance) -> str:
    """Where the numbers come from."""
    packages = ", ".join(f"{name} {version}" for name, version in provenance.packages.items())
    machine = ", ".join(provenance.machine.values())
    return (
        f"{provenance.study}.csv: {provenance.done} cells, {provenance.cell_seconds:.0f} s of work; "
        f"{packages}; {machine}."
    )


def to_markdown(title: str, parts: Sequence[Part]) -> str:
    """The same page as Markdown, with pictures beside it."""
    lines = [f"# {title}", "", PREAMBLE, ""]
    for part in parts:
        section = part.section
        lines += [f"## {section.title}", ""]
        if part.unfinished:
            lines += [f"**{part.unfinished}**", ""]
        for heading, points in (
            ("What can be concluded", section.concluded),
            ("What this cannot show", section.not_shown),
        ):
            if points:
                lines += [f"### {heading}", "", *(f"- {point}" for point in points), ""]
        if section.summary:
            lines += ["### What was measured", ""]
            for paragraph in section.summary:
                lines += [paragraph, ""]
        for drawn in part.drawn:
            lines += [f"![{drawn.caption}]({drawn.file})", "", drawn.caption, ""]
        for grid in section.grids:
            lines += [grid.caption, "", markdown_row(grid.columns), markdown_row(["---"] * len(grid.columns))]
            lines += [*(markdown_row(row) for row in grid.rows), ""]
        if part.source:
            lines += [part.source, ""]
    return "\n".join(lines)


def markdown_row(cells: Sequence[str]) -> str:
    """A row of a Markdown table.

    Example:
        >>> markdown_row(["a", "|b|"])
        '| a | \\\\|b\\\\| |'
    """
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
