"""Tables of commands: with rich if it is installed, else in plain columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from saccade.cli import output

WIDTH = 110  # characters in a line where the output is not a terminal


@dataclass(frozen=True)
class Section:
    """A table; columns whose names begin with ">" are numbers, aligned right."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def show(tables: Sequence[Section]) -> None:
    """Prints the tables: with rich if it is installed, else in plain columns."""
    try:
        from rich.table import Table
        from rich.text import Text
    except ModuleNotFoundError:
        print("\n\n".join(map(plain, tables)))
        return
    console = output.console(width=WIDTH)
    for section in tables:
        console.print(Text(section.title, style="bold"))
        table = Table(box=None, show_header=any(column.lstrip(">") for column in section.columns))
        for column in section.columns:
            table.add_column(column.lstrip(">"), justify="right" if column.startswith(">") else "left")
        for row in section.rows:
            table.add_row(*map(Text, row))
        console.print(table)
        console.print()


def plain(section: Section) -> str:
    """A table as text in plain columns."""
    rows = [[column.lstrip(">") for column in section.columns], *section.rows]
    widths = [max(len(row[index]) for row in rows) for index in range(len(section.columns))]
    lines = [
        "  ".join(
            cell.rjust(width) if column.startswith(">") else cell.ljust(width)
            for cell, width, column in zip(row, widths, section.columns, strict=True)
        ).rstrip()
        for row in rows
    ]
    return "\n".join([section.title, *lines])
