"""Occlusion: remove one patch, sample again from the same noise, measure the change of the actions.

An attention map shows which positions a row reads, but not what it reads there: after the VL self-attention
every position contains information of all others. Occlusion shows what the actions depend on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.errors import InputError
from saccade.head.head import ActionHead
from saccade.observations import view_places
from saccade.policy.encoding import PolicyContext
from saccade.policy.policy import Policy
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.maps.layout import Layout, ViewLayout

MAX_CELLS = 8  # along each side of a picture by default; each costs a pass through the policy
NOISES = 8  # draws that `other_noise` is computed from


@dataclass(frozen=True)
class Place:
    """Patches of one camera that are removed together."""

    camera: ViewLayout
    rows: slice
    columns: slice


class Occluder(Protocol):
    """Samples chunks with patches removed."""

    method: str  # one sentence: how
    batch: int  # places at once

    def __call__(self, head: ActionHead, places: Sequence[Place | None]) -> Float32Array:
        """One chunk for each place, ``(places, horizon, action_dim)``, normalised; None removes nothing."""


@dataclass(frozen=True)
class Occlusion:
    """How the actions change without each patch.

    Attributes:
        method: How patches were removed.
        cell: Patches along each side of what was removed at once.
        change: Mean absolute change of the normalised actions by camera, ``(rows, columns)``, from equal
            noise.
        other_noise: Mean absolute change between chunks of the whole observation from different noise, to
            compare.
    """

    method: str
    cell: int
    change: dict[str, Float32Array]
    other_noise: float

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        change = {name: values.tolist() for name, values in self.change.items()}
        return {**vars(self), "change": change}


class BlankedFrames:
    """Removes patches from the frames of a whole policy: their pixels get the mean colour of the frame.

    Args:
        policy: Whole policy.
        seen: Observation in Isaac-GR00T's nested form, with a batch of one.
        encoded: What the policy encoded of it: other views are not computed again.
        observation: The same as the head takes it; its state and noise are used for all chunks.
    """

    method = "the frame's pixels behind the patch are replaced by its mean colour, before the backbone"
    batch = 4  # keys and values of N1.5's language model take 50 MB for each

    def __init__(
        self, policy: Policy, seen: Mapping[str, Any], encoded: PolicyContext, observation: HeadInputs
    ) -> None:
        self._policy = policy
        self._seen = seen
        self._encoded = encoded
        self._observation = observation

    def __call__(self, head: ActionHead, places: Sequence[Place | None]) -> Float32Array:
        """See ``Occluder``."""
        encoded = self._policy.encode([self._without(place) for place in places], previous=self._encoded)
        return self._observation.repeated(len(places)).sample(head, encoded.context)

    def _without(self, place: Place | None) -> Mapping[str, Any]:
        if place is None:
            return self._seen
        video = self._seen["video"]
        camera, time = view_places(video)[place.camera.name]
        frames: UInt8Array = video[camera].copy()  # (1, time, height, width, 3)
        frame = frames[0, time]
        frame[behind(place, *frame.shape[:2])] = np.rint(frame.mean(axis=(0, 1))).astype(np.uint8)
        return {**self._seen, "video": {**video, camera: frames}}


def behind(place: Place, height: int, width: int) -> tuple[slice, slice]:
    """The rows and columns of a frame of this size that a place sees; empty outside the frame.

    Example:
        >>> camera = ViewLayout("front", 0, 4, 4, (0.25, -0.5, 0.75, 1.5))
        >>> behind(Place(camera, slice(1, 2), slice(0, 4)), 8, 8)
        (slice(0, 4, None), slice(2, 6, None))
    """
    left, top, right, bottom = place.camera.region

    def part(cells: slice, count: int, start: float, stop: float, side: int) -> slice:
        edges = [start + (stop - start) * cell / count for cell in (cells.start, cells.stop)]
        first, last = (min(max(round(edge * side), 0), side) for edge in edges)
        return slice(first, last)

    return (
        part(place.rows, place.camera.rows, top, bottom, height),
        part(place.columns, place.camera.columns, left, right, width),
    )


class DroppedPositions:
    """Removes patches from T_vl: ``drop_vl`` removes their positions, as if they had not been there.

    Args:
        observation: One row, with noise.
    """

    method = (
        "the patch's positions are dropped before the VL self-attention (drop_vl); what the backbone had "
        "already mixed into other positions stays"
    )
    batch = 16  # one observation of N1.5 holds 32 MB of keys and values

    def __init__(self, observation: HeadInputs) -> None:
        self._observation = observation

    def __call__(self, head: ActionHead, places: Sequence[Place | None]) -> Float32Array:
        """See ``Occluder``."""
        repeated = self._observation.repeated(len(places))
        dropped = np.zeros((len(places), repeated.num_vl_tokens), dtype=np.bool_)
        for row, place in zip(dropped, places, strict=True):
            if place is not None:
                grid = row[place.camera.positions].reshape(place.camera.rows, place.camera.columns)
                grid[place.rows, place.columns] = True
        return replace(repeated, drop_vl=dropped).sample(head)


def cell_for(layout: Layout, cell: int | None) -> int:
    """Patches along each side of what is removed at once.

    Args:
        layout: Layout with the cameras.
        cell: The number given by the user; None chooses the smallest with which no picture has more than
            ``MAX_CELLS`` x ``MAX_CELLS`` cells.

    Raises:
        InputError: It is below 1.
    """
    if cell is not None:
        if cell < 1:
            raise InputError(f"cell: given {cell}, expected at least 1")
        return cell
    side = max((max(camera.rows, camera.columns) for camera in layout.cameras), default=1)
    return -(-side // MAX_CELLS)


def places_of(layout: Layout, cell: int) -> list[Place]:
    """All places in turn; at the right and lower edges a place may be smaller."""
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
    on_done: Callable[[int], None] = lambda done: None,
) -> Occlusion:
    """Removes every patch of every camera in turn.

    Args:
        head: Head that computes the chunks.
        layout: Where the patches are.
        occluder: Function that removes them.
        whole: Function from a number of draws to chunks of the whole observation, `(draws, horizon,
            action_dim)`.
        cell: Patches along each side of what is removed at once.
        on_done: Called with the number of places done.
    """
    places, batch = places_of(layout, cell), occluder.batch
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
