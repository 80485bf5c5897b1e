"""The forms of an observation that is read from a data set; all have a batch axis of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.datasets.modality import IMAGES, STATE

Frames = Mapping[str, UInt8Array]
States = Mapping[str, Float32Array]


def isaac(frames: Frames, state: States, key: str, text: str) -> dict[str, Any]:
    """Isaac-GR00T's nested form: ``video``, ``state`` and ``language`` by key."""
    return {
        "video": {name: value[None] for name, value in frames.items()},
        "state": {name: value[None] for name, value in state.items()},
        "language": {key: [[text]]},
    }


def isaac_flat(frames: Frames, state: States, key: str, text: str) -> dict[str, Any]:
    """Isaac-GR00T's flat form: ``video.<name>``, ``state.<name>`` and the key of the instruction.

    The instruction is in a list, as the released loader of N1.5 has it.
    """
    return {
        **{f"video.{name}": value[None] for name, value in frames.items()},
        **{f"state.{name}": value[None] for name, value in state.items()},
        key: [[text]],
    }


def lerobot(frames: Frames, state: States, key: str, text: str) -> dict[str, Any]:
    """The form of lerobot: ``observation.images.<name>``, ``observation.state`` and ``task``.

    A single frame and a single state have no axis for the history.
    """
    shown = {name: np.ascontiguousarray(np.moveaxis(value, -1, -3)) for name, value in frames.items()}
    joined = np.concatenate(list(state.values()), axis=-1)
    return {
        **{f"{IMAGES}{name}": value[None] if len(value) > 1 else value for name, value in shown.items()},
        STATE: joined[None] if len(joined) > 1 else joined,
        "task": [text],
    }


#: All forms by name.
FORMS: dict[str, Callable[[Frames, States, str, str], dict[str, Any]]] = {
    "isaac": isaac,
    "isaac flat": isaac_flat,
    "lerobot": lerobot,
}
