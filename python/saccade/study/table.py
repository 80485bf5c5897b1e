"""A study's table: tidy CSV, one row a measurement, with a JSON beside it that says where it comes from."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from saccade._files import sha256_of, write_atomically, write_json
from saccade.errors import InputError


@dataclass(frozen=True)
class Provenance:
    """Where a table comes from; `OUT/<study>.json`.

    Attributes:
        study: Its name.
        settings: What the whole table depends on: checkpoint and its hash, engine, seeds, and so on.
        done, total: Cells that are finished, and all that were asked for.
        failed: Of each cell that raised, its key and the error.
        cell_seconds: Time spent in the finished cells, all added up.
        packages: Versions of what computed it.
        machine: CPU, system and Python of the process that wrote the table; each row names its own CPU.
        table_sha256: Of the table as it was written; empty if that is not known.
    """

    study: str
    settings: Mapping[str, Any]
    done: int
    total: int
    failed: list[dict[str, Any]] = field(default_factory=list)
    cell_seconds: float = 0.0
    packages: Mapping[str, str] = field(default_factory=dict)
    machine: Mapping[str, str] = field(default_factory=dict)
    table_sha256: str = ""

    @property
    def complete(self) -> bool:
        """Whether every cell that was asked for is in the table."""
        return self.done == self.total


def write_table(rows: Iterable[Mapping[str, Any]], path: Path) -> None:
    """Writes rows as CSV; columns are those of all rows, in the order in which they first occur.

    A value that is missing, `None` or not a number is an empty field.
    """
    with write_atomically(path) as temporary:
        pd.DataFrame(list(rows)).to_csv(temporary, index=False)


def read_table(path: Path) -> pd.DataFrame:
    """Reads what `write_table` wrote; empty fields are NaN.

    Raises:
        FileNotFoundError: there is none.
        InputError: it is no CSV.
    """
    if path.stat().st_size <= 1:  # a table without rows has no columns either
        return pd.DataFrame()
    try:
        # Words like "none" or "NA" are names here, not missing values.
        return pd.read_csv(path, keep_default_na=False, na_values=[""])
    except (pd.errors.ParserError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a table: {error}") from None


def write_provenance(provenance: Provenance, path: Path) -> None:
    """Writes it as JSON, with `complete` for readers that do not count."""
    write_json(path, {**asdict(provenance), "complete": provenance.complete})


def read_provenance(path: Path) -> Provenance:
    """Reads what `write_provenance` wrote.

    Raises:
        FileNotFoundError: there is none.
        InputError: it is something else.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        values.pop("complete")
        return Provenance(**values)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not written by a study: {error}") from None


def read_study(out: Path, study: str) -> tuple[pd.DataFrame, Provenance]:
    """A study's table and where it comes from.

    Raises:
        FileNotFoundError: one of the two is not there.
        InputError: they do not belong together.
    """
    provenance = read_provenance(provenance_path(out, study))
    path = table_path(out, study)
    table = read_table(path)
    if provenance.table_sha256 not in ("", sha256_of(path)):
        raise InputError(
            f"{path}: not as its study wrote it (edited, cut short, or the run was killed just then); "
            "run the study again, which takes no time for what is done"
        )
    return table, provenance


def truths(column: pd.Series) -> pd.Series:
    """A column of True and False as booleans.

    Raises:
        InputError: it holds something else.
    """
    values = column.map({True: True, False: False, "True": True, "False": False})
    if values.isna().any():
        wrong = column[values.isna()].iloc[0]
        raise InputError(f"{column.name}: expected True or False in every row, got {wrong!r}")
    return values.astype(bool)


def table_path(out: Path, study: str) -> Path:
    """Where a study's table lies."""
    return out / f"{study}.csv"


def provenance_path(out: Path, study: str) -> Path:
    """Where it says what the table comes from."""
    return out / f"{study}.json"


def clusters_of(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    """Of each row what it stands and falls with: its episode, in a table of the simulator the seed."""
    return list(zip(table["task"], table["episode" if "episode" in table else "seed"], strict=True))


def from_file(provenance: Provenance) -> bool:
    """Whether a table was measured on a file of features."""
    return "features" in provenance.settings
