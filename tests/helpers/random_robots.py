"""Random robots of all releases: what their strategies and tests share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from saccade import Normalizer
from tests.helpers.oracle_rotations import F64, from_numbers, to_numbers, well_conditioned

JOINTS = ("arm", "hand", "waist", "neck", "head", "leg", "lift", "base", "grip", "tool")
F32 = NDArray[np.float32]


class OracleLike(Protocol):
    """What all oracles have in common."""

    @property
    def action_horizon(self) -> int: ...

    @property
    def embodiment_id(self) -> int | None: ...


def statistics_row(rng: np.random.Generator, width: int, *, gap: float = 1e-9) -> dict[str, list[float]]:
    """Statistics of one key, some dimensions constant, exactly or but for a part ``gap`` of the bound."""
    centre = rng.uniform(0.5, 2.0, width) * rng.choice([-1, 1], width)
    half = rng.uniform(0.3, 1.5, width)
    half = np.where(rng.random(width) < 0.2, 0.0, half)
    low, high = centre - half, centre + half
    nearly = (half == 0) & (rng.random(width) < 0.5)
    high = np.where(nearly, low + gap * np.abs(low), high)
    found = {"min": low, "max": high, "mean": centre + 0.1 * half, "std": half / 2}
    found |= {"q01": low + 0.1 * half, "q99": high - 0.2 * half}
    return {name: values.tolist() for name, values in found.items()}


def rotation(rng: np.random.Generator, name: str, shape: tuple[int, ...], *, to: str) -> F64:
    """Random numbers in the representation ``name`` whose conversion to ``to`` is well conditioned."""
    kept = np.zeros((0, 3, 3))
    numbers: list[F64] = []
    while len(kept) < np.prod(shape):
        drawn = 1.2 * rng.standard_normal((256, 3))
        matrix = from_numbers("axis_angle", drawn)
        safe = well_conditioned(to, matrix) & well_conditioned(name, matrix)
        kept = np.concatenate([kept, matrix[safe]])
        numbers.append(drawn[safe])
    matrix = kept[: int(np.prod(shape))].reshape(*shape, 3, 3)
    if name == "axis_angle":  # keeps angles above pi
        return np.concatenate(numbers)[: int(np.prod(shape))].reshape(*shape, 3)
    found = to_numbers(name, matrix)
    if name == "quaternion":  # any length, either sign
        found = found * rng.uniform(0.5, 2.0, (*shape, 1)) * rng.choice([-1, 1], (*shape, 1))
    if name == "rotation_6d":  # rows that are not orthonormal
        first = found[..., :3] * rng.uniform(0.5, 2.0, (*shape, 1))
        found = np.concatenate([first, found[..., 3:] + 0.3 * first], -1)
    return found


def write(path: Path, values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))


def assert_close(found: Any, expected: F64) -> None:
    """The fixtures' tolerance: 1e-5 absolute and relative."""
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def assert_form(normalizer: Normalizer, oracle: OracleLike) -> None:
    assert normalizer.action_horizon == oracle.action_horizon
    assert normalizer.embodiment_id == oracle.embodiment_id
