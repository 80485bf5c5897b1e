"""Numbers about maps of attention, by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from saccade_lab.maps.summary import Overlap, entropy, overlap, shuffle, summarize


def numbers(found: Overlap | None) -> tuple[float, ...]:
    assert found is not None
    return dataclasses.astuple(found)


def test_entropy() -> None:
    uniform, one_hot = np.full(7, 1 / 7), np.eye(7)[2]
    assert entropy(uniform) == pytest.approx(math.log(7))
    assert entropy(one_hot) == 0.0
    halves = np.array([0.5, 0.25, 0.25, 0.0])
    assert entropy(np.stack([halves, np.eye(4)[0]])) == pytest.approx([1.5 * math.log(2), 0.0])


def test_overlap_of_identical_maps() -> None:
    assert numbers(overlap(np.tile([0.1, 0.2, 0.7], (5, 1)))) == pytest.approx((0.0, 1.0, 1.0))


def test_overlap_of_maps_that_share_nothing() -> None:
    assert numbers(overlap(np.eye(4))) == pytest.approx((1.0, 0.0, 4.0))
    spread = np.kron(np.eye(3), [0.5, 0.5])  # three tokens with two keys each
    assert numbers(overlap(spread)) == pytest.approx((1.0, 0.0, 3.0))


def test_overlap_by_hand() -> None:
    # The first two: H(.75, .25) - (0 + ln 2) / 2, over ln 2; the third shares nothing with either.
    near = (-0.75 * math.log(0.75) - 0.25 * math.log(0.25)) / math.log(2) - 0.5
    mean = np.array([1.5, 0.5, 1.0]) / 3
    distinct = math.exp(-(mean * np.log(mean)).sum() - math.log(2) / 3)
    found = overlap(np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 1.0]]))
    assert numbers(found) == pytest.approx(((near + 1 + 1) / 3, 1 / math.sqrt(2) / 3, distinct))


def test_one_map_overlaps_with_nothing() -> None:
    assert overlap(np.full((1, 4), 0.25)) is None


def test_shuffling_keeps_what_each_part_gets() -> None:
    rng = np.random.default_rng(0)
    maps = rng.dirichlet(np.ones(12), size=6)
    parts = {"image": np.arange(0, 8), "text": np.arange(8, 12)}
    shuffled = shuffle(maps, parts, rng)
    for positions in parts.values():
        np.testing.assert_array_equal(
            np.sort(shuffled[:, positions], axis=1), np.sort(maps[:, positions], axis=1)
        )
    assert (shuffled != maps).any()
    assert np.abs(shuffled.mean(axis=0) - maps.mean(axis=0)).max() > 1e-3  # each on its own


def test_a_group_in_numbers() -> None:
    maps = np.array([[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.25, 0.75]], dtype=np.float32)
    parts = {"left": np.array([0, 1]), "text": np.array([2]), "special": np.array([3])}
    found = summarize(maps, parts, parts, np.random.default_rng(0))
    assert found.tokens == 2
    assert found.mass == pytest.approx({"left": 0.5, "text": 0.125, "special": 0.375})
    assert found.entropy.most == pytest.approx(math.log(2))
    assert found.entropy.least == pytest.approx(-0.25 * math.log(0.25) - 0.75 * math.log(0.75))
    assert found.entropy.mean == pytest.approx((found.entropy.most + found.entropy.least) / 2)
    expected = float(np.exp(entropy(maps.mean(axis=0)) - found.entropy.mean))
    assert numbers(found.overlap) == pytest.approx((1.0, 0.0, expected))
