"""Running a study: its cells are stored as soon as they are done, run in processes, and are resumable."""

from __future__ import annotations

import contextlib
import functools
import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from saccade._internal.files import sha256_of, write_json
from saccade.errors import InputError, SaccadeError
from saccade_lab.files import changed, writable_directory
from saccade_lab.machine import cpu_name
from saccade_lab.parallel import ALONE, Lost, Workers, each
from saccade_lab.study.cell import Cell, Rows, digest, plain, sortable
from saccade_lab.study.code_version import code_version
from saccade_lab.study.study import Study
from saccade_lab.study.table import (
    Provenance,
    provenance_path,
    read_provenance,
    read_table,
    renamed,
    table_path,
    write_provenance,
    write_table,
)

RECORDED_PACKAGES = ("numpy", "scipy", "torch", "mujoco", "metaworld")


class StudyError(SaccadeError):
    """Some cells of a study failed. The others are stored; the next run repeats only the failed ones."""


@dataclass(frozen=True)
class Finished:
    """The result of a cell: rows, or an error and no rows."""

    cell: Cell
    rows: Rows
    seconds: float
    error: str | None = None


#: Called after each cell with its result, the number of cells done or failed so far, and the number of all.
OnDone: TypeAlias = Callable[[Finished, int, int], None]


def silent(finished: Finished, done: int, total: int) -> None:
    """An ``OnDone`` that does nothing."""


def run(study: Study, out: Path, *, workers: Workers = ALONE, on_done: OnDone = silent) -> pd.DataFrame:
    """Computes all stages of a study, and its table.

    Args:
        study: What is measured.
        out, workers, on_done: As in ``run_cells``.

    Returns:
        The table.

    Raises:
        InputError, StudyError: As ``run_cells``.
    """
    stage: Study | None = study.begin(out.absolute())  # other processes may be in another directory
    while stage is not None:
        table = run_cells(
            stage.name,
            stage.cells(),
            stage.measure,
            out,
            settings=stage.settings(),
            workers=workers,
            files=stage.files,
            on_done=on_done,
            expected=stage.num_cells,
        )
        stage = stage.then(table)
    return table


def run_cells(
    study: str,
    cells: Sequence[Cell],
    work: Callable[[Cell], Rows],
    out: Path,
    *,
    settings: Mapping[str, Any],
    workers: Workers = ALONE,
    files: Sequence[str | Path] = (),
    on_done: OnDone = silent,
    expected: int = 0,
) -> pd.DataFrame:
    """Computes the cells that are not done yet. A run that was killed continues where it stopped.

    A finished cell is a file in ``OUT/<study>/cells``. After each cell ``OUT/<study>.csv`` (rows of all
    finished cells, sorted by key, with the columns that ``work`` returned and ``settings_sha256``,
    ``saccade`` and ``cpu``) and ``OUT/<study>.json`` are rewritten. Cells of an earlier run with the same
    settings stay in the table, so a study can be extended by running it again with more cells.

    Args:
        study: Name of the table.
        cells: All of them, done or not, with distinct keys.
        work: Function from a cell to its rows; values are text, numbers, booleans or None. It runs in other
            processes, so it must be picklable.
        out: Directory of the tables.
        settings: JSON values that all rows depend on: hashes of checkpoints, engine, and so on; not what
            only determines which cells there are.
        workers: The processes that cells run in. A cell whose process or machine died is computed again.
        files: Files and directories that ``work`` reads, as ``saccade_lab.parallel.each`` takes them.
        on_done: Called after each cell.
        expected: Number of cells of all stages; the table is complete when that many are done.

    Returns:
        The table, as ``saccade_lab.study.table.read_table`` returns it.

    Raises:
        InputError: Keys that are not distinct, or ``out`` contains this study with other settings.
        StudyError: Cells failed, and the first ones are named with their errors. Finished cells remain
            stored.
    """
    if len({cell.key for cell in cells}) != len(cells):
        raise InputError(f"cells: {study} has duplicate keys")
    store = Store(study, out, settings, cells, expected)
    todo = [cell for cell in cells if cell.digest not in store.finished]
    store.write()
    marks = {"settings_sha256": digest(settings), "saccade": code_version()}
    for cell, result in each(Guarded(work, marks), todo, workers, files):
        finished = Finished(cell, [], 0.0, result.reason) if isinstance(result, Lost) else result
        store.add(finished)
        on_done(finished, len(cells) - len(todo) + store.added, max(len(cells), expected))
    if store.failed:
        lines = [f"{finished.cell.name}: {finished.error}" for finished in store.failed[:3]]
        more = f"; and {len(store.failed) - 3} more" if len(store.failed) > 3 else ""
        raise StudyError(
            f"{study}: {len(store.failed)} of {len(cells)} cells failed: {'; '.join(lines)}{more}"
        )
    return read_table(table_path(out, study))


class Store:
    """The files of one study.

    Args:
        study, out, settings, cells, expected: As in ``run_cells``.

    Raises:
        InputError: ``out`` contains this study with other settings.
    """

    def __init__(
        self, study: str, out: Path, settings: Mapping[str, Any], cells: Sequence[Cell], expected: int
    ) -> None:
        self.study = study
        self.out = out
        self.settings = plain(settings)
        self.finished: dict[str, dict[str, Any]] = {}
        self.failed: list[Finished] = []
        self.added = 0
        self._check_settings()
        self.directory = writable_directory(out / study / "cells")
        asked = {cell.key: cell.digest for cell in cells}
        for path in self.directory.glob("*.json"):
            if path.name.startswith("."):
                continue  # incomplete, of a run that was killed
            record = read_record(path)
            # A cell with outdated settings must not be in the table together with its replacement.
            if record is None or any(
                row.get("settings_sha256") != digest(settings) for row in record["rows"]
            ):
                continue
            kept = Cell(tuple(record["key"]), record["settings"])
            if asked.get(kept.key, kept.digest) == kept.digest:
                self.finished[kept.digest] = record
        self.total = max(len({*self.finished, *asked.values()}), expected)

    def _check_settings(self) -> None:
        path = provenance_path(self.out, self.study)
        if not path.exists():
            return
        before = read_provenance(path).settings
        names = changed(before, self.settings)
        if names:
            changes = [f"{name} {before.get(name)!r}, now {self.settings.get(name)!r}" for name in names]
            raise InputError(
                f"out: {self.out} contains the study {self.study} with other settings "
                f"({'; '.join(changes)}); expected the same settings or another directory"
            )

    def add(self, finished: Finished) -> None:
        """Stores the result of a cell."""
        self.added += 1
        if finished.error is not None:
            self.failed.append(finished)
        else:
            cell = finished.cell
            record = plain(
                {
                    "key": list(cell.key),
                    "settings": cell.settings,
                    "seconds": round(finished.seconds, 3),
                    "rows": finished.rows,
                }
            )
            write_json(self.directory / f"{cell.digest}.json", record)
            self.finished[cell.digest] = record
        self.write()

    def write(self) -> None:
        """Writes table and provenance from the finished cells."""
        records = sorted(self.finished.values(), key=lambda record: sortable(record["key"]))
        rows = [row for record in records for row in record["rows"]]
        write_table(rows, table_path(self.out, self.study))
        versions = sorted({str(row["saccade"]) for row in rows if row.get("saccade")})
        provenance = Provenance(
            study=self.study,
            table_sha256=sha256_of(table_path(self.out, self.study)),
            settings=self.settings,
            done=len(records),
            total=self.total,
            failed=[{"key": list(one.cell.key), "error": one.error} for one in self.failed],
            cell_seconds=round(sum(record["seconds"] for record in records), 1),
            packages={"saccade": " and ".join(versions) or code_version(), **packages()},
            machine={
                "cpu": cpu_name(),
                "system": platform.platform(),
                "python": platform.python_version(),
            },
        )
        write_provenance(provenance, provenance_path(self.out, self.study))


def read_record(path: Path) -> dict[str, Any] | None:
    """Reads the file of a cell; None if its content is unusable, so that the cell is computed again."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        hash(tuple(record["key"]))
        settings, rows, seconds = (record[name] for name in ("settings", "rows", "seconds"))
    except (ValueError, KeyError, TypeError):
        return None
    fits = isinstance(settings, dict) and isinstance(rows, list) and isinstance(seconds, (int, float))
    if not fits or not all(isinstance(row, dict) for row in rows):
        return None
    return {**record, "rows": [renamed(row) for row in rows]}


@dataclass(frozen=True)
class Guarded:
    """``work`` that returns exceptions instead of raising them, and adds ``marks`` to every row."""

    work: Callable[[Cell], Rows]
    marks: Mapping[str, str]

    def __call__(self, cell: Cell) -> Finished:
        """The result of the cell."""
        start = time.perf_counter()
        try:
            rows = plain(self.work(cell))  # a value that JSON cannot represent is an error of this cell
        except Exception as error:  # raised as StudyError when the other cells are done
            spent = time.perf_counter() - start
            return Finished(cell, [], spent, f"{type(error).__name__}: {error}")
        marks = {**self.marks, "cpu": cpu_name()}
        return Finished(cell, [{**row, **marks} for row in rows], time.perf_counter() - start)


@functools.cache
def packages() -> dict[str, str]:
    """Versions of the installed packages that saccade computes with."""
    found = {}
    for name in RECORDED_PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
