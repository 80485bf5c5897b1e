"""Wider placements of objects."""

from __future__ import annotations

import numpy as np
import pytest

from saccade_lab.libero.placements import GAP, SHIFT, TRADE_SHARE, is_free, wider

FOUND = {
    "milk": np.array([-0.12, -0.24]),
    "butter": np.array([0.05, -0.1]),
    "soup": np.array([-0.15, 0.06]),
    "basket": np.array([0.0, 0.26]),
    "parked": np.array([0.1, 10.0]),
}
RADII = {"milk": 0.037, "butter": 0.043, "soup": 0.044, "basket": 0.116, "parked": 0.04}


def test_objects_move_by_centimetres_and_sometimes_trade_places() -> None:
    traded, shifts = 0, []
    for seed in range(300):
        moved = wider(np.random.default_rng(seed), FOUND, RADII, "basket", TRADE_SHARE)
        assert set(moved) == {"milk", "butter", "soup", "basket"}  # the parked one stays where it is
        places = {
            name: min(FOUND, key=lambda other: np.abs(FOUND[other] - moved[name]).max()) for name in moved
        }
        assert places["basket"] == "basket"
        assert sorted(places.values()) == sorted(moved)  # no two at one place
        assert all(np.abs(moved[name] - FOUND[place]).max() <= SHIFT for name, place in places.items())
        names = list(moved)
        for index, one in enumerate(names):
            for other in names[:index]:
                assert np.hypot(*(moved[one] - moved[other])) >= RADII[one] + RADII[other] + GAP
        traded += any(name != place for name, place in places.items())
        shifts.append(moved["basket"] - FOUND["basket"])
    assert 60 < traded < 120  # of 300; five of six orders of three objects differ
    assert np.abs(np.std(shifts, axis=0) - SHIFT / np.sqrt(3)).max() < 0.003  # of a uniform distribution


def test_the_same_seed_gives_the_same_places() -> None:
    one, other = (wider(np.random.default_rng(7), FOUND, RADII, "basket", TRADE_SHARE) for _ in range(2))
    assert all(np.array_equal(one[name], other[name]) for name in one)


def test_without_room_objects_stay() -> None:
    found = {"milk": np.zeros(2), "soup": np.array([0.01, 0.0])}
    moved = wider(np.random.default_rng(0), found, {"milk": 0.5, "soup": 0.5}, "basket", TRADE_SHARE)
    assert all(np.array_equal(moved[name], found[name]) for name in found)


@pytest.mark.parametrize(("distance", "free"), [(0.0749, False), (0.0751, True)])
def test_the_gap_between_two_circles(distance: float, free: bool) -> None:
    places = {"milk": np.zeros(2), "soup": np.array([0.0, distance])}
    assert is_free(places, {"milk": 0.03, "soup": 0.04}) is free
