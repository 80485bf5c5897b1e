"""Where objects stand at the beginning of a demonstration; NumPy only.

LIBERO's official states move each object by millimetres, and the target of every task of ``libero_object``
stands in the same place. A policy that is trained on such states need not look. Demonstrations therefore
begin with objects moved further, and in some of them they trade places if the instruction allows it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

SHIFT = 0.03  # metres along each axis, at most
TRADE_SHARE = 0.35  # of the demonstrations in which objects trade places
GAP = 0.005  # metres between two objects, at least
ATTEMPTS = 100
REACH = 1.0  # metres; LIBERO parks objects that are not to be seen further away

Positions = Mapping[str, npt.NDArray[np.float64]]


def wider(
    rng: np.random.Generator,
    found: Positions,
    radii: Mapping[str, float],
    fixed: str,
    trade_share: float,
) -> dict[str, npt.NDArray[np.float64]]:
    """Positions of objects that differ more than those of LIBERO's own reset.

    Args:
        rng: Source of randomness.
        found: ``(2,)`` of each object after the reset, metres.
        radii: Of a circle around each object in the ground plan, metres.
        fixed: The object that does not trade places, the goal. It is shifted like the others.
        trade_share: Share of the placements in which objects trade places.

    Returns:
        The new positions of the objects within reach. If there is no room after many attempts, those that
        were found.

    Example:
        >>> found = {"milk": np.zeros(2), "basket": np.array([0.0, 0.3])}
        >>> moved = wider(np.random.default_rng(0), found, {"milk": 0.04, "basket": 0.1}, "basket", 0.0)
        >>> all(np.abs(moved[name] - found[name]).max() <= SHIFT for name in found)
        True
    """
    near = {name: place for name, place in found.items() if np.abs(place).max() < REACH}
    movable = [name for name in near if name != fixed]
    for attempt in range(ATTEMPTS):
        trades = rng.random() < trade_share
        order = rng.permutation(len(movable)) if trades else np.arange(len(movable))
        places = {name: near[movable[other]] for name, other in zip(movable, order, strict=True)}
        if fixed in near:
            places[fixed] = near[fixed]
        share = 1 - attempt / ATTEMPTS  # less and less, since crowded scenes have little room
        moved = {name: place + share * rng.uniform(-SHIFT, SHIFT, 2) for name, place in places.items()}
        if is_free(moved, radii):
            return moved
    return near


def is_free(places: Positions, radii: Mapping[str, float]) -> bool:
    """Whether no two circles come nearer than ``GAP``."""
    names = list(places)
    return all(
        np.linalg.norm(places[one] - places[other]) >= radii[one] + radii[other] + GAP
        for index, one in enumerate(names)
        for other in names[:index]
    )
