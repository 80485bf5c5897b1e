"""What later calls take from earlier features, and prompts of different length in one pass: the same bits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import saccade
from saccade import _saccade
from tests.helpers.released_backbones import NAMES, ReleasedBackbone, released_backbone

PRECISIONS = ("float32", "bfloat16", "int8", "int4")


def assert_same(given: saccade.BackboneFeatures, expected: saccade.BackboneFeatures) -> None:
    assert np.array_equal(given.backbone_features, expected.backbone_features)
    assert np.array_equal(given.image_mask, expected.image_mask)
    assert np.array_equal(given.attention_mask, expected.attention_mask)
    assert {name: places.tolist() for name, places in given.views.items()} == {
        name: places.tolist() for name, places in expected.views.items()
    }


def with_changed_view(released: ReleasedBackbone, view: int) -> Any:
    """The pixels with one of them changed."""
    pixels = released.pixel_values
    if isinstance(pixels, list):
        pixels = [array.copy() for array in pixels]
        pixels[view][0, 0, 0, 0] += 0.25
        return pixels
    pixels = pixels.copy()
    grids = released.arrays.get("_in.image_grid_thw")
    first = view if grids is None else int(grids[:view].prod(axis=1).sum())
    pixels[first].reshape(-1)[0] += 0.25
    return pixels


def with_changed_word(released: ReleasedBackbone, place: int) -> NDArray[np.int64]:
    ids: NDArray[np.int64] = released.arrays["_in.input_ids"].copy()
    ids[:, place] = 3
    return ids


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_reuse_has_the_same_bits(name: str, precision: str) -> None:
    released = released_backbone(name)
    backbone = released.load(precision)
    previous = backbone(released.inputs())
    num_views = len(previous.views)
    changed = [
        {},
        {"input_ids": with_changed_word(released, -3)},
        {"input_ids": with_changed_word(released, 0)},
    ]
    changed += [{"pixel_values": with_changed_view(released, view)} for view in range(num_views)]
    for changes in changed:
        inputs = released.inputs(**changes)
        assert_same(backbone(inputs, previous=previous), backbone(inputs))


def test_reuse_has_the_same_bits_on_every_instruction_set(isa: str) -> None:
    for name in ("n15_two_views", "n17_two_views"):
        released = released_backbone(name)
        backbone = released.load("bfloat16")
        previous = backbone(released.inputs())
        inputs = released.inputs(pixel_values=with_changed_view(released, 1))
        assert_same(backbone(inputs, previous=previous), backbone(inputs))


@pytest.mark.parametrize("length", [1, 2, 7, 16, 17, 40, 53])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_prefixes_of_any_length(length: int, precision: str) -> None:
    """Words change at one place, after a view or before it, and the prompt becomes longer or shorter."""
    released = released_backbone("n15_one_view")
    backbone = released.load(precision)
    previous = backbone(released.inputs())
    ids = released.arrays["_in.input_ids"].copy()
    if ids[0, length] != released.image_token_id:
        ids[0, length] = 5
        inputs = released.inputs(input_ids=ids, attention_mask=None)
        assert_same(backbone(inputs, previous=previous), backbone(inputs))
    longer = np.concatenate([released.arrays["_in.input_ids"], np.full((1, length), 7)], axis=1)
    inputs = released.inputs(input_ids=longer, attention_mask=None)
    grown = backbone(inputs, previous=previous)
    assert_same(grown, backbone(inputs))
    # A chain: what was made from previous features serves as well, for a prompt that is a part of it.
    assert_same(backbone(released.inputs(), previous=grown), previous)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_holes_in_the_mask(precision: str) -> None:
    """Any mask: rows and places of padding do not have to be on the left."""
    rng = np.random.default_rng(5)
    for name in ("n15_two_views", "n17_one_view"):
        released = released_backbone(name)
        backbone = released.load(precision)
        ids = released.arrays["_in.input_ids"]
        mask = (rng.random(ids.shape) < 0.6) | (ids == released.image_token_id)
        previous = backbone(released.inputs(attention_mask=mask))
        other = mask.copy()
        words = np.flatnonzero(ids[0] != released.image_token_id)
        other[0, words[-2]] ^= True
        inputs = released.inputs(attention_mask=other)
        assert_same(backbone(inputs, previous=previous), backbone(inputs))


def test_a_view_may_come_from_another_place() -> None:
    released = released_backbone("n15_two_views")
    backbone = released.load()
    previous = backbone(released.inputs())
    inputs = released.inputs(pixel_values=released.pixel_values[::-1])
    assert_same(backbone(inputs, previous=previous), backbone(inputs))


def test_what_is_unchanged_is_shared() -> None:
    released = released_backbone("n15_two_views")
    backbone = released.load()
    previous = backbone(released.inputs())
    bare = released.inputs(pixel_values=released.pixel_values[:0], input_ids=[[1, 2, 3]], attention_mask=None)
    # Three tokens, their keys and values, and no view.
    assert backbone(bare).nbytes < previous.nbytes / 8
    again = backbone(released.inputs(), previous=previous)
    assert again.nbytes == previous.nbytes
    assert_same(again, previous)


def test_only_what_has_changed_is_computed() -> None:
    released = released_backbone("n15_two_views")
    backbone = released.load()
    previous = backbone(released.inputs())

    def work(previous: saccade.BackboneFeatures | None = None, **changes: Any) -> tuple[int, int]:
        """Multiply-adds of patches, and of the projections of both models."""
        inputs = released.inputs(**changes)
        with _saccade.profile() as profile:
            backbone(inputs, previous=previous)
        counted = profile.counters()
        return counted["patches"][2], counted["feed_forward_in"][2]

    config, tokens = backbone.config, released.features.shape[1]
    patches, rows = work()
    of_vision = 32 * config.vision_width * config.vision_hidden_dim * config.vision_num_layers
    of_row = 2 * config.width * config.hidden_dim * config.num_layers
    assert rows == of_vision + tokens * of_row
    first, second = (int(places[0, 0]) for places in previous.views.values())
    assert work(previous) == (0, 0)
    assert work(previous, input_ids=with_changed_word(released, -3)) == (0, 3 * of_row)
    for view, place in enumerate((first, second)):
        expected = patches // 2, of_vision // 2 + (tokens - place) * of_row
        assert work(previous, pixel_values=with_changed_view(released, view)) == expected


def test_a_record_is_whole_with_previous_features() -> None:
    released = released_backbone("n15_two_views")
    backbone = released.load()
    previous = backbone(released.inputs())
    given = backbone(released.inputs(), previous=previous, record=("hidden", "vision")).record
    expected = backbone(released.inputs(), record=("hidden", "vision")).record
    assert given is not None
    assert expected is not None
    for layer, rows in expected.hidden.items():
        assert np.array_equal(given.hidden[layer], rows)
    for place, rows in expected.vision.items():
        assert np.array_equal(given.vision[place], rows)


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("names", [NAMES[:3], NAMES[:1] * 2])
def test_prompts_of_different_length_share_a_pass(names: tuple[str, ...], precision: str) -> None:
    """Rows of all prompts in one product: each has the bits that it has alone."""
    first = released_backbone(names[0])
    backbone = first.load(precision)
    inputs = [released_backbone(name).inputs() for name in names]
    alone = [backbone(given) for given in inputs]
    for given, expected in zip(backbone.encode_many(inputs), alone, strict=True):
        assert_same(given, expected)
    for given, expected in zip(backbone.encode_many(inputs, previous=alone[1:]), alone, strict=True):
        assert_same(given, expected)


def test_more_rows_than_are_computed_together() -> None:
    """More views and prompts than one pass takes."""
    released = released_backbone("n15_pixel_shuffle")
    backbone = released.load()
    count = 45
    ids = np.tile(released.arrays["_in.input_ids"], (count, 1))
    mask = np.tile(released.arrays["_in.attention_mask"], (count, 1))
    pixels = np.tile(released.pixel_values, (count, 1, 1, 1))
    many = backbone(saccade.BackboneInputs(pixels, ids, mask)).backbone_features
    few = backbone(released.inputs()).backbone_features
    assert np.array_equal(many, np.tile(few, (count, 1, 1)))
