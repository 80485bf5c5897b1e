"""Writes a LeRobotDataset of version 3.0, with ``modality.json``, all or nothing."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import UInt8Array, integer
from saccade._internal.extras import SACCADE
from saccade._internal.files import write_json
from saccade.datasets.encoding import VideoFile, video_info
from saccade.datasets.modality import ACTION, IMAGES, STATE, TASK
from saccade.datasets.statistics import aggregate, of_column, of_frames
from saccade.errors import InputError, ShapeError
from saccade.robots.data_configs import LANGUAGE_KEY

#: lerobot's: megabytes of a file until the next one begins, and files in a folder.
DATA_MB, VIDEO_MB, CHUNK = 100, 200, 1000
NAME = re.compile(r"[A-Za-z0-9_][\w-]*(\.[\w-]+)*", re.ASCII)
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
#: Columns that every data set of lerobot has.
INDICES = ("frame_index", "episode_index", "index", "task_index")


class Writer:
    """Writes a data set, which is there under its name when the ``with`` block ends without an error.

    Frames are compressed without loss: they are read as they were given. lerobot's loader reads the data set,
    and Isaac-GR00T's keys are in its ``modality.json``.

    Args:
        path: The folder. It must not exist, or be empty.
        fps: Steps per second.
        robot: Name of the robot.
        cameras: Height and width by the name of each camera.
        state: Number of values by each key of the state, in order.
        action: Number of values by each key of the action, in order.
        extra: Number of values by the name of each further column of integers.

    Raises:
        InputError: ``path`` is a file, or a folder with something in it; or an argument is out of range.
        MissingExtraError: A package of the extra ``data`` is not installed.

    Example:
        >>> import numpy as np, saccade
        >>> def record(folder: str) -> None:
        ...     sizes = {"cameras": {"front": (64, 64)}, "state": {"arm": 6}, "action": {"arm": 6}}
        ...     with saccade.datasets.Writer(folder, fps=30, robot="so100", **sizes) as writer:
        ...         writer.add_episode(
        ...             "pick the cube",
        ...             frames={"front": np.zeros((10, 64, 64, 3), np.uint8)},
        ...             state=np.zeros((10, 6), np.float32),
        ...             action=np.zeros((10, 6), np.float32),
        ...         )
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        fps: int,
        robot: str,
        cameras: Mapping[str, tuple[int, int]],
        state: Mapping[str, int],
        action: Mapping[str, int],
        extra: Mapping[str, int] | None = None,
    ) -> None:
        SACCADE.require("pyarrow", "av")
        self.path = Path(path)
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise InputError(f"path: expected a new or empty folder, got {self.path}, where something is")
        self._fps = integer("fps", fps)
        for argument, given in {"cameras": cameras, "state": state, "action": action, "extra": extra}.items():
            _check_names(argument, given or {})
        self._robot = robot
        self._cameras = {
            name: (integer(f"cameras: {name}", height), integer(f"cameras: {name}", width))
            for name, (height, width) in cameras.items()
        }
        self._numbers = {"state": dict(state), "action": dict(action)}
        self._widths = {STATE: sum(state.values()), ACTION: sum(action.values()), **(extra or {})}
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._statistics: dict[str, dict[str, npt.NDArray[Any]]] = {}
        self._frames = 0
        self._data: Any = None
        self._data_place = 0
        self._videos: dict[str, VideoFile] = {}
        self._video_places = dict.fromkeys(cameras, 0)
        self._root = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        self._is_open = False  # inside the ``with`` block, and every episode is whole

    def __enter__(self) -> Writer:
        shutil.rmtree(self._root, ignore_errors=True)
        self._root.mkdir(parents=True)
        self._is_open = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        is_whole, self._is_open = self._is_open, False
        try:
            with contextlib.ExitStack() as files:
                for video in self._videos.values():
                    files.callback(video.close)
                if self._data is not None:
                    files.callback(self._data.close)
            if kind is None:
                if not is_whole:
                    raise InputError("add_episode: an episode could not be written, nothing is kept")
                self._finish()
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._root.replace(self.path)
        except BaseException:
            if kind is None:
                raise  # otherwise what ended the block is raised, not what followed from it
        finally:
            shutil.rmtree(self._root, ignore_errors=True)

    def add_episode(
        self,
        task: str,
        *,
        frames: Mapping[str, UInt8Array],
        state: npt.ArrayLike,
        action: npt.ArrayLike,
        extra: Mapping[str, npt.ArrayLike] | None = None,
    ) -> None:
        """Adds an episode.

        Args:
            task: The instruction.
            frames: By camera, ``(steps, height, width, 3)`` uint8.
            state: ``(steps, width)``, the keys side by side; written as float32.
            action: ``(steps, width)``, likewise.
            extra: The further columns, ``(steps, width)`` integers.

        Raises:
            InputError, ShapeError: Something is missing, or has another shape or number of steps. Or this is
                outside the ``with`` block, or an earlier episode could not be written.
        """
        if not self._is_open:
            raise InputError("add_episode: expected a call in the with block, before an episode failed")
        columns = {STATE: _rows(STATE, state, np.float32), ACTION: _rows(ACTION, action, np.float32)}
        columns |= {name: _rows(name, values, np.int64) for name, values in (extra or {}).items()}
        length = len(columns[STATE])
        self._check(task, frames, columns, length)
        self._is_open = False  # until it is written as a whole
        episode = len(self._episodes)
        place = self._tasks.setdefault(task, len(self._tasks))
        steps = np.arange(length)
        scalars: dict[str, npt.NDArray[Any]] = {
            "timestamp": (steps / self._fps).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full(length, episode),
            "index": self._frames + steps,
            TASK: np.full(length, place),
        }
        row: dict[str, Any] = {
            "episode_index": episode,
            "tasks": [task],
            "length": length,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + length,
            **_file("data", self._write_columns(columns, scalars)),
            **_file("meta/episodes", 0),
        }
        found = {f"{IMAGES}{name}": of_frames(frames[name]) for name in self._cameras}
        found |= {name: of_column(values) for name, values in columns.items()}
        found |= {name: of_column(values[:, None]) for name, values in scalars.items()}
        for name in self._cameras:
            row |= self._write_frames(name, frames[name])
        for key, numbers in found.items():
            row |= {f"stats/{key}/{name}": value.tolist() for name, value in numbers.items()}
        self._statistics = aggregate([self._statistics, found]) if self._statistics else found
        self._frames += length
        self._episodes.append(row)
        self._is_open = True

    def _check(
        self, task: Any, frames: Mapping[str, Any], columns: Mapping[str, npt.NDArray[Any]], length: int
    ) -> None:
        if not isinstance(task, str):
            raise InputError(f"task: expected an instruction, got {task!r:.60}")
        for name, given, wanted in (("frames", frames, self._cameras), ("extra", columns, self._widths)):
            if set(given) != set(wanted):
                raise InputError(f"{name}: expected {', '.join(wanted)}, got {', '.join(given)}")
        if not length:
            raise ShapeError("state: expected at least one step, got none")
        for name, values in columns.items():
            if values.shape != (length, self._widths[name]):
                raise ShapeError(f"{name}: expected shape {(length, self._widths[name])}, got {values.shape}")
            if not np.isfinite(values).all():
                raise InputError(f"{name}: expected finite numbers, got NaN or infinity")
        for name, size in self._cameras.items():
            given, shape = frames[name], (length, *size, 3)
            if not isinstance(given, np.ndarray) or given.dtype != np.uint8 or given.shape != shape:
                got = f"{getattr(given, 'dtype', type(given).__name__)} {getattr(given, 'shape', '')}"
                raise ShapeError(f"frames: {name}: expected uint8 {shape}, got {got}")

    def _write_columns(
        self, columns: Mapping[str, npt.NDArray[Any]], scalars: Mapping[str, npt.NDArray[Any]]
    ) -> int:
        """Appends the steps of an episode as a row group; returns the number of the file."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        made = {
            name: pa.array(values[:, 0])
            if values.shape[1] == 1
            else pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
            for name, values in columns.items()
        }
        table = pa.table({**made, **{name: pa.array(values) for name, values in scalars.items()}})
        path = self._root / _path("data", self._data_place)
        if self._data is not None and path.stat().st_size >= DATA_MB * 2**20:
            self._data.close()
            self._data, self._data_place = None, self._data_place + 1
            path = self._root / _path("data", self._data_place)
        if self._data is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._data = pq.ParquetWriter(path, table.schema, compression="snappy")
        self._data.write_table(table)
        return self._data_place

    def _write_frames(self, name: str, frames: UInt8Array) -> dict[str, Any]:
        """Appends the frames of an episode; returns what ``meta/episodes`` says about them."""
        key, video = f"{IMAGES}{name}", self._videos.get(name)
        if video is not None and video.size >= VIDEO_MB * 2**20:
            video.close()
            self._video_places[name] += 1
            video = None
        place = self._video_places[name]
        if video is None:
            path = self._root / _path(f"videos/{key}", place, "mp4")
            video = self._videos[name] = VideoFile(path, self._fps, *self._cameras[name])
        start = video.duration
        video.append(frames)
        about = _file(f"videos/{key}", place)
        return {**about, f"videos/{key}/from_timestamp": start, f"videos/{key}/to_timestamp": video.duration}

    def _finish(self) -> None:
        """Writes the metadata."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not self._episodes:
            raise InputError("add_episode: expected at least one episode, got none")
        meta = self._root / "meta"
        path = meta / "episodes" / _path("", 0).lstrip("/")
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._episodes), path)
        texts, places = pa.array(list(self._tasks)), pa.array(list(self._tasks.values()))
        tasks = pa.table({TASK: places, "task": texts})
        pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(PANDAS)}), meta / "tasks.parquet")
        numbers = {
            key: {name: value.tolist() for name, value in found.items()}
            for key, found in self._statistics.items()
        }
        write_json(meta / "stats.json", numbers)
        write_json(meta / "modality.json", self._modality())
        write_json(meta / "info.json", self._info())

    def _modality(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for kind, keys in self._numbers.items():
            ends = np.cumsum(list(keys.values())).tolist()
            found[kind] = {
                key: {"start": end - width, "end": end}
                for (key, width), end in zip(keys.items(), ends, strict=True)
            }
        found["video"] = {name: {"original_key": f"{IMAGES}{name}"} for name in self._cameras}
        found["annotation"] = {LANGUAGE_KEY.removeprefix("annotation."): {"original_key": TASK}}
        return found

    def _info(self) -> dict[str, Any]:
        features: dict[str, Any] = {
            f"{IMAGES}{name}": {
                "dtype": "video",
                "shape": [*size, 3],
                "names": ["height", "width", "channels"],
                "info": video_info(self._fps, *size),
            }
            for name, size in self._cameras.items()
        }
        for kind, column in (("state", STATE), ("action", ACTION)):
            names = [
                key if width == 1 else f"{key}.{place}"
                for key, width in self._numbers[kind].items()
                for place in range(width)
            ]
            features[column] = {"dtype": "float32", "shape": [len(names)], "names": names}
        for name, width in list(self._widths.items())[2:]:
            features[name] = {"dtype": "int64", "shape": [width], "names": None}
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in INDICES}
        return {
            "codebase_version": "v3.0",
            "robot_type": self._robot,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": f"data/{FILE}.parquet",
            "video_path": f"videos/{{video_key}}/{FILE}.mp4",
            "features": features,
        }


#: What pandas reads: the instructions are the index of the table of tasks.
PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": stored, "metadata": None}
        for name, kind, stored in ((TASK, "int64", "int64"), ("task", "unicode", "object"))
    ],
    "pandas_version": "2.0.0",
}


def _check_names(argument: str, given: Mapping[Any, Any]) -> None:
    """Names become keys, columns and folders; widths are positive."""
    for name, width in given.items():
        is_taken = argument == "extra" and name in (STATE, ACTION, "timestamp", *INDICES)
        if not isinstance(name, str) or not NAME.fullmatch(name) or is_taken:
            raise InputError(
                f"{argument}: expected names of letters, digits, '_', '-' and '.' that are free, got {name!r}"
            )
        if argument != "cameras":
            integer(f"{argument}: {name}", width)


def _rows(name: str, values: npt.ArrayLike, dtype: type) -> npt.NDArray[Any]:
    """Values as ``(steps, width)``."""
    found = np.asarray(values)
    if found.ndim != 2 or found.dtype.kind not in ("iu" if dtype is np.int64 else "fiu"):
        raise ShapeError(f"{name}: expected numbers of shape (steps, width), got {found.dtype} {found.shape}")
    return np.ascontiguousarray(found, dtype)


def _path(folder: str, place: int, suffix: str = "parquet") -> str:
    """The file with a number, a thousand in a folder."""
    return f"{folder}/{FILE.format(chunk_index=place // CHUNK, file_index=place % CHUNK)}.{suffix}"


def _file(prefix: str, place: int) -> dict[str, int]:
    return {f"{prefix}/chunk_index": place // CHUNK, f"{prefix}/file_index": place % CHUNK}
