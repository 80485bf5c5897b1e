"""One page of what was found: a section a study, from the tables alone."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import matplotlib as mpl
from jinja2 import Environment

from saccade._files import writable_directory, write_atomically
from saccade.errors import InputError
from saccade.study.section import Figure, Section
from saccade.study.study import STUDIES, load_study
from saccade.study.table import Provenance, provenance_path, read_study, table_path

TITLE = "What do the future tokens do?"
# A study that asks something else, and the page's title where it stands alone.
ALONE = {"fast": "What do faster modes cost, and what do they save?"}
PREAMBLE = (
    "Each section is made from the study's table beside this page. Intervals are 95 % intervals. Where an "
    "interval holds zero, no effect was found, which is not the same as no effect: what it leaves open is "
    "said."
)
ATTENTION = "attention"
PNG_DOTS_PER_INCH = 130


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
        section = load_study(name).summarise(table, provenance)
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
