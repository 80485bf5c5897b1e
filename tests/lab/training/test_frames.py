"""Frames of training: shifts at random, and N1.7's patches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from saccade import InputError
from saccade_lab.training.inputs import patches, shifted
from saccade_lab.training.settings import TrainingSettings


def views(height: int = 8, width: int = 10) -> torch.Tensor:
    return torch.from_numpy(
        np.random.default_rng(0).integers(256, size=(10, 3, height, width), dtype=np.uint8)
    )


def test_each_view_is_shifted_by_its_own_pixels_and_edges_are_repeated() -> None:
    given, largest = views(), 2
    moves = np.random.default_rng(3).integers(-largest, largest, endpoint=True, size=(10, 2))
    assert len(np.unique(moves, axis=0)) > 3
    found = shifted(given, torch.from_numpy(moves), largest)
    assert found.dtype == torch.uint8
    for view, shown, (down, right) in zip(given.numpy(), found.numpy(), moves, strict=True):
        rows, columns = (
            np.clip(np.arange(side) + move, 0, side - 1)
            for side, move in zip(view.shape[1:], (down, right), strict=True)
        )
        np.testing.assert_array_equal(shown, view[:, rows[:, None], columns])


def test_no_shift_gives_the_views() -> None:
    assert torch.equal(shifted(views(), torch.zeros((10, 2), dtype=torch.long), 0), views())


def test_patches_of_n17_are_the_squares_of_a_view_in_order() -> None:
    given = views(64, 32)[:2]
    found = patches(given)
    number = 0
    for view in given.numpy():
        for top in (0, 32):
            for y, x in ((0, 0), (0, 16), (16, 0), (16, 16)):
                patch = view[:, top + y : top + y + 16, x : x + 16]
                np.testing.assert_array_equal(found[number], np.repeat(patch[:, None], 2, axis=1).ravel())
                number += 1
    assert number == len(found)


def test_a_shift_of_frozen_features_is_refused() -> None:
    with pytest.raises(InputError, match="shift: given 4, expected 0 where only the head"):
        TrainingSettings(only="head", absent_share=0.0, shift=4)
    with pytest.raises(InputError, match="shift: given -1, expected at least 0"):
        TrainingSettings(shift=-1)
