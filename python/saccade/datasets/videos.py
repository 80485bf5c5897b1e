"""Frames of videos by their time, without decoding a whole video. Decoding is PyAV's, as in lerobot."""

from __future__ import annotations

import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from saccade._internal.arrays import UInt8Array
from saccade._internal.extras import SACCADE
from saccade.errors import DatasetError

if TYPE_CHECKING:
    import av

#: lerobot's: seconds by which the time of a frame may differ from the time of the step.
TOLERANCE = 1e-4
#: Videos that stay open. Each keeps a decoder, some megabytes.
MOST_OPEN = 8
#: Up to so many frames are decoded to reach a later one. For more, decoding starts at a keyframe.
MOST_AHEAD = 16
#: How many frames before the wanted one a keyframe is looked for, one after the other; at last the first.
BACK = (0.0, 32.0, 256.0, float("inf"))


@dataclass(frozen=True)
class Frame:
    """A frame of a camera.

    Attributes:
        pixels: ``(height, width, 3)`` uint8, red, green and blue.
        timestamp: Its time in the episode, seconds, as the video has it.
    """

    pixels: UInt8Array
    timestamp: float


class Videos:
    """Open videos. Any number of threads may call it; they decode one after the other."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._open: OrderedDict[Path, _Video] = OrderedDict()
        ALL.add(self)

    def frame(self, where: str, path: Path, time: float, start: float) -> Frame:
        """The frame at a time.

        Args:
            where: What messages begin with.
            path: The video.
            time: Seconds since the start of the video.
            start: Time of the episode's first frame in the video.

        Raises:
            DatasetError: There is no frame at this time, or the video is damaged.
        """
        with self.lock:
            try:
                video = self._open.pop(path, None) or _Video(path)
                self._open[path] = video
                found = video.frame(time)
            except _errors() as error:
                self._forget(path)
                raise DatasetError(f"{where}: {path} cannot be decoded: {error}") from None
            while len(self._open) > MOST_OPEN:
                self._forget(next(iter(self._open)))
        if isinstance(found, float):
            raise DatasetError(
                f"{where}: {path}: expected a frame at {time:.6f} s (within {TOLERANCE} s), got "
                + ("none" if np.isinf(found) else f"the nearest at {found:.6f} s")
            )
        # The video keeps its array for the next call, and the caller may write into this one.
        return Frame(found[1].copy(), found[0] - start)

    def close(self) -> None:
        """Closes all videos. The caller has the lock."""
        for path in list(self._open):
            self._forget(path)

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__()  # type: ignore[misc]

    def _forget(self, path: Path) -> None:
        video = self._open.pop(path, None)
        if video is not None:
            video.container.close()


#: What is open in this process, and what is locked while it forks.
ALL: weakref.WeakSet[Videos] = weakref.WeakSet()
LOCKED: list[Videos] = []


def _before_fork() -> None:
    """Closes all videos: decoders have threads, which the child lacks and would wait for."""
    for videos in list(ALL):
        videos.lock.acquire()
        LOCKED.append(videos)
        videos.close()


def _after_fork() -> None:
    while LOCKED:
        LOCKED.pop().lock.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)


class _Video:
    """An open video, and where its decoder is."""

    def __init__(self, path: Path) -> None:
        SACCADE.require("av")
        import av

        self.container = av.open(str(path))
        streams: Any = self.container.streams.video
        if not streams:
            self.container.close()
            raise ValueError("it has no video stream")
        self.stream = streams[0]
        self.stream.thread_type = "AUTO"
        rate = self.stream.average_rate
        self.interval = float(1 / rate) if rate else 1.0
        self.frames: Iterator[av.VideoFrame] = iter(())
        self.last: tuple[float, UInt8Array] | None = None
        self.is_damaged = False  # whether a frame since the last keyframe was: those after it are made of it

    def frame(self, time: float) -> tuple[float, UInt8Array] | float:
        """Time and pixels of the frame at a time; or the time of the nearest frame, if none is there."""
        if self.last is not None and _is_at(self.last[0], time):
            return self.last
        if self.last is not None and self.last[0] < time < self.last[0] + MOST_AHEAD * self.interval:
            return self._ahead(time)[0]
        found: tuple[float, UInt8Array] | float = float("inf")
        for back in BACK:
            start = max(time - back * self.interval, 0)
            self._seek(start)
            found, is_reached = self._ahead(time)
            # Frames that stand before a keyframe may be stored after it; decoding then begins too late.
            if is_reached or not start:
                break
        return found

    def _seek(self, time: float) -> None:
        """Goes to the last keyframe before a time."""
        place = max(round(time / self.stream.time_base) - 1, 0)
        self.container.seek(place, stream=self.stream, backward=True, any_frame=False)
        self.frames = self.container.decode(self.stream)
        self.is_damaged = False

    def _ahead(self, time: float) -> tuple[tuple[float, UInt8Array] | float, bool]:
        """What ``frame`` returns, from where the decoder is; and whether that is not after the time."""
        self.last, nearest, is_reached = None, float("inf"), False
        for frame in self.frames:
            if frame.pts is None:
                continue
            self.is_damaged = frame.is_corrupt or (self.is_damaged and not frame.key_frame)
            now = float(frame.time)
            if abs(now - time) < abs(nearest - time):
                nearest = now
            if _is_at(now, time):
                if self.is_damaged:
                    raise ValueError("the frame, or one that it is made of, is damaged")
                self.last = now, cast("UInt8Array", frame.to_ndarray(format="rgb24"))
                return self.last, True
            if now > time:
                break
            is_reached = True
        return nearest, is_reached


def _is_at(frame: float, time: float) -> bool:
    """Whether a frame is the one at a time. As in lerobot, both are rounded to float32 first."""
    return bool(abs(np.float32(frame) - np.float32(time)) <= TOLERANCE)


def _errors() -> tuple[type[BaseException], ...]:
    import av

    return av.FFmpegError, OSError, ValueError, EOFError
