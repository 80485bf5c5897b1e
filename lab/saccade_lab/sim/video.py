"""Videos of episodes: the robot from the side, the policy's last camera images, and its instruction."""

import contextlib
import errno
from pathlib import Path
from types import TracebackType

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from saccade._internal.arrays import UInt8Array
from saccade_lab.sim.environment import SIMULATION_HZ, VIDEO_SIZE, TaskEnvironment
from saccade_lab.sim.rollout import Episode

EVERY = 2  # control steps between pictures
SPEED = 0.5  # relative to simulated time, in which an episode takes only about a second
FRAMES_PER_SECOND = SIMULATION_HZ * SPEED / EVERY
LINGER_FRAMES = 15  # repeats of the last picture
TITLE_HEIGHT = 40
INSET = VIDEO_SIZE // 3  # the policy's images, in a column to the right of the large picture
WIDTH, HEIGHT = VIDEO_SIZE + INSET, VIDEO_SIZE + TITLE_HEIGHT  # multiples of 16, which suit H.264
INDEX = b"moov"  # the index of an MP4, which ffmpeg writes last
GREEN, INK, PAPER = (63, 185, 80), (240, 240, 240), (24, 26, 30)


class VideoWriter:
    """Writes one episode as MP4, in a ``with`` block; the file appears when that ends without an error.

    Args:
        path: Path of the MP4.
        frames_per_second: Pictures in a second of the video.

    Raises:
        OSError: The video cannot be written; names ``path``.
    """

    def __init__(self, path: Path, frames_per_second: float = FRAMES_PER_SECOND) -> None:
        self._path = path
        self._frames_per_second = frames_per_second
        self._temporary = path.with_name(f".{path.name}.part.mp4")
        self._font = ImageFont.load_default(size=18)
        self._last: UInt8Array | None = None

    def __enter__(self) -> "VideoWriter":
        self._writer = imageio.get_writer(
            self._temporary,
            fps=self._frames_per_second,
            codec="libx264",
            quality=7,
            macro_block_size=16,
            ffmpeg_log_level="quiet",
        )
        return self

    def add(self, environment: TaskEnvironment, episode: Episode) -> None:
        """Adds a picture of the simulation at every second step."""
        if episode.steps % EVERY and not episode.success:
            return
        self.append(compose(environment, episode, self._font))

    def append(self, picture: UInt8Array) -> None:
        """Adds a picture, whose sides are multiples of 16; all of a video have one size."""
        self._last = picture
        self._append(picture)

    def _append(self, picture: UInt8Array) -> None:
        try:
            self._writer.append_data(picture)
        except OSError as error:  # ffmpeg has ended
            raise self._failure() from error

    def _failure(self) -> OSError:
        return OSError(errno.EIO, "the video cannot be written; is the disk full?", str(self._path))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is not None:
                with contextlib.suppress(OSError):
                    self._writer.close()
                return
            if self._last is not None:
                for _ in range(LINGER_FRAMES):
                    self._append(self._last)
            self._writer.close()
            # imageio does not say whether ffmpeg failed.
            if self._last is not None and INDEX not in self._temporary.read_bytes():
                raise self._failure()
            self._temporary.replace(self._path)
        finally:
            with contextlib.suppress(OSError):
                self._temporary.unlink(missing_ok=True)


def compose(
    environment: TaskEnvironment, episode: Episode, font: ImageFont.FreeTypeFont | ImageFont.ImageFont
) -> UInt8Array:
    """One picture of a video, ``(HEIGHT, WIDTH, 3)``."""
    canvas = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    view = environment.render()
    if view is None:
        raise ValueError("environment: expected render_mode='rgb_array'")
    canvas.paste(Image.fromarray(view), (0, TITLE_HEIGHT))
    images = list(environment.last_observation["images"].values())[: VIDEO_SIZE // INSET]
    for row, picture in enumerate(images):
        inset = Image.fromarray(picture).resize((INSET, INSET), Image.Resampling.NEAREST)
        canvas.paste(inset, (VIDEO_SIZE, TITLE_HEIGHT + row * INSET))
    draw = ImageDraw.Draw(canvas)
    draw.text((10, 9), f"“{episode.instruction}”", fill=INK, font=font)
    if episode.success:
        draw.text((WIDTH - 10, 9), "done", fill=GREEN, font=font, anchor="ra")
    return np.asarray(canvas)
