"""What commands write to standard output and standard error: tables, progress bars, JSON."""

from __future__ import annotations

import codecs
import contextlib
import functools
import io
import os
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from saccade._internal.json import dumps

if TYPE_CHECKING:
    from rich.console import Console

#: Characters of our texts, and what is written where the encoding of a stream lacks them.
ASCII = {"–": "-", "—": "-", "×": "x", "·": "*", "…": "...", "“": '"', "”": '"', "→": "->", "±": "+-"}
LINE_SECONDS = 60.0  # between two lines of progress
WIDTH = 110  # characters in a line of tables where the output is not a terminal
REPLACE = "saccade-ascii"  # name of the error handler


class OutputError(Exception):
    """Standard output cannot be written; the message says why."""


def prepare_streams() -> None:
    """Makes both streams accept any text in any encoding; `OutputError` if standard output is closed."""
    if sys.stdout is None:
        raise OutputError("standard output is closed")
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    codecs.register_error(REPLACE, replace_with_ascii)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=REPLACE)


def replace_with_ascii(error: UnicodeError) -> tuple[str, int]:
    r"""Error handler of a codec: writes an ASCII replacement for what cannot be encoded.

    Example:
        >>> codecs.register_error(REPLACE, replace_with_ascii)
        >>> "R² 0.3–0.4 é \udcff".encode("ascii", REPLACE)
        b'R2 0.3-0.4 e ?'
    """
    if not isinstance(error, UnicodeEncodeError):
        raise error
    written = ""
    for character in error.object[error.start : error.end]:
        plain = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()
        written += ASCII.get(character) or plain or "?"
    return written, error.end


def flush() -> None:
    """Flushes standard output: `BrokenPipeError` if its reader is gone, else `OutputError`."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"standard output: {error.strerror or error}") from error


def discard_output() -> None:
    """Sends the rest of standard output nowhere, so that no error follows when the interpreter ends."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def print_json(value: Any, *, indent: int | None = None, default: Callable[[Any], Any] | None = None) -> None:
    """Prints one JSON document in ASCII; numbers that are not finite are ``null``."""
    print(dumps(value, indent=indent, default=default))


def note(command: str, message: str) -> None:
    """Prints progress to standard error."""
    print(f"{command}: {message} ...", file=sys.stderr, flush=True)


@functools.cache
def _console_class() -> type[Console]:
    from rich.console import Console

    class SaccadeConsole(Console):
        """A console that leaves a closed pipe to `saccade.cli.main`; rich would exit with status 1."""

        def on_broken_pipe(self) -> None:
            raise  # rich calls this while it handles the error

    return SaccadeConsole


def console(*, stderr: bool = False, width: int | None = None) -> Console:
    """A console of rich; `width` characters in a line where it is not a terminal, None for rich's 80."""
    made = _console_class()(stderr=stderr)
    if width is not None and not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = width
    return made


@dataclass(frozen=True)
class Section:
    """A table; columns whose names begin with ">" are numbers, aligned right. A note is printed below."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


def show(tables: Sequence[Section]) -> None:
    """Prints the tables: with rich if it is installed, else in plain columns."""
    try:
        from rich.table import Table
        from rich.text import Text
    except ModuleNotFoundError:
        print("\n\n".join(map(plain, tables)))
        return
    shown = console(width=WIDTH)
    for section in tables:
        shown.print(Text(section.title, style="bold"))
        table = Table(box=None, show_header=any(column.lstrip(">") for column in section.columns))
        for column in section.columns:
            table.add_column(column.lstrip(">"), justify="right" if column.startswith(">") else "left")
        for row in section.rows:
            table.add_row(*map(Text, row))
        shown.print(table)
        if section.note:
            shown.print(Text(section.note))
        shown.print()


def plain(section: Section) -> str:
    """A table as text in plain columns.

    Example:
        >>> print(plain(Section("Errors", ["key", ">MSE"], [["hand", "0.5"]], note="One episode.")))
        Errors
        key   MSE
        hand  0.5
        One episode.
    """
    rows = [[column.lstrip(">") for column in section.columns], *section.rows]
    widths = [max(len(row[index]) for row in rows) for index in range(len(section.columns))]
    lines = [
        "  ".join(
            cell.rjust(width) if column.startswith(">") else cell.ljust(width)
            for cell, width, column in zip(row, widths, section.columns, strict=True)
        ).rstrip()
        for row in rows
    ]
    return "\n".join([section.title, *lines, *filter(None, [section.note])])


class Update(Protocol):
    """Moves a progress bar, or writes a line of progress."""

    def __call__(self, completed: int, total: int | None = None, description: str | None = None) -> None:
        """Shows how much is done; None leaves total and description as they are."""


class Lines:
    """Progress where no bar can be shown, as in a log: at most one line a minute, on standard error."""

    def __init__(self, description: str, total: int | None, *, in_bytes: bool) -> None:
        self._description, self._total, self._in_bytes = description, total, in_bytes
        self._printed = time.monotonic()

    def __call__(self, completed: int, total: int | None = None, description: str | None = None) -> None:
        """See `Update`."""
        self._total = self._total if total is None else total
        self._description = self._description if description is None else description
        now = time.monotonic()
        if now - self._printed < LINE_SECONDS:
            return
        self._printed = now
        of = "" if self._total is None else f" of {self._amount(self._total)}"
        print(f"{self._description}: {self._amount(completed)}{of}", file=sys.stderr, flush=True)

    def _amount(self, items: int) -> str:
        return f"{items / 1e6:,.0f} MB" if self._in_bytes else str(items)


@contextlib.contextmanager
def progress_bar(
    description: str, total: int | None = None, *, in_bytes: bool = False, transient: bool = False
) -> Iterator[Update]:
    """A progress bar on standard error; without a terminal or rich, at most one line a minute.

    `in_bytes` shows megabytes instead of a count, and a `transient` bar is removed at the end.
    """
    shown = None
    with contextlib.suppress(ModuleNotFoundError):
        from rich import progress as rich

        shown = console(stderr=True)
    if shown is None or not shown.is_terminal:  # a bar would leave a line there for each of its states
        yield Lines(description, total, in_bytes=in_bytes)
        return
    text = rich.TextColumn("{task.description}", markup=False)
    counted = rich.DownloadColumn() if in_bytes else rich.MofNCompleteColumn()
    columns = (text, rich.BarColumn(), counted, rich.TimeRemainingColumn())
    with rich.Progress(*columns, console=shown, transient=transient) as progress:
        bar = progress.add_task(description, total=total)

        def update(completed: int, total: int | None = None, description: str | None = None) -> None:
            progress.update(bar, completed=completed, total=total, description=description)

        yield update
