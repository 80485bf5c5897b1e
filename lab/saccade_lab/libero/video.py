"""Videos of LIBERO's episodes: both cameras as the policy sees them, and its instruction."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from saccade._internal.arrays import UInt8Array
from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.episode import Episode
from saccade_lab.libero.layout import CONTROL_HZ
from saccade_lab.sim.video import GREEN, INK, PAPER, VideoWriter

EVERY = 2  # control steps between pictures
FRAMES_PER_SECOND = CONTROL_HZ / EVERY
VIEW = 256  # pixels along each side of a camera's picture
TITLE_HEIGHT = 32
THUMBNAIL = 128  # of the page


class EpisodeVideo:
    """Adds pictures of an episode to a video; see ``on_step`` of ``run_episode``.

    Args:
        writer: The video, of ``FRAMES_PER_SECOND``.
    """

    def __init__(self, writer: VideoWriter) -> None:
        self._writer = writer
        self._fonts = [ImageFont.load_default(size=size) for size in range(14, 6, -1)]

    def __call__(self, environment: LiberoEnvironment, episode: Episode) -> None:
        """Adds a picture at every second step, and at the last one of a success."""
        if episode.steps % EVERY and not episode.success:
            return
        canvas = Image.new("RGB", (2 * VIEW, VIEW + TITLE_HEIGHT), PAPER)
        for place, picture in enumerate(environment.observe()["images"].values()):
            view = Image.fromarray(picture).resize((VIEW, VIEW), Image.Resampling.BOX)
            canvas.paste(view, (place * VIEW, TITLE_HEIGHT))
        draw = ImageDraw.Draw(canvas)
        words, room = environment.instruction, 2 * VIEW - 60
        font = next((one for one in self._fonts if one.getlength(words) <= room), self._fonts[-1])
        draw.text((8, 7), words, fill=INK, font=font)
        if episode.success:
            draw.text((2 * VIEW - 8, 7), "done", fill=GREEN, font=self._fonts[0], anchor="ra")
        self._writer.append(np.asarray(canvas))


def thumbnail(picture: UInt8Array) -> UInt8Array:
    """A camera's picture ``(H, W, 3)`` as the page shows it, ``(THUMBNAIL, THUMBNAIL, 3)``."""
    return np.asarray(Image.fromarray(picture).resize((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX))
