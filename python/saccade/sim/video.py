"""Videos of episodes: the robot from the side, what the policy saw at its last look, and what it was told."""

from pathlib import Path
from types import TracebackType

import imageio.v2 as imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from saccade.sim.environment import SIMULATION_HZ, VIDEO_SIZE, TaskEnvironment
from saccade.sim.rendering import UInt8Array
from saccade.sim.rollout import Episode

EVERY = 2  # control steps between pictures
SPEED = 0.5  # of simulated time: an episode takes only about a second
FRAMES_PER_SECOND = SIMULATION_HZ * SPEED / EVERY
LINGER_FRAMES = 15  # the last picture stays a while
TITLE_HEIGHT = 40
INSET = VIDEO_SIZE // 3  # the policy's pictures, in a column beside the large one
WIDTH, HEIGHT = VIDEO_SIZE + INSET, VIDEO_SIZE + TITLE_HEIGHT  # multiples of 16, as H.264 likes them
GREEN, INK, PAPER = (63, 185, 80), (240, 240, 240), (24, 26, 30)


class VideoWriter:
    """Writes one episode as MP4, in a `with` block: the file appears when that ends without an error.

    Args:
        path: of the MP4.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.part.mp4")
        self._font = ImageFont.load_default(size=18)
        self._last: UInt8Array | None = None

    def __enter__(self) -> "VideoWriter":
        self._writer = imageio.get_writer(
            self._temporary, fps=FRAMES_PER_SECOND, codec="libx264", quality=7, macro_block_size=16
        )
        return self

    def add(self, environment: TaskEnvironment, episode: Episode) -> None:
        """Shows the simulation as it is now; all but every second step is left out."""
        if episode.steps % EVERY and not episode.success:
            return
        self._last = compose(environment, episode, self._font)
        self._writer.append_data(self._last)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._last is not None and kind is None:
            for _ in range(LINGER_FRAMES):
                self._writer.append_data(self._last)
        self._writer.close()
        if kind is None:
            self._temporary.replace(self._path)
        self._temporary.unlink(missing_ok=True)


def compose(
    environment: TaskEnvironment, episode: Episode, font: ImageFont.FreeTypeFont | ImageFont.ImageFont
) -> UInt8Array:
    """One picture of a video, `(HEIGHT, WIDTH, 3)`."""
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
