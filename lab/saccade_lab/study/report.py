"""The report of all studies in a directory, from their tables alone."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import matplotlib as mpl

from saccade._internal.files import write_atomically
from saccade.errors import InputError
from saccade_lab.files import writable_directory
from saccade_lab.study.page import Part, SavedPicture, to_html, to_markdown
from saccade_lab.study.section import Figure, Prose, Section
from saccade_lab.study.study import STUDIES, load_study
from saccade_lab.study.table import provenance_path, read_study, table_path

ATTENTION = "attention"  # the directory that `saccade attention` writes
SEPARATE = ("fast",)  # studies with a question of their own: one of these alone names no others
PNG_DOTS_PER_INCH = 130


def write_report(directory: Path) -> tuple[Path, Path]:
    """Writes ``report.html``, which contains everything it shows, and ``report.md`` with ``figures/*.png``.

    Args:
        directory: What the studies had as ``--out``.

    Returns:
        The paths of the HTML and of the Markdown.

    Raises:
        NotADirectoryError, FileNotFoundError: There is no such directory.
        InputError: It contains no study, or a table is not what its study wrote.
    """
    if not directory.is_dir():
        kind = NotADirectoryError if directory.exists() else FileNotFoundError
        raise kind(f"{directory}: no such directory; expected the --out of `saccade study`")
    measured = [name for name in STUDIES if provenance_path(directory, name).exists()]
    if not measured:
        raise InputError(
            f"{directory}: contains no study; expected a table such as {next(iter(STUDIES))}.csv, "
            "written by `saccade study`"
        )
    separate = len(measured) == 1 and measured[0] in SEPARATE
    words, about = Prose("words"), measured[0] if separate else ""
    title = words.line("report_title", about)
    opening = words.paragraphs("report_opening")
    parts = [make_part(directory, name) for name in (measured if separate else STUDIES)]
    if (directory / ATTENTION).is_dir():
        parts.append(attention_part(directory))
    pictures = {picture.file: picture.data for part in parts for picture in part.pictures}
    text = to_markdown(title, opening, parts)
    page, markdown = directory / "report.html", directory / "report.md"
    for path, content in ((page, to_html(text, pictures)), (markdown, text)):
        with write_atomically(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return page, markdown


def make_part(directory: Path, name: str) -> Part:
    """A study's part of the report, without results if the study was not run.

    Raises:
        InputError: The table was not written by this study.
    """
    absent = Section(STUDIES[name][1][0].upper() + STUDIES[name][1][1:])
    if not provenance_path(directory, name).exists():
        return Part(absent, measured=False)
    table, provenance = read_study(directory, name)
    if table.empty:
        return Part(absent, measured=False, provenance=provenance)
    where = table_path(directory, name)
    try:
        section = load_study(name).summarise(table, provenance)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except KeyError as error:
        raise InputError(f"{where}: not written by this study: {error} is missing") from None
    except ValueError as error:  # text in a column of numbers
        raise InputError(f"{where}: not written by this study: {error}") from None
    pictures = [draw(directory, f"{name}-{figure.name}", figure) for figure in section.figures]
    return Part(section, pictures, provenance=provenance)


def attention_part(directory: Path) -> Part:
    """What ``saccade attention`` wrote into the directory: its sheets, and links to its pages."""
    sheets, pages = (sorted((directory / ATTENTION).rglob(pattern)) for pattern in ("*.png", "*.html"))
    prose = Prose("attention", pages=[page.relative_to(directory).as_posix() for page in pages])
    pictures = []
    for sheet in sheets:
        file = sheet.relative_to(directory).as_posix()
        pictures.append(
            SavedPicture(prose.line("caption", file), file, as_uri("image/png", sheet.read_bytes()))
        )
    return Part(prose.section(), pictures, measured=bool(sheets))


def draw(directory: Path, name: str, figure: Figure) -> SavedPicture:
    """Writes the figure as PNG for the Markdown; the HTML gets it as SVG."""
    # With a fixed salt and without dates the same table gives the same files each time.
    with mpl.rc_context({"svg.hashsalt": "saccade"}):
        with write_atomically(writable_directory(directory / "figures") / f"{name}.png") as temporary:
            figure.picture.savefig(temporary, dpi=PNG_DOTS_PER_INCH, metadata={"Software": None})
        buffer = io.BytesIO()
        figure.picture.savefig(buffer, format="svg", metadata={"Date": None})
    svg = as_uri("image/svg+xml", buffer.getvalue())
    return SavedPicture(figure.caption, f"figures/{name}.png", svg)


def as_uri(kind: str, content: bytes) -> str:
    """A file's content as a ``data:`` URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
