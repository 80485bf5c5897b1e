"""The table of a study: tidy CSV, one row per measurement, and JSON with its provenance."""

from __future__ import annotations

import hashlib
import io
import json
import lzma
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from saccade._internal.files import write_atomically, write_json
from saccade.errors import InputError

#: Names of columns and settings that tables were written with before, and what they are called now.
FORMER_NAMES = {"looks": "num_observations", "moment": "observation"}


def renamed(values: Mapping[str, Any]) -> dict[str, Any]:
    """A row or settings with today's names."""
    return {FORMER_NAMES.get(name, name): value for name, value in values.items()}


@dataclass(frozen=True)
class Provenance:
    """The provenance of a table; ``OUT/<study>.json``.

    Attributes:
        study: Its name.
        settings: What the whole table depends on: checkpoint and its hash, engine, seeds, and so on.
        done, total: Number of finished cells, and of all.
        failed: Key and error of each cell that failed.
        cell_seconds: Total time of the finished cells.
        packages: Versions of the packages that computed it.
        machine: CPU, system and Python of the process that wrote the table; each row has its own CPU.
        table_sha256: Hash of the table as written; empty if unknown.
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
        """Whether all cells are in the table."""
        return self.done == self.total


def write_table(rows: Iterable[Mapping[str, Any]], path: Path) -> None:
    """Writes rows as CSV with the columns of all rows, in the order of their first occurrence.

    A value that is missing, None or NaN is an empty field.
    """
    with write_atomically(path) as temporary:
        pd.DataFrame(list(rows)).to_csv(temporary, index=False)


def read_table(path: Path) -> pd.DataFrame:
    """Reads what ``write_table`` wrote, or the same compressed with ``xz``; empty fields are NaN.

    Raises:
        FileNotFoundError: The file does not exist.
        InputError: The file is not CSV.
    """
    return parse_table(table_content(path), path)


def table_content(path: Path) -> bytes:
    """The bytes of a table, decompressed if its name ends in ``.xz``.

    Raises:
        FileNotFoundError: The file does not exist.
        InputError: It cannot be decompressed.
    """
    content = path.read_bytes()
    if path.suffix != ".xz":
        return content
    try:
        return lzma.decompress(content)
    except lzma.LZMAError as error:
        raise InputError(f"{path}: cannot be decompressed: {error}") from None


def parse_table(content: bytes, path: Path) -> pd.DataFrame:
    """The table in the bytes of a CSV file, with today's names; ``path`` names it in an ``InputError``."""
    if len(content) <= 1:  # a table without rows has no columns
        return pd.DataFrame()
    try:
        # Words like "none" or "NA" are names here, not missing values.
        table = pd.read_csv(io.BytesIO(content), keep_default_na=False, na_values=[""], low_memory=False)
    except (pd.errors.ParserError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a table: {error}") from None
    return table.rename(columns=FORMER_NAMES)


def write_provenance(provenance: Provenance, path: Path) -> None:
    """Writes it as JSON, with ``complete``."""
    write_json(path, {**asdict(provenance), "complete": provenance.complete})


def read_provenance(path: Path) -> Provenance:
    """Reads what ``write_provenance`` wrote; settings have today's names.

    Raises:
        FileNotFoundError: The file does not exist.
        InputError: The file has other content.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        values.pop("complete")
        values["settings"] = renamed(values["settings"])
        return Provenance(**values)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not written by a study: {error}") from None


def read_study(out: Path, study: str) -> tuple[pd.DataFrame, Provenance]:
    """The table of a study and its provenance. The table may be compressed: ``OUT/<study>.csv.xz``.

    Raises:
        FileNotFoundError: One of the two files does not exist.
        InputError: The table is not the one that the study wrote.
    """
    provenance = read_provenance(provenance_path(out, study))
    path = table_path(out, study)
    packed = path.with_name(f"{path.name}.xz")
    path = packed if packed.exists() and not path.exists() else path
    content = table_content(path)
    table = parse_table(content, path)
    if provenance.table_sha256 not in ("", hashlib.sha256(content).hexdigest()):
        raise InputError(
            f"{path}: not as its study wrote it (edited, truncated, or the run was killed while writing); "
            "run the study again: finished cells are not repeated"
        )
    return table, provenance


def truths(column: pd.Series) -> pd.Series:
    """A column of True and False as booleans.

    Raises:
        InputError: The column contains another value.
    """
    values = column.map({True: True, False: False, "True": True, "False": False})
    if values.isna().any():
        wrong = column[values.isna()].iloc[0]
        raise InputError(f"{column.name}: expected True or False in every row, got {wrong!r}")
    return values.astype(bool)


def table_path(out: Path, study: str) -> Path:
    """Path of the table of a study."""
    return out / f"{study}.csv"


def provenance_path(out: Path, study: str) -> Path:
    """Path of the provenance of a study."""
    return out / f"{study}.json"


def clusters_of(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    """The bootstrap cluster of each row: task and episode; the episode of the simulator is its seed."""
    return list(zip(table["task"], table["episode" if "episode" in table else "seed"], strict=True))


def is_recorded(provenance: Provenance) -> bool:
    """Whether a table was measured on recorded observations: a file of features, or pictures."""
    return "features" in provenance.settings or "frames" in provenance.settings
