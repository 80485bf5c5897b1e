"""Pictures of LIBERO's videos and of its page."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from saccade_lab.libero.episode import Episode
from saccade_lab.libero.video import EVERY, TITLE_HEIGHT, VIEW, EpisodeVideo, thumbnail

LONG = "put the white mug on the left plate and put the yellow and white mug on the right plate"


def frames_of(words: str, steps: int, success: bool) -> list[Any]:
    """What is added at a step: the first camera sees black, the second grey."""
    shown = {"image": np.zeros((360, 360, 3), np.uint8), "wrist_image": np.full((360, 360, 3), 90, np.uint8)}
    added: list[Any] = []
    add = EpisodeVideo(cast(Any, SimpleNamespace(append=added.append)))
    environment = SimpleNamespace(observe=lambda: {"images": shown}, instruction=words)
    add(cast(Any, environment), Episode("libero_10", 4, 0, success, steps))
    return added


@pytest.mark.parametrize(
    ("steps", "success", "count"), [(0, False, 1), (1, False, 0), (EVERY, False, 1), (1, True, 1)]
)
def test_every_second_step_is_shown(steps: int, success: bool, count: int) -> None:
    assert len(frames_of("pick", steps, success)) == count


@pytest.mark.parametrize("words", ["pick", LONG])
def test_cameras_are_side_by_side_under_the_words(words: str) -> None:
    (picture,) = frames_of(words, 0, False)
    assert picture.shape == (VIEW + TITLE_HEIGHT, 2 * VIEW, 3)
    assert not any(side % 16 for side in picture.shape[:2])  # for H.264
    assert (picture[TITLE_HEIGHT:, :VIEW] == 0).all()
    assert (picture[TITLE_HEIGHT:, VIEW:] == 90).all()
    title = picture[:TITLE_HEIGHT]
    written = (title != title[0, 0]).any(axis=(0, 2))
    assert written.any()
    assert not written[-40:].any()  # there is room for "done"
    (done,) = frames_of(words, 0, True)
    assert (done[:TITLE_HEIGHT, -40:] != title[:, -40:]).any()


def test_a_thumbnail_is_the_mean_of_its_pixels() -> None:
    picture = np.zeros((256, 256, 3), np.uint8)
    picture[::2, ::2] = 200
    assert (thumbnail(picture) == 50).all()
    assert thumbnail(picture).shape == (128, 128, 3)
