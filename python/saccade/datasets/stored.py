"""What is recorded of an episode, by the key of the feature: columns of numbers and frames, checked."""

from __future__ import annotations

import functools
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import UInt8Array
from saccade._internal.extras import SACCADE
from saccade.datasets.features import Episode, Metadata
from saccade.datasets.parquet import Steps, read_steps
from saccade.datasets.videos import TOLERANCE, Frame, Videos
from saccade.errors import DatasetError

#: Episodes whose steps are kept in memory, and columns of pictures of an episode.
MOST_EPISODES = 4


class Stored:
    """The files of a data set. Any number of threads may use it, and it can be pickled.

    All methods raise DatasetError, with file, episode and step, for what is damaged. ``episode`` is a place
    in the metadata; it and ``step`` must be there.

    Args:
        metadata: The metadata.
    """

    def __init__(self, metadata: Metadata) -> None:
        self.metadata = metadata
        self._videos = Videos()
        self.steps = functools.lru_cache(MOST_EPISODES)(self._read_steps)
        self._pictures = functools.lru_cache(MOST_EPISODES)(self._read_pictures)

    def __getstate__(self) -> dict[str, Any]:
        return {"metadata": self.metadata}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def frame(self, episode: int, step: int, key: str) -> Frame:
        """The frame of a camera at a step, with its time in the episode."""
        about, feature = self.metadata.episodes[episode], self.metadata.features[key]
        where = f"{self.metadata.root}: episode {about.index}, step {step}, {key}"
        time = self.time(episode, step)
        if feature.dtype == "image":
            found = Frame(self._image(episode, step, key, where), time)
        else:
            part = about.videos[key]
            found = self._videos.frame(where, self.metadata.root / part.file, part.start + time, part.start)
        _check_shape(where, found.pixels, feature.shape)
        return found

    def column(self, episode: int, name: str) -> npt.NDArray[Any]:
        """A column of an episode, ``(steps, width)``."""
        steps = self.steps(episode)
        values = steps.numbers(name)
        expected = self.metadata.features[name].shape
        if (values.shape[1],) != expected:
            raise DatasetError(
                f"{steps.where}: {name}: expected {expected[0]} numbers a step, as info.json says, got "
                f"{values.shape[1]}"
            )
        return values

    def time(self, episode: int, step: int) -> float:
        """The time of a step in its episode, seconds: ``timestamp``, or what follows from the frame rate."""
        steps = self.steps(episode)
        return (
            float(steps.numbers("timestamp")[step, 0])
            if "timestamp" in steps.names
            else step / self.metadata.fps
        )

    def _read_steps(self, episode: int) -> Steps:
        """The steps of an episode without its pictures."""
        about = self.metadata.episodes[episode]
        pictures = {key for key, feature in self.metadata.features.items() if feature.dtype == "image"}
        found = read_steps(self.metadata.root / about.file, about.index, lambda name: name not in pictures)
        _check_steps(found, about, self.metadata.fps)
        return found

    def _read_pictures(self, episode: int, key: str) -> list[Any]:
        """The pictures of an episode, as they are stored."""
        about = self.metadata.episodes[episode]
        steps = read_steps(self.metadata.root / about.file, about.index, lambda name: name == key)
        if len(steps) != about.length:
            raise DatasetError(f"{steps.where}: {key}: expected {about.length} pictures, got {len(steps)}")
        return steps.values(key)

    def _image(self, episode: int, step: int, key: str, where: str) -> UInt8Array:
        """A frame that is stored as a picture in the Parquet file."""
        stored = self._pictures(episode, key)[step]
        content = stored.get("bytes") if isinstance(stored, Mapping) else None
        if not isinstance(content, bytes):
            raise DatasetError(f"{where}: expected the bytes of a picture, got {stored!r:.60}")
        SACCADE.require("PIL")
        from PIL import Image

        try:
            with Image.open(io.BytesIO(content)) as picture:
                if picture.mode != "RGB":  # a conversion would drop transparency, or bits of a depth map
                    raise DatasetError(f"{where}: expected a picture in RGB, got {picture.mode}")
                return np.array(picture)
        except DatasetError:
            raise
        # Pillow raises SyntaxError and others for files that are damaged in their own ways.
        except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
            raise DatasetError(f"{where}: cannot be read as a picture: {error}") from None


def _check_steps(steps: Steps, about: Episode, fps: float) -> None:
    """The table has the steps that the metadata say, in order, at the frame rate."""
    if len(steps) != about.length:
        raise DatasetError(
            f"{steps.where}: expected {about.length} steps, as the metadata say, got {len(steps)}"
        )
    if "frame_index" in steps.names:
        wrong = np.flatnonzero(steps.numbers("frame_index")[:, 0] != np.arange(len(steps)))
        if len(wrong):
            raise DatasetError(
                f"{steps.where}, step {wrong[0]}: frame_index: expected the steps in order from 0"
            )
    if "timestamp" in steps.names:
        times = steps.numbers("timestamp")[:, 0].astype(np.float64)
        # float32 cannot hold later times more exactly.
        with np.errstate(all="ignore"):  # what is too large or not finite differs from the step before
            allowed = TOLERANCE + np.spacing(times[1:].astype(np.float32)).astype(np.float64)
            wrong = np.flatnonzero(~(np.abs(np.diff(times) - 1 / fps) <= allowed))
        if len(wrong) or not np.isfinite(times).all():
            step = int(wrong[0]) + 1 if len(wrong) else 0
            raise DatasetError(
                f"{steps.where}, step {step}: timestamp: expected {1 / fps:.6f} s after the step before "
                f"(within {TOLERANCE} s), got {times[step]:.6f} s after {times[max(step - 1, 0)]:.6f} s"
            )
        # Otherwise time and number of a step would name different frames, in v3.0 those of other episodes.
        if about.videos and abs(times[0]) > 0.5 / fps:
            raise DatasetError(
                f"{steps.where}, step 0: timestamp: expected 0 s, the time of the first frame, got "
                f"{times[0]:.6f} s"
            )


def _check_shape(where: str, pixels: UInt8Array, shape: tuple[int, ...]) -> None:
    """A frame has the shape that ``info.json`` says, where colours may come first or last."""
    height, width, _ = pixels.shape
    if len(shape) != 3 or shape not in ((height, width, 3), (3, height, width)):
        raise DatasetError(
            f"{where}: expected a frame of shape {shape}, as info.json says, got {pixels.shape}"
        )
