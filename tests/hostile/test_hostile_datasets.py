"""Every value of a data set's metadata replaced by something else: an error of ours, or the same data."""

from __future__ import annotations

import contextlib
import copy
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import saccade.datasets
from tests.helpers import dataset_cases as cases

VALUES: list[Any] = [
    *(None, True, -1, 0, 10**30, 1.5, float("inf"), float("nan")),
    *("", "x\0", "../..", [], {}, [[]], {"a": {}}),
]


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all values in a JSON value."""
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, (*path, key))


def replaced(value: Any, path: tuple[Any, ...], other: Any) -> Any:
    found = copy.deepcopy(value)
    place = found
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = other
    return found


def read_all(root: Path) -> None:
    """Reads something of everything; errors of ours are fine."""
    with contextlib.suppress(saccade.SaccadeError, FileNotFoundError):
        data = saccade.datasets.open(root)
        for episode in range(len(data)):
            data.state(episode, 0)
            data.actions(episode, 0, 3)
            data.instruction(episode, 0)
            data.observation(episode, 0, "lerobot")
        assert repr(data)
        assert set(data.statistics) == {"state", "action"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("whole")
    cases.write_old(folder / "old")
    cases.write_new(folder / "new")
    return folder


@pytest.mark.parametrize("name", ["info.json", "modality.json"])
def test_json(whole: Path, tmp_path: Path, name: str) -> None:
    root = tmp_path / "data"
    shutil.copytree(whole / "old", root)
    values = json.loads((root / "meta" / name).read_text())
    for number, path in enumerate(places(values)):
        for other in VALUES[number % 3 :: 3]:  # a third of them at each place
            (root / "meta" / name).write_text(json.dumps(replaced(values, path, other)))
            read_all(root)
    for text in ("", "[]", "1", "[" * 100_000, '{"features": {', "\xff"):
        (root / "meta" / name).write_bytes(text.encode("latin-1"))
        read_all(root)


@pytest.mark.parametrize("name", ["episodes.jsonl", "tasks.jsonl", "episodes_stats.jsonl"])
def test_json_lines(whole: Path, tmp_path: Path, name: str) -> None:
    root = tmp_path / "data"
    shutil.copytree(whole / "old", root)
    lines = (root / "meta" / name).read_text().splitlines()
    first = json.loads(lines[0])
    for number, path in enumerate(places(first)):
        for other in VALUES[number % 3 :: 3]:
            cases.write_lines(
                root / "meta" / name, [replaced(first, path, other), *map(json.loads, lines[1:])]
            )
            read_all(root)
    for text in ("", "[]", "1\n2", "{", "\xff"):
        (root / "meta" / name).write_bytes(text.encode("latin-1"))
        read_all(root)


@pytest.mark.parametrize("name", ["tasks.parquet", "episodes/chunk-000/file-000.parquet"])
def test_parquet(whole: Path, tmp_path: Path, name: str) -> None:
    root = tmp_path / "data"
    shutil.copytree(whole / "new", root)
    table = pq.read_table(root / "meta" / name)
    count = table.num_rows
    for place, column in enumerate(table.column_names):
        for other in (
            [None] * count,
            [-1] * count,
            [1e30] * count,
            ["x"] * count,
            [["x"]] * count,
            [[1]] * count,
        ):
            pq.write_table(table.set_column(place, column, pa.array(other)), root / "meta" / name)
            read_all(root)
        pq.write_table(table.remove_column(place), root / "meta" / name)
        read_all(root)


def test_other_columns_of_the_steps(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(whole / "new", root)
    file = root / "data" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(file)
    count = table.num_rows
    for place, column in enumerate(table.column_names):
        for other in (
            [None] * count,
            [-1] * count,
            [1e300] * count,
            ["x"] * count,
            [[[1]]] * count,
            [{"a": 1}] * count,
        ):
            pq.write_table(table.set_column(place, column, pa.array(other)), file)
            read_all(root)
    for content in (b"", b"PAR1", file.read_bytes()[:-9], file.read_bytes()[9:]):
        file.write_bytes(content)
        read_all(root)
