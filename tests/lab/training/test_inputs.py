"""What a backbone is given in training: views shifted at random, and N1.7's patches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from saccade import InputError, ShapeError
from saccade_lab.reference.backbone import PreparedInputs
from saccade_lab.training.batches import Batches
from saccade_lab.training.graphs import tensors_of
from saccade_lab.training.inputs import patches, prepared_inputs, shifted
from saccade_lab.training.settings import TrainingSettings
from tests.helpers.training_cases import TINY, make_batches, recorded

NO_TARGETS = (np.zeros(6, np.float32), np.ones(6, np.float32))


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


def test_each_view_of_a_batch_is_shifted_by_what_its_key_draws() -> None:
    run, still = make_batches(recorded(), TINY, with_later=False)
    samples, config = still._samples, run.config
    args = (samples, config, run.learner.backbone, still._prompts, NO_TARGETS, 4)
    plain, moved = (Batches(*args, shift=shift).draw(5) for shift in (0, 2))
    assert isinstance(plain.inputs, PreparedInputs)
    assert isinstance(moved.inputs, PreparedInputs)
    (before,), (after,) = plain.inputs.pixels, moved.inputs.pixels
    found = []
    for one, other in zip(before, after, strict=True):
        places = [(down, right) for down in range(-2, 3) for right in range(-2, 3)]
        same = [torch.equal(shifted(one[None], torch.tensor([place]), 2)[0], other) for place in places]
        assert any(same)
        found.append(same.index(True))
    assert len(set(found)) > 1
    again = Batches(*args, shift=2).draw(5)
    assert all(map(torch.equal, tensors_of(again), tensors_of(moved)))


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


def test_frames_of_another_size_are_refused() -> None:
    run, _ = make_batches(recorded(), TINY, with_later=False)
    with pytest.raises(ShapeError, match="pixel_values: expected 16 patches, got 4"):
        prepared_inputs(run.learner.backbone, views(8, 8)[None, :2], [np.array([1])])
    with pytest.raises(ShapeError, match=r"multiples of 8, got \(2, 3, 8, 10\)"):
        prepared_inputs(run.learner.backbone, views()[None, :2], [np.array([1])])


def test_a_shift_of_frozen_features_is_refused() -> None:
    with pytest.raises(InputError, match="shift: given 4, expected 0 where only the head"):
        TrainingSettings(only="head", absent_share=0.0, shift=4)
    with pytest.raises(InputError, match="shift: given -1, expected at least 0"):
        TrainingSettings(shift=-1)
