"""Reads the metadata of a data set: ``meta/info.json``, and the files of its version."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from saccade._internal.small_files import read_json, read_small
from saccade.datasets import parquet
from saccade.datasets.features import Episode, Feature, Metadata, Statistics, VideoPart
from saccade.datasets.statistics import aggregate
from saccade.errors import DatasetError

#: A place in a template of paths: ``{episode_index:06d}``, ``{video_key}``.
PLACE = re.compile(r"\{([a-z_]+)(?::0([0-9]{1,2})d)?\}")


def read_metadata(root: Path) -> Metadata:
    """The metadata of the data set in a folder.

    Raises:
        FileNotFoundError: The folder, or a file that every data set has, does not exist.
        DatasetError: The metadata are damaged, contradict each other, or are of an unknown version.
    """
    if not root.is_dir():
        kind = NotADirectoryError if root.exists() else FileNotFoundError
        raise kind(f"{root}: no such directory; expected the folder of a LeRobotDataset, with meta/info.json")
    info = read_json(root / "meta" / "info.json", DatasetError)
    return Info(root, info).metadata()


class Info:
    """``meta/info.json``, checked, and what follows from it."""

    def __init__(self, root: Path, values: Mapping[str, Any]) -> None:
        self.root = root
        self.where = root / "meta" / "info.json"
        self.values = values
        self.version = str(values.get("codebase_version"))
        if self.version not in VERSIONS:
            raise DatasetError(
                f"{self.where}: codebase_version: expected {', '.join(VERSIONS)}, got {self.version}; "
                "lerobot converts older data sets"
            )
        self.features = self._features()

    def metadata(self) -> Metadata:
        """The metadata: what all versions have, and what the reader of this version adds."""
        fps: Any = self.values.get("fps")
        if type(fps) not in (int, float) or not (math.isfinite(fps) and fps > 0):
            raise DatasetError(f"{self.where}: fps: expected a positive number, got {fps!r:.60}")
        tasks, episodes, statistics = VERSIONS[self.version](self)
        self._check(tasks, episodes)
        return Metadata(
            root=self.root,
            version=self.version,
            fps=float(fps),
            robot=self.values.get("robot_type"),
            features=self.features,
            episodes=episodes,
            tasks=tasks,
            statistics=statistics,
        )

    @property
    def videos(self) -> tuple[str, ...]:
        """Keys of the features that are videos."""
        return tuple(key for key, feature in self.features.items() if feature.dtype == "video")

    def path(self, name: str, **places: Any) -> str:
        """A path from the template of ``info.json`` that is called ``name``."""
        template = self.values.get(name)
        if not isinstance(template, str):
            raise DatasetError(f"{self.where}: {name}: expected a template of paths, got {template!r:.60}")

        def filled(found: re.Match[str]) -> str:
            place, width = found[1], found[2]
            if place not in places:
                raise DatasetError(f"{self.where}: {name}: {place}: expected one of {', '.join(places)}")
            return str(places[place]).zfill(int(width or 0))

        path = PLACE.sub(filled, template)
        parts = PurePosixPath(path)
        if parts.is_absolute() or ".." in parts.parts or "{" in path or "\0" in path:
            raise DatasetError(
                f"{self.where}: {name}: expected a path in the data set, got {template!r:.100}"
            )
        return path

    def count(self, name: str, least: int = 0) -> int:
        """A number of ``info.json``."""
        value = self.values.get(name)
        if type(value) is not int or value < least:
            raise DatasetError(
                f"{self.where}: {name}: expected an integer, at least {least}, got {value!r:.60}"
            )
        return value

    def _features(self) -> dict[str, Feature]:
        given = self.values.get("features")
        if not isinstance(given, Mapping) or not given:
            raise DatasetError(f"{self.where}: features: expected an object, got {type(given).__name__}")
        found = {}
        for key, about in given.items():
            shape = about.get("shape") if isinstance(about, Mapping) else None
            if not isinstance(shape, list) or not all(type(size) is int and size > 0 for size in shape):
                raise DatasetError(
                    f"{self.where}: features: {key}: expected dtype and shape, got {about!r:.100}"
                )
            notes: dict[str, Any] = {}
            for name in ("info", "video_info"):
                if isinstance(about.get(name), Mapping):
                    notes.update(about[name])
            is_depth = bool(notes.get("video.is_depth_map") or notes.get("is_depth_map"))
            found[key] = Feature(key, str(about.get("dtype")), tuple(shape), is_depth)
        return found

    def _check(self, tasks: Mapping[int, str], episodes: tuple[Episode, ...]) -> None:
        """Tasks and episodes are as many as ``info.json`` counts, each once, and the files exist."""
        total = self.values.get("total_episodes")
        if total is not None and total != len(episodes):
            raise DatasetError(
                f"{self.root / 'meta'}: info.json counts {total} episodes, got {len(episodes)}: one is "
                "missing, or one too many is listed"
            )
        frames = self.values.get("total_frames")
        steps = sum(episode.length for episode in episodes)
        if frames is not None and frames != steps:
            raise DatasetError(
                f"{self.where}: total_frames: expected {steps}, those of its episodes, got {frames!r:.60}"
            )
        counted = self.values.get("total_tasks")
        if counted is not None and counted != len(tasks):
            raise DatasetError(
                f"{self.where}: total_tasks: expected {len(tasks)}, those of its list of tasks, got "
                f"{counted!r:.60}"
            )
        seen: set[int] = set()
        there: set[str] = set()
        for episode in episodes:
            if episode.index in seen:
                raise DatasetError(f"{self.root / 'meta'}: episode {episode.index} is listed twice")
            seen.add(episode.index)
            for file in (episode.file, *(part.file for part in episode.videos.values())):
                if file not in there and not (self.root / file).is_file():
                    raise DatasetError(f"{self.root / file}: no such file; episode {episode.index} is in it")
                there.add(file)


def _json_lines(path: Path) -> list[dict[str, Any]]:
    """The objects of a JSON Lines file."""
    found = []
    try:
        for number, line in enumerate(read_small(path).decode().splitlines(), start=1):
            if line.strip():
                value = json.loads(line)
                if not isinstance(value, dict):
                    raise DatasetError(f"{path}: line {number}: expected an object, got {line!r:.60}")
                found.append(value)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path}: cannot be read as JSON lines: {error}") from None
    return found


def _integer(where: str, value: Any, least: int = 0) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise DatasetError(f"{where}: expected an integer, at least {least}, got {value!r:.60}")
    return int(value)


def _texts(where: str, value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
        raise DatasetError(f"{where}: expected a list of instructions, got {value!r:.60}")
    return tuple(value)


Parts = tuple[Mapping[int, str], tuple[Episode, ...], Statistics | None]


def _version_2(info: Info) -> Parts:
    """v2.0 and v2.1: one Parquet file and one video of each camera for an episode, and JSON lines."""
    meta = info.root / "meta"
    tasks: dict[int, str] = {}
    for row in _json_lines(meta / "tasks.jsonl"):
        place = _integer(f"{meta / 'tasks.jsonl'}: task_index", row.get("task_index"))
        if place in tasks or not isinstance(row.get("task"), str):
            raise DatasetError(
                f"{meta / 'tasks.jsonl'}: expected each task_index once, with a text, got {row}"
            )
        tasks[place] = row["task"]
    size, episodes = info.count("chunks_size", 1), []
    for row in _json_lines(meta / "episodes.jsonl"):
        where = f"{meta / 'episodes.jsonl'}: episode"
        index = _integer(f"{where}_index", row.get("episode_index"))
        places = {"episode_chunk": index // size, "episode_index": index}
        videos = {
            key: VideoPart(info.path("video_path", video_key=key, **places), 0.0) for key in info.videos
        }
        length = _integer(f"{where} {index}: length", row.get("length"), 1)
        tasked = _texts(f"{where} {index}: tasks", row.get("tasks"))
        episodes.append(Episode(index, length, tasked, info.path("data_path", **places), videos))
    return tasks, tuple(episodes), _recorded(meta) or _by_episode(meta, episodes)


def _by_episode(meta: Path, episodes: Sequence[Episode]) -> Statistics | None:
    """v2.1: the statistics of episodes, as lerobot combines them."""
    path = meta / "episodes_stats.jsonl"
    if not os.path.lexists(path):  # a link to nothing is damaged, not absent
        return None
    rows: dict[int, Any] = {}
    for row in _json_lines(path):
        index = _integer(f"{path}: episode_index", row.get("episode_index"))
        if index in rows:
            raise DatasetError(f"{path}: episode {index} is listed twice")
        rows[index] = row.get("stats")
    listed = {episode.index for episode in episodes}
    unknown = sorted(set(rows) - listed)
    if unknown:
        raise DatasetError(f"{path}: episode {unknown[0]} has statistics and is not in episodes.jsonl")
    absent = [str(index) for index in sorted(listed - set(rows))]
    if absent:
        raise DatasetError(
            f"{path}: expected the statistics of every episode, got none of {', '.join(absent[:5])}"
        )
    try:
        with np.errstate(all="ignore"):  # numbers that are not finite are refused when they are asked for
            return aggregate([_arrays(rows[episode.index]) for episode in episodes])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: statistics of an unknown form ({error!r})") from None


def _recorded(meta: Path) -> Statistics | None:
    """``meta/stats.json``."""
    path = meta / "stats.json"
    if not os.path.lexists(path):
        return None
    values = read_json(path, DatasetError)
    try:
        return _arrays(values)
    except (AttributeError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: statistics of an unknown form ({error!r})") from None


def _arrays(values: Any) -> dict[str, dict[str, Any]]:
    return {
        key: {name: np.atleast_1d(np.asarray(value, np.float64)) for name, value in numbers.items()}
        for key, numbers in values.items()
    }


def _version_3(info: Info) -> Parts:
    """v3.0: episodes share Parquet files and videos; what is where stands in ``meta/episodes``."""
    meta = info.root / "meta"
    tasks: dict[int, str] = {}
    for text, given in parquet.read_tasks(meta / "tasks.parquet"):
        place = _integer(f"{meta / 'tasks.parquet'}: task_index", given)
        if place in tasks:
            raise DatasetError(
                f"{meta / 'tasks.parquet'}: expected each task_index once, got {place} for {tasks[place]!r} "
                f"and {text!r}"
            )
        tasks[place] = text
    episodes = []
    files = sorted((meta / "episodes").glob("*/*.parquet"))
    if not files:
        raise FileNotFoundError(f"{meta / 'episodes'}: no such folder, or no Parquet file in it")
    for file in files:
        for row in parquet.read_rows(file, lambda name: not name.startswith("stats/")):
            episodes.append(_episode_3(info, str(file), row))
    return tasks, tuple(episodes), _recorded(meta)


def _episode_3(info: Info, where: str, row: Mapping[str, Any]) -> Episode:
    index = _integer(f"{where}: episode_index", row.get("episode_index"))
    where = f"{where}: episode {index}"

    def places(prefix: str) -> dict[str, int]:
        names = ("chunk_index", "file_index")
        return {name: _integer(f"{where}: {prefix}/{name}", row.get(f"{prefix}/{name}")) for name in names}

    videos = {}
    for key in info.videos:
        start = row.get(f"videos/{key}/from_timestamp")
        if not isinstance(start, float | int) or not (math.isfinite(start) and start >= 0):
            raise DatasetError(f"{where}: videos/{key}/from_timestamp: expected seconds, got {start!r:.60}")
        path = info.path("video_path", video_key=key, **places(f"videos/{key}"))
        videos[key] = VideoPart(path, float(start))
    length = _integer(f"{where}: length", row.get("length"), 1)
    names = ("dataset_from_index", "dataset_to_index")
    start, stop = (_integer(f"{where}: {name}", row.get(name)) for name in names)
    if stop - start != length:
        raise DatasetError(f"{where}: expected {length} steps, its length, got indices {start} to {stop}")
    tasks = _texts(f"{where}: tasks", row.get("tasks"))
    return Episode(index, length, tasks, info.path("data_path", **places("data")), videos)


#: Readers of tasks, episodes and statistics by version.
VERSIONS: dict[str, Callable[[Info], Parts]] = {"v2.0": _version_2, "v2.1": _version_2, "v3.0": _version_3}
