"""What a data set holds, as its metadata says: features, episodes and tasks, in any version of the format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

#: Numbers by name, such as ``{"mean": ..., "std": ...}``, for each feature.
Statistics = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Feature:
    """One entry of ``features`` in ``meta/info.json``.

    Attributes:
        key: Its name, such as ``"observation.images.front"``.
        dtype: ``"video"``, ``"image"``, or the type of a column, such as ``"float32"``.
        shape: Its shape, without the axis of the steps.
        is_depth: Whether a camera records distances instead of colours.
    """

    key: str
    dtype: str
    shape: tuple[int, ...]
    is_depth: bool = False

    @property
    def is_camera(self) -> bool:
        """Whether it is recorded as frames."""
        return self.dtype in ("video", "image")


@dataclass(frozen=True)
class VideoPart:
    """The frames of an episode in a video.

    Attributes:
        file: The video, relative to the data set.
        start: Time of the episode's first frame in the video, seconds.
    """

    file: str
    start: float


@dataclass(frozen=True)
class Episode:
    """A recorded episode.

    Attributes:
        index: Its ``episode_index``.
        length: Number of steps.
        tasks: The instructions that are given in it.
        file: The Parquet file of its steps, relative to the data set.
        videos: Where its frames are, by the key of the feature; empty if frames are in the Parquet file.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    file: str
    videos: Mapping[str, VideoPart]

    @property
    def steps(self) -> range:
        """The steps, from 0."""
        return range(self.length)


@dataclass(frozen=True)
class Metadata:
    """The metadata of a data set.

    Attributes:
        root: Its folder.
        version: ``"v2.0"``, ``"v2.1"`` or ``"v3.0"``.
        fps: Steps per second.
        robot: ``robot_type``, or None.
        features: Features by key.
        episodes: Episodes in the order of the metadata.
        tasks: Instructions by ``task_index``.
        statistics: As recorded, by the key of the feature; None if the data set has none.
    """

    root: Path
    version: str
    fps: float
    robot: str | None
    features: Mapping[str, Feature]
    episodes: tuple[Episode, ...]
    tasks: Mapping[int, str]
    statistics: Statistics | None
