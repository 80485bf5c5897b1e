"""What moves the actions: take one patch away, sample again from the same noise, measure the change.

A map of attention says where a row reads; it does not say what it reads there, since after the VL
self-attention every position holds something of all others. Taking the patch away answers the other question,
what the actions depend on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError
from saccade.head import ActionHead
from saccade.maps.layout import Camera, Layout
from saccade.sim.policy import EMBODIMENT_ID, Policy

Float32Array = npt.NDArray[np.float32]
UInt8Array = npt.NDArray[np.uint8]

BATCH = 16  # one observation of N1.5 holds 32 MB of keys and values
MAX_CELLS = 8  # along each side of a picture, unless asked for: each costs a pass through the head
NOISES = 8  # draws that `other_noise` is the mean of


@dataclass(frozen=True)
class Place:
    """Patches of one camera that are taken away together."""

    camera: Camera
    rows: slice
    columns: slice


class Occluder(Protocol):
    """Samples chunks with patches taken away."""

    method: str  # one sentence: how

    def __call__(self, head: ActionHead, places: Sequence[Place | None]) -> Float32Array:
        """One chunk for each place, `(places, horizon, action_dim)`, normalised; None takes nothing away."""


@dataclass(frozen=True)
class Occlusion:
    """What taking away each patch changes.

    Attributes:
        method: How patches were taken away.
        cell: Patches along each side of what was taken away at once.
        change: By camera, `(rows, columns)`: mean |change| of the chunk's normalised actions, the same noise.
        other_noise: Mean |change| between chunks of the whole observation from different noise, to compare.
    """

    method: str
    cell: int
    change: dict[str, Float32Array]
    other_noise: float

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        change = {name: values.tolist() for name, values in self.change.items()}
        return {**vars(self), "change": change}


class BlankedPixels:
    """Takes patches away in the picture: their pixels get the picture's mean colour.

    Args:
        policy: has the backbone.
        observation: of the simulator.
        noise: `(1, horizon, action_dim)`, for all chunks.
    """

    method = "the patch's pixels are replaced by the picture's mean colour, before the backbone"

    def __init__(self, policy: Policy, observation: Mapping[str, Any], noise: Float32Array) -> None:
        self._policy = policy
        self._observation = observation
        self._noise = noise

    def __call__(self, head: ActionHead, places: Sequence[Place | None]) -> Float32Array:
        """See `Occluder`."""
        features = np.concatenate([self._policy.features(self._without(place)) for place in places])
        count = len(places)
        state = np.repeat(self._policy.state(self._observation), count, axis=0)
        noise = np.repeat(self._noise, count, axis=0)
        return np.asarray(head(features, state, EMBODIMENT_ID, noise=noise))

    def _without(self, place: Place | None) -> Mapping[str, Any]:
        if place is None:
            return self._observation
        picture: UInt8Array = self._observation["images"][place.camera.name].copy()
        size = picture.shape[0] // place.camera.rows
        blanked = (
            slice(place.rows.start * size, place.rows.stop * size),
            slice(place.columns.start * size, place.columns.stop * size),
        )
        picture[blanked] = np.rint(picture.mean(axis=(0, 1))).astype(np.uint8)
        return {**self._observation, "images": {**self._observation["images"], place.camera.name: picture}}


class DroppedPositions:
    """Takes patches away in T_vl: their positions are removed by `drop_vl`, as if they had not been there.

    Args:
        features: `(1, T_vl, context_dim)`.
        state: `(1, state_dim)` or `(1, history, state_dim)`.
        embodiment_id: of the robot.
        noise: `(1, horizon, encoder_action_dim)`, for all chunks.
    """

    method = (
        "the patch's positions are dropped before the VL self-attention (drop_vl); what the backbone had "
        "already mixed into other positions stays"
    )

    def __init__(
        self, features: Float32Array, state: Float32Array, embodiment_id: int, noise: Float32Array
    ) -> None:
        self._features, self._state, self._embodiment_id, self._noise = features, state, embodiment_id, noise

    def __call__(self, head: ActionHead, places: Sequence[Place | None]) -> Float32Array:
        """See `Occluder`."""
        count = len(places)
        dropped = np.zeros((count, self._features.shape[1]), dtype=np.bool_)
        for row, place in zip(dropped, places, strict=True):
            if place is not None:
                grid = row[place.camera.positions].reshape(place.camera.rows, place.camera.columns)
                grid[place.rows, place.columns] = True
        return np.asarray(
            head(
                np.repeat(self._features, count, axis=0),
                np.repeat(self._state, count, axis=0),
                np.full(count, self._embodiment_id),
                noise=np.repeat(self._noise, count, axis=0),
                drop_vl=dropped,
            )
        )


def cell_for(layout: Layout, cell: int | None) -> int:
    """Patches along each side of what is taken away at once: as asked for, or so many that no picture has
    more than `MAX_CELLS` x `MAX_CELLS` of them.

    Raises:
        InputError: it is below 1.
    """
    if cell is not None:
        if cell < 1:
            raise InputError(f"cell: given {cell}, expected at least 1")
        return cell
    side = max((max(camera.rows, camera.columns) for camera in layout.cameras), default=1)
    return -(-side // MAX_CELLS)


def places_of(layout: Layout, cell: int) -> list[Place]:
    """All that is taken away, one after the other; at the far edges a place may be smaller."""
    return [
        Place(
            camera,
            slice(row, min(row + cell, camera.rows)),
            slice(column, min(column + cell, camera.columns)),
        )
        for camera in layout.cameras
        for row in range(0, camera.rows, cell)
        for column in range(0, camera.columns, cell)
    ]


def measure(
    head: ActionHead,
    layout: Layout,
    occluder: Occluder,
    whole: Callable[[int], Float32Array],
    *,
    cell: int,
    batch: int = BATCH,
    on_done: Callable[[int], None] = lambda done: None,
) -> Occlusion:
    """Takes away every patch of every camera in turn.

    Args:
        head: computes the chunks.
        layout: where the patches are.
        occluder: takes them away.
        whole: so many chunks of the whole observation from different noise, `(count, horizon, action_dim)`.
        cell: patches along each side of what is taken away at once.
        batch: places at once.
        on_done: told how many places are done.
    """
    places = places_of(layout, cell)
    untouched = occluder(head, [None])[0]
    change = {camera.name: np.zeros((camera.rows, camera.columns), np.float32) for camera in layout.cameras}
    for start in range(0, len(places), batch):
        group = places[start : start + batch]
        chunks = occluder(head, group)
        for place, chunk in zip(group, chunks, strict=True):
            change[place.camera.name][place.rows, place.columns] = np.abs(chunk - untouched).mean()
        on_done(min(start + batch, len(places)))
    draws = whole(NOISES)
    pairs = [np.abs(a - b).mean() for index, a in enumerate(draws) for b in draws[:index]]
    return Occlusion(occluder.method, cell, change, float(np.mean(pairs)))
