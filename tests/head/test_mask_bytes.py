"""Masks whose bytes are neither 0 nor 1, as views of other memory have them: every byte but 0 is True."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import saccade
import saccade.torch
from saccade._internal.arrays import boolean, mask_bytes
from saccade.head.input_files import as_mask
from tests.head.test_head import cross_tensors, load
from tests.helpers.released import load_released
from tests.helpers.released_backbones import released_backbone

#: The lowest bit alone tells nothing: of some of these it is 0.
BYTES = np.array([255, 2, 1, 128, 254], np.uint8)


def odd(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask, with other bytes in place of 1."""
    found = np.resize(BYTES, mask.size).reshape(mask.shape) * mask
    return found.view(np.bool_)


def test_bytes_become_booleans() -> None:
    given = np.array([255, 0, 2, 1], np.uint8).view(np.bool_)
    found, held = boolean("mask", given), mask_bytes("mask", given)
    assert found is not None
    assert held is not None
    assert found.view(np.uint8).tolist() == held.tolist() == [1, 0, 1, 1]
    assert as_mask("file", "mask", given).view(np.uint8).tolist() == [1, 0, 1, 1]  # type: ignore[union-attr]
    values: list[Any] = [given[::2], given[1], torch.from_numpy(given), given.reshape(2, 2).T]
    for value in values:
        proper, held = np.asarray(value).view(np.uint8) != 0, mask_bytes("mask", value)
        assert held is not None
        assert held.shape == proper.shape
        assert held.tolist() == proper.astype(np.uint8).tolist()


@pytest.mark.parametrize("name", ["image_mask", "attention_mask", "drop_vl"])
def test_the_head(name: str) -> None:
    head = load(load_released("n17_tiny"))
    rng = np.random.default_rng(0)
    features = rng.standard_normal((2, 12, head.config.context_dim), np.float32)
    state = rng.standard_normal((2, head.config.state_history, head.config.state_dim), np.float32)
    masks: dict[str, Any] = {
        "image_mask": np.tile(np.arange(12) % 3 == 0, (2, 1)),
        "attention_mask": np.tile(np.arange(12) < 10, (2, 1)),
        "drop_vl": np.tile(np.arange(12) % 5 == 4, (2, 1)),
    }
    embodiment = head.embodiment_ids[0]
    expected = head(features, state, embodiment, seed=0, **masks)
    other = head(features, state, embodiment, seed=0, **masks | {name: np.roll(masks[name], 1, axis=1)})
    assert not np.array_equal(other, expected), "the mask matters"
    given = masks | {name: odd(masks[name])}
    assert np.array_equal(head(features, state, embodiment, seed=0, **given), expected)
    image = np.asarray(head.encode(features, **given).image_mask)
    assert np.array_equal(image.view(np.uint8), masks["image_mask"].astype(np.uint8))


def test_the_backbone() -> None:
    released = released_backbone("n15_two_views")
    backbone = released.load()
    mask = released.arrays["_in.attention_mask"] != 0
    assert mask.shape[1] > 4
    mask[:, -2:] = False
    expected = backbone(released.inputs(attention_mask=mask))
    everything = backbone(released.inputs(attention_mask=np.ones_like(mask)))
    assert not np.array_equal(everything.backbone_features, expected.backbone_features), "the mask matters"
    inputs = released.inputs(attention_mask=odd(mask))
    found = backbone(inputs)
    assert np.array_equal(found.backbone_features, expected.backbone_features)
    attended = np.asarray(found.attention_mask)
    assert np.array_equal(attended.view(np.uint8), mask.astype(np.uint8))
    # The array belongs to the caller, who may write any byte to it afterwards.
    inputs.attention_mask.view(np.uint8)[...] = odd(mask).view(np.uint8)
    assert np.array_equal(backbone(inputs).backbone_features, expected.backbone_features)


@pytest.mark.parametrize("share", [np.asarray, torch.from_numpy])
def test_the_cross_attention(share: Any) -> None:
    attention = saccade.CrossAttention(cross_tensors(12, 5), 3)
    rng = np.random.default_rng(0)
    kv = attention.project(rng.standard_normal((2, 9, 5), np.float32))
    states = rng.standard_normal((2, 4, 12), np.float32)
    mask = rng.random((2, 9)) < 0.6
    expected, weights = attention(states, kv, key_mask=mask, return_weights=True)
    assert not np.array_equal(attention(states, kv), expected), "the mask matters"
    found, found_weights = attention(states, kv, key_mask=share(odd(mask)), return_weights=True)
    assert np.array_equal(found, expected)
    assert np.array_equal(found_weights, weights)


def test_the_operator_of_torch() -> None:
    tensors = {name: torch.from_numpy(value) for name, value in cross_tensors(12, 5).items()}
    attention = saccade.torch.CrossAttention(tensors, 3)
    states, tokens = torch.ones(1, 3, 12), torch.arange(20.0).reshape(1, 4, 5)
    mask = np.array([[True, False, True, False]])
    expected = attention(states, tokens, attention_mask=torch.from_numpy(mask))
    assert torch.equal(attention(states, tokens, attention_mask=torch.from_numpy(odd(mask))), expected)
