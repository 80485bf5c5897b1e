"""Occlusion: what taking away a patch changes, against the reference and by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade import Intervention
from saccade.errors import InputError
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.maps import occlusion
from saccade_lab.maps.layout import parse_layout
from saccade_lab.maps.occlusion import BlankedFrames, DroppedPositions, cell_for, measure, places_of
from saccade_lab.maps.view import View
from saccade_lab.reference import ActionHead as ReferenceHead
from saccade_lab.sim.policy import Policy
from tests.helpers.maps_cases import demo_head, demo_policy, pushed_view
from tests.helpers.released import load_released

torch.set_num_threads(1)


@pytest.fixture
def policy() -> Policy:
    return demo_policy()


@pytest.fixture
def head() -> saccade.ActionHead:
    return demo_head()


@pytest.fixture
def pushed() -> View:
    return pushed_view()


@pytest.fixture(scope="module")
def tiny() -> saccade.ActionHead:
    released = load_released("n15_tiny")
    return saccade.ActionHead.from_pretrained(released.path, config=released.config, num_threads=1)


TINY_LAYOUT = parse_layout("text:2,image:2x3=left,image:1x2=top,text:1", 11)


def tiny_occluder() -> DroppedPositions:
    given = load_released("n15_tiny")
    return DroppedPositions(
        HeadInputs(given.backbone_features[:1], given.state[:1], given.embodiment_id[:1], given.noise[:1])
    )


class Blind:
    """A head whose rows do not read the vision-language tokens at all."""

    def __init__(self, head: saccade.ActionHead) -> None:
        self.head = head
        self.cut = Intervention(cut=[(group, "vl") for group in ("state", "future", "action")])

    def encode(self, *args: Any, **options: Any) -> Any:
        return self.head.encode(*args, **options)

    def sample(self, *args: Any, **options: Any) -> Any:
        return self.head.sample(*args, **{**options, "intervention": self.cut})


def no_noise(count: int) -> Any:
    return np.zeros((count, 6, 5), np.float32)


def test_every_patch_is_taken_away_once() -> None:
    places = places_of(TINY_LAYOUT, 2)
    shown = [(p.camera.name, p.rows.start, p.rows.stop, p.columns.start, p.columns.stop) for p in places]
    assert shown == [("left", 0, 2, 0, 2), ("left", 0, 2, 2, 3), ("top", 0, 1, 0, 2)]
    assert len(places_of(TINY_LAYOUT, 1)) == 8
    assert cell_for(TINY_LAYOUT, None) == 1
    assert cell_for(parse_layout("image:16x16,image:4x4", 272), None) == 2
    assert cell_for(TINY_LAYOUT, 3) == 3
    with pytest.raises(InputError, match="cell: given 0"):
        cell_for(TINY_LAYOUT, 0)


def test_a_patch_that_nothing_reads_changes_nothing(tiny: saccade.ActionHead) -> None:
    blind: Any = Blind(tiny)
    found = measure(blind, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1)
    assert {name: change.tolist() for name, change in found.change.items()} == {
        "left": [[0.0] * 3] * 2,
        "top": [[0.0] * 2],
    }
    seeing = measure(tiny, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1)
    assert min(change.min() for change in seeing.change.values()) > 0


def test_occlusion_equals_the_reference_without_these_positions(tiny: saccade.ActionHead) -> None:
    given = load_released("n15_tiny")
    reference = ReferenceHead.from_pretrained(given.path, config=given.config, dtype=torch.float64)
    embodiment = torch.tensor([int(given.embodiment_id[0])])
    state, noise = (torch.from_numpy(np.array(array[:1], np.float64)) for array in (given.state, given.noise))

    def chunk(kept: Sequence[int]) -> Any:
        features = torch.from_numpy(np.array(given.backbone_features[:1, list(kept)], np.float64))
        with torch.no_grad():
            return reference.sample(reference.encode(features), state, embodiment, noise=noise).numpy()

    found = measure(tiny, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1).change
    places = [("left", 0, 0, 2), ("left", 1, 2, 7), ("top", 0, 1, 9)]
    for camera, row, column, position in places:
        without = chunk([place for place in range(11) if place != position])
        assert found[camera][row, column] == pytest.approx(
            float(np.abs(without - chunk(range(11))).mean()), rel=1e-3, abs=1e-6
        )


@pytest.mark.parametrize("batch", [1, 3, 8, 100])
def test_batches_of_any_size_agree(tiny: saccade.ActionHead, batch: int) -> None:
    done: list[int] = []
    occluder: Any = tiny_occluder()
    occluder.batch = batch
    found = measure(tiny, TINY_LAYOUT, occluder, no_noise, cell=1, on_done=done.append)
    expected = measure(tiny, TINY_LAYOUT, tiny_occluder(), no_noise, cell=1)
    for name, change in expected.change.items():
        np.testing.assert_array_equal(found.change[name], change)
    assert done[-1] == 8


def test_other_noise_is_the_mean_over_pairs(tiny: saccade.ActionHead) -> None:
    def whole(count: int) -> Any:
        return np.stack([np.full((6, 5), float(index == 0), np.float32) for index in range(count)])

    found = measure(tiny, TINY_LAYOUT, tiny_occluder(), whole, cell=1)
    assert found.other_noise == pytest.approx(2 / occlusion.NOISES)  # pairs with the first one differ by 1


def test_blanking_a_picture_of_one_colour_changes_nothing(
    policy: Policy, head: saccade.ActionHead, pushed: View
) -> None:
    grey = np.full_like(pushed.images["top"], 90)
    observation = {
        "images": {**pushed.images, "top": grey},
        "proprio": np.asarray(policy.whole.normalizer.denormalize_state(pushed.observation.state)).ravel(),
        "instruction": pushed.source["instruction"],
    }
    nested = policy.observation(observation)
    occluder = BlankedFrames(policy.whole, nested, policy.whole.encode(nested), pushed.observation)
    found = measure(head, pushed.layout, occluder, lambda count: np.zeros((count, 16, 4), np.float32), cell=2)
    assert not found.change["top"].any()
    assert found.change["left"].max() > 0.01
    # One of them by hand: the lower right quarter of what the tower sees of the left picture, rows and
    # columns 2 to 65 of its 68.
    blanked = pushed.images["left"].copy()
    blanked[34:66, 34:66] = np.rint(blanked.mean(axis=(0, 1)))
    chunks = [
        head(
            policy.features({**observation, "images": images}),
            pushed.observation.state,
            0,
            noise=pushed.observation.noise,
        )
        for images in (observation["images"], {**observation["images"], "left": blanked})
    ]
    expected = float(np.abs(np.asarray(chunks[1]) - np.asarray(chunks[0])).mean())
    assert found.change["left"][2:, 2:] == pytest.approx(np.full((2, 2), expected), abs=1e-6)
