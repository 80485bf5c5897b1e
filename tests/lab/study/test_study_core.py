"""Cells that are resumed, tables that come back as they were, and intervals against published values."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from saccade.errors import InputError
from saccade_lab.parallel import Workers
from saccade_lab.study import table as tables
from saccade_lab.study.cell import Cell, Rows, digest
from saccade_lab.study.run import StudyError, read_record, run_cells
from saccade_lab.study.study import STUDIES, load_study

TWO = Workers(jobs=2)
SETTINGS = {"checkpoint": "abc", "width": 0.1}


@dataclass(frozen=True)
class Square:
    """Squares a cell's number, records the call, and fails or dies at the given cells."""

    log: Path
    fails: tuple[int, ...] = ()
    dies: tuple[int, ...] = ()

    def __call__(self, cell: Cell) -> Rows:
        number = int(cell.key[1])
        with self.log.open("a") as log:
            log.write(f"{number}\n")
        if number in self.dies:
            os._exit(9)
        if number in self.fails:
            raise ValueError(f"cannot square {number}")
        return [
            {"arm": cell.key[0], "number": number, "square": np.float64(number**2), "odd": number % 2 == 1}
        ]

    @property
    def worked(self) -> list[int]:
        """The numbers it was given so far, in order, and forgets them."""
        numbers = [int(line) for line in self.log.read_text().split()]
        self.log.unlink()
        return numbers


def cells(*numbers: int) -> list[Cell]:
    return [Cell(("square", number)) for number in numbers]


def test_a_second_run_does_only_what_is_missing(tmp_path: Path) -> None:
    work, out = Square(tmp_path / "log"), tmp_path / "out"
    seen: list[tuple[str, int, int]] = []
    run_cells("demo", cells(10, 9), work, out, settings=SETTINGS)
    assert work.worked == [10, 9]
    table = run_cells(
        "demo",
        cells(10, 9, 2),
        work,
        out,
        settings=SETTINGS,
        on_done=lambda finished, done, total: seen.append((finished.cell.name, done, total)),
    )
    assert work.worked == [2]
    assert seen == [("square 2", 3, 3)]
    assert table["number"].tolist() == [2, 9, 10]  # sorted as numbers
    assert set(table["settings_sha256"]) == {digest(SETTINGS)}
    assert table["cpu"].notna().all()

    provenance = tables.read_provenance(out / "demo.json")
    assert provenance.complete
    assert (provenance.done, provenance.total, provenance.settings) == (3, 3, SETTINGS)
    assert provenance.packages.keys() >= {"saccade", "numpy"}
    assert provenance.machine.keys() == {"cpu", "system", "python"}
    assert json.loads((out / "demo.json").read_text())["complete"] is True


def test_a_killed_run_keeps_what_was_done(tmp_path: Path) -> None:
    """The process dies in the middle of a cell, as if killed; the next one goes on."""
    script = (
        "from tests.lab.study.test_study_core import *\n"
        f"work = Square(Path({str(tmp_path / 'log')!r}), dies=(3,))\n"
        f"run_cells('demo', cells(1, 2, 3, 4), work, Path({str(tmp_path / 'out')!r}), settings=SETTINGS)\n"
    )
    killed = subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parents[3], check=False)
    assert killed.returncode == 9
    half = tables.read_provenance(tmp_path / "out" / "demo.json")
    assert (half.done, half.total, half.complete) == (2, 4, False)
    assert tables.read_table(tmp_path / "out" / "demo.csv")["number"].tolist() == [1, 2]

    work = Square(tmp_path / "log")
    assert work.worked == [1, 2, 3]
    table = run_cells("demo", cells(1, 2, 3, 4), work, tmp_path / "out", settings=SETTINGS)
    assert work.worked == [3, 4]
    assert table["square"].tolist() == [1.0, 4.0, 9.0, 16.0]
    left = [path.name for path in (tmp_path / "out").rglob("*") if path.name.startswith(".")]
    assert left == []


def test_a_study_in_phases_is_not_complete_before_the_last(tmp_path: Path) -> None:
    work, totals = Square(tmp_path / "log"), []
    for several in (cells(1), cells(1, 2)):
        run_cells(
            "demo",
            several,
            work,
            tmp_path,
            settings=SETTINGS,
            expected=2,
            on_done=lambda finished, done, total: totals.append((done, total)),
        )
        assert tables.read_provenance(tmp_path / "demo.json").complete == (len(several) == 2)
    assert totals == [(1, 2), (2, 2)]


def test_a_failing_cell_is_named_after_the_others_are_done(tmp_path: Path) -> None:
    work = Square(tmp_path / "log", fails=(1,))
    with pytest.raises(StudyError, match=r"1 of 3 cells failed: square 1: ValueError: cannot square 1"):
        run_cells("demo", cells(1, 2, 3), work, tmp_path, settings=SETTINGS)
    assert work.worked == [1, 2, 3]
    half = tables.read_provenance(tmp_path / "demo.json")
    assert (half.done, half.complete) == (2, False)
    assert half.failed == [{"key": ["square", 1], "error": "ValueError: cannot square 1"}]

    run_cells("demo", cells(1, 2, 3), Square(tmp_path / "log"), tmp_path, settings=SETTINGS)
    assert work.worked == [1]
    assert tables.read_provenance(tmp_path / "demo.json").failed == []


def test_two_processes_give_the_same_table(tmp_path: Path) -> None:
    work = Square(tmp_path / "log")
    one = run_cells("demo", cells(*range(6)), work, tmp_path / "one", settings=SETTINGS)
    two = run_cells("demo", cells(*range(6)), work, tmp_path / "two", settings=SETTINGS, workers=TWO)
    pd.testing.assert_frame_equal(one, two)
    assert (tmp_path / "one" / "demo.csv").read_bytes() == (tmp_path / "two" / "demo.csv").read_bytes()


def test_a_cell_whose_process_dies_is_named_and_the_others_are_done(tmp_path: Path) -> None:
    work = Square(tmp_path / "log", dies=(2,))
    with pytest.raises(
        StudyError, match=r"1 of 4 cells failed: square 2: a worker process died in each of 4"
    ):
        run_cells("demo", cells(1, 2, 3, 4), work, tmp_path, settings=SETTINGS, workers=TWO)
    assert tables.read_table(tmp_path / "demo.csv")["number"].tolist() == [1, 3, 4]
    assert work.worked.count(2) == 4


def test_cell_files_that_are_none_are_done_anew(tmp_path: Path) -> None:
    """Half a file under its temporary name, files of something else, and cells of other settings."""
    work = Square(tmp_path / "log")
    run_cells("demo", cells(1, 2), work, tmp_path, settings=SETTINGS)
    one, _ = sorted((tmp_path / "demo" / "cells").iterdir())
    (one.parent / f".{one.stem}.99.json").write_text('{"key": ["squ')
    one.write_text("[1, 2]")
    (one.parent / "other.json").write_text('{"key": ["square", 9], "rows": []}')
    assert work.worked == [1, 2]
    assert len(run_cells("demo", cells(1, 2), work, tmp_path, settings=SETTINGS)) == 2
    assert len(work.worked) == 1

    (tmp_path / "demo.json").unlink()  # so that nothing says what the cells were done with
    table = run_cells("demo", cells(1, 2), work, tmp_path, settings={**SETTINGS, "width": 0.2})
    assert work.worked == [1, 2]
    assert set(table["settings_sha256"]) == {digest({**SETTINGS, "width": 0.2})}


def test_other_settings_are_refused(tmp_path: Path) -> None:
    work = Square(tmp_path / "log")
    run_cells("demo", cells(1), work, tmp_path, settings=SETTINGS)
    with pytest.raises(InputError, match=r"other settings \(width 0.1, now 0.2\)"):
        run_cells("demo", cells(1), work, tmp_path, settings={**SETTINGS, "width": 0.2})
    run_cells("other", cells(1), work, tmp_path, settings={"width": 0.2})  # another study may have its own


def test_a_cell_with_other_settings_takes_the_place_of_its_predecessor(tmp_path: Path) -> None:
    work = Square(tmp_path / "log")
    first = [Cell(("square", 1), {"steps": 1}), Cell(("square", 2), {"steps": 1})]
    run_cells("demo", first, work, tmp_path, settings=SETTINGS)
    table = run_cells("demo", [Cell(("square", 1), {"steps": 2})], work, tmp_path, settings=SETTINGS)
    assert work.worked == [1, 2, 1]
    assert table["number"].tolist() == [1, 2]


def test_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="duplicate keys"):
        run_cells("demo", cells(1, 1), Square(tmp_path / "log"), tmp_path, settings=SETTINGS)


def test_a_table_comes_back_as_it_was(tmp_path: Path) -> None:
    rows = [
        {"arm": "none", "task": "NA", "value": 0.1 + 0.2, "count": 3, "note": None},
        {"arm": "None", "task": 'a,b\n"c" ü', "value": -1e-300, "count": -4, "note": "not measured"},
        {"arm": "nan", "task": " x", "value": math.nan, "count": 5, "later": True},
    ]
    tables.write_table(rows, tmp_path / "t.csv")
    table = tables.read_table(tmp_path / "t.csv")
    assert list(table.columns) == ["arm", "task", "value", "count", "note", "later"]
    assert table["arm"].tolist() == ["none", "None", "nan"]
    assert table["task"].tolist() == [row["task"] for row in rows]
    assert table["value"].tolist()[:2] == pytest.approx([0.1 + 0.2, -1e-300], rel=1e-15)
    assert table["count"].tolist() == [3, -4, 5]
    assert table[["note", "later"]].isna().to_numpy().tolist() == [[True, True], [False, True], [True, False]]
    assert math.isnan(table["value"].iloc[2])


def test_tables_of_earlier_versions_have_todays_names(tmp_path: Path) -> None:
    tables.write_table([{"task": "push", "looks": 7, "moment": "pour/1"}], tmp_path / "t.csv")
    assert list(tables.read_table(tmp_path / "t.csv").columns) == ["task", "num_observations", "observation"]
    record = {"study": "t", "settings": {"looks": 2}, "done": 1, "total": 1, "complete": True}
    (tmp_path / "t.json").write_text(json.dumps(record))
    assert tables.read_provenance(tmp_path / "t.json").settings == {"num_observations": 2}
    cell = {"key": ["push"], "settings": {}, "seconds": 1.0, "rows": [{"looks": 7}]}
    (tmp_path / "cell.json").write_text(json.dumps(cell))
    assert read_record(tmp_path / "cell.json") == {**cell, "rows": [{"num_observations": 7}]}


def test_tables_that_are_none(tmp_path: Path) -> None:
    tables.write_table([], tmp_path / "empty.csv")
    assert tables.read_table(tmp_path / "empty.csv").empty
    (tmp_path / "broken.csv").write_text('a,b\n1,"2\n')
    with pytest.raises(InputError, match=r"broken\.csv: not a table"):
        tables.read_table(tmp_path / "broken.csv")
    for text in ("{", "[]", '{"study": "x"}', '{"complete": true, "other": 1}'):
        (tmp_path / "broken.json").write_text(text)
        with pytest.raises(InputError, match=r"broken\.json: not written by a study"):
            tables.read_provenance(tmp_path / "broken.json")


def test_studies_are_found_by_name() -> None:
    with pytest.raises(InputError, match=f"unknown name 'cut', expected one of {', '.join(STUDIES)}"):
        load_study("cut")
    assert load_study("cuts").name == "cuts"
