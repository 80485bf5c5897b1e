"""Parquet files: the steps of an episode, and tables of metadata."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saccade._internal.extras import SACCADE
from saccade.errors import DatasetError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

EPISODE = "episode_index"


@dataclass(frozen=True)
class Steps:
    """The steps of one episode as columns.

    Attributes:
        where: What messages begin with: the file and the episode.
        table: The columns.
    """

    where: str
    table: pa.Table

    def __len__(self) -> int:
        return int(self.table.num_rows)

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return list(self.table.column_names)

    def numbers(self, name: str) -> npt.NDArray[Any]:
        """A column of numbers, ``(steps, width)``, of the type that it has; width 1 for single numbers.

        Raises:
            DatasetError: There is no such column, it does not hold numbers, or steps differ in width.
        """
        import pyarrow.types as types

        column = self._column(name)
        is_list = types.is_list(column.type) or types.is_large_list(column.type)
        width = 1
        if is_list or types.is_fixed_size_list(column.type):
            widths = {len(row) for row in column.to_pylist()} if is_list else {column.type.list_size}
            if len(widths) > 1:
                first = next(step for step, row in enumerate(column) if len(row) != len(column[0]))
                raise DatasetError(
                    f"{self.where}, step {first}: {name}: expected {len(column[0])} numbers, as step 0 has, "
                    f"got {len(column[first])}"
                )
            width, column = widths.pop(), column.flatten()
        kind = column.type
        if not (types.is_floating(kind) or types.is_integer(kind) or types.is_boolean(kind)):
            raise DatasetError(f"{self.where}: {name}: expected numbers or lists of numbers, got {kind}")
        if column.null_count:
            raise DatasetError(f"{self.where}: {name}: a number is missing")
        values: npt.NDArray[Any] = column.to_numpy(zero_copy_only=False)
        return values.reshape(len(self), width)

    def values(self, name: str) -> list[Any]:
        """A column as Python values.

        Raises:
            DatasetError: There is no such column.
        """
        found: list[Any] = self._column(name).to_pylist()
        return found

    def _column(self, name: str) -> Any:
        if name not in self.table.column_names:
            raise DatasetError(f"{self.where}: no column {name}, got {', '.join(self.names)}")
        column = self.table.column(name).combine_chunks()
        if column.null_count:
            step = column.is_null().to_pylist().index(True)
            raise DatasetError(f"{self.where}, step {step}: {name}: no value")
        return column


def read_steps(path: Path, episode: int, is_wanted: Callable[[str], bool]) -> Steps:
    """The steps of an episode in a file that may hold several, with the columns whose names are wanted.

    Only the row groups that hold steps of the episode are read.

    Raises:
        DatasetError: The file is damaged.
    """
    with _opened(path) as file:
        names = file.schema_arrow.names
        chosen = [name for name in names if is_wanted(name) or name == EPISODE]
        groups = [group for group in range(file.num_row_groups) if _may_hold(file, group, episode)]
        table = file.read_row_groups(groups, columns=chosen, use_threads=False)
        if EPISODE in names:
            column = table.column(EPISODE).combine_chunks().to_numpy(zero_copy_only=False)
            table = table.filter(_mask(column == episode))
    return Steps(f"{path}: episode {episode}", table)


def read_rows(path: Path, is_wanted: Callable[[str], bool]) -> list[dict[str, Any]]:
    """The rows of a file, with the columns whose names are wanted.

    Raises:
        FileNotFoundError: The file does not exist.
        DatasetError: It is damaged.
    """
    with _opened(path) as file:
        names = [name for name in file.schema_arrow.names if is_wanted(name)]
        rows: list[dict[str, Any]] = file.read(columns=names, use_threads=False).to_pylist()
    return rows


def read_tasks(path: Path) -> list[tuple[str, Any]]:
    """Instructions and their indices. lerobot writes the instructions as the index of a pandas table.

    Raises:
        FileNotFoundError: The file does not exist.
        DatasetError: It is damaged.
    """
    found = []
    for row in read_rows(path, lambda name: True):
        texts = [value for name, value in row.items() if name in ("task", "__index_level_0__")]
        if len(texts) != 1 or not isinstance(texts[0], str):
            raise DatasetError(f"{path}: expected the columns task and task_index, got {', '.join(row)}")
        found.append((texts[0], row.get("task_index")))
    return found


@contextmanager
def _opened(path: Path) -> Iterator[pq.ParquetFile]:
    """An open file. What pyarrow raises becomes an error that names the file."""
    SACCADE.require("pyarrow")
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with pq.ParquetFile(path) as file:
            yield file
    except DatasetError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path}: cannot be read as Parquet: {str(error).splitlines()[0]:.200}") from None


def _mask(chosen: npt.NDArray[np.bool_]) -> Any:
    import pyarrow as pa

    return pa.array(chosen)


def _may_hold(file: pq.ParquetFile, group: int, episode: int) -> bool:
    """Whether a row group may hold steps of an episode; it says so only if it has statistics."""
    about = file.metadata.row_group(group)
    for place in range(about.num_columns):
        column = about.column(place)
        if column.path_in_schema == EPISODE and column.is_stats_set and column.statistics.has_min_max:
            return bool(column.statistics.min <= episode <= column.statistics.max)
    return True
