"""Frames of training: shifts at random, and N1.7's patches."""

from __future__ import annotations

import numpy as np
import pytest

from saccade import InputError
from saccade_lab.training.frames import backbone_inputs, shifted
from saccade_lab.training.settings import TrainingSettings

RNG_SEED = 3


def frames(size: int = 8) -> np.ndarray:
    return np.random.default_rng(0).integers(256, size=(5, 2, 3, size, size + 2), dtype=np.uint8)


def test_each_frame_is_shifted_by_its_own_pixels_and_edges_are_repeated() -> None:
    images = frames()
    found = shifted(images, 2, np.random.default_rng(RNG_SEED))
    rows, columns = (np.arange(-2, side + 2).clip(0, side - 1) for side in images.shape[-2:])
    padded = images[..., rows[:, None], columns]
    height, width = images.shape[-2:]
    places = set()
    for row in range(5):
        for camera in range(2):
            here = [
                (down, right)
                for down in range(5)
                for right in range(5)
                if np.array_equal(
                    found[row, camera],
                    padded[row, camera, :, down : down + height, right : right + width],
                )
            ]
            assert len(here) == 1
            places.update(here)
    assert len(places) > 3


def test_no_shift_gives_the_frames() -> None:
    np.testing.assert_array_equal(shifted(frames(), 0, np.random.default_rng(RNG_SEED)), frames())


def test_patches_of_n17_are_the_squares_of_a_view_in_order() -> None:
    views = np.random.default_rng(1).integers(256, size=(1, 2, 3, 64, 32), dtype=np.uint8)
    found = backbone_inputs(views, [np.array([1, 2])], "n1.7")
    assert found.image_grid_thw is not None
    np.testing.assert_array_equal(found.image_grid_thw, [[1, 4, 2], [1, 4, 2]])
    number = 0
    for view in range(2):
        for top in (0, 32):
            for y, x in ((0, 0), (0, 16), (16, 0), (16, 16)):
                patch = views[0, view, :, top + y : top + y + 16, x : x + 16].astype(np.float32)
                expected = np.repeat(((patch - 127.5) / 127.5)[:, None], 2, axis=1)
                np.testing.assert_array_equal(found.pixel_values[number], expected.ravel())
                number += 1
    assert number == len(found.pixel_values)


def test_a_shift_of_frozen_features_is_refused() -> None:
    with pytest.raises(InputError, match="shift: given 4, expected 0 where only the head"):
        TrainingSettings(only="head", absent_share=0.0, shift=4)
    with pytest.raises(InputError, match="shift: given -1, expected at least 0"):
        TrainingSettings(shift=-1)
