"""lerobot's format: ``observation.images.*``, ``observation.state``, ``task``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import Array, Float32Array, UInt8Array, is_torch, like_features
from saccade.observations.checks import (
    as_list,
    as_text,
    check_batch,
    check_frames,
    check_state,
    default_instructions,
    find_cameras,
    on_cpu,
    shape_of,
    views,
)
from saccade.observations.parsed import ParsedObservation, ParsedState
from saccade.observations.requirements import Requirements

IMAGES, IMAGE, STATE, TASK = "observation.images.", "observation.image", "observation.state", "task"

#: Float frames are clamped to 0 and 1, as lerobot does. Values further out are of another scale, and refused.
LEAST, MOST = -1.0, 2.0


class Lerobot:
    """Frames ``(B, 3, H, W)``, uint8 or float from 0 to 1; the state ``(B, D)``; a string for each row.

    Frames may also be ``(B, T, 3, H, W)``, and have the colours last, as lerobot's robots and environments
    give them. Keys are renamed first, as the checkpoint says. Actions are one array, ``(B, T, D)``: a torch
    tensor if the observation contains one. Unlike lerobot, which gives the first instruction to the whole
    batch in N1.5, every row keeps its own.
    """

    name = "lerobot"

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether a key begins with ``observation.``."""
        return any(key.startswith("observation.") for key in observation)

    def read(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> ParsedObservation:
        """See :class:`saccade.observations.ObservationFormat`."""
        frames = _frames(_renamed(observation, needs), needs)
        texts = _texts(observation.get(TASK), len(state), needs)
        check_batch({STATE: len(state), f"{IMAGES}*": len(frames), TASK: len(texts)}, needs)
        return ParsedObservation(**vars(state), frames=frames, instructions=texts, is_plain=False)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> ParsedState:
        """See :class:`saccade.observations.ObservationFormat`."""
        given = _renamed(observation, needs).get(STATE)
        if given is None:
            raise needs.input_error(STATE, f"the state, {needs.state_width} numbers", "none")
        # One state, with or without a batch. A history has an axis of its own, with a batch only.
        axes = len(shape_of(STATE, given, needs))
        state = check_state(STATE, given, axes if axes in (1, 2, 3) else 2, needs.state, needs)
        shaped = state.reshape(len(state) if axes > 1 else 1, -1, needs.state_width)
        if shaped.shape[1] != needs.state_history:
            raise needs.shape_error(STATE, f"{needs.state_history} states a row", f"shape {state.shape}")
        use_torch = any(is_torch(value) for key, value in observation.items() if "observation." in key)
        return ParsedState(self, needs, axes > 1, use_torch, shaped)

    def write_actions(self, actions: Mapping[str, Float32Array], parsed: ParsedState) -> Array:
        """See :class:`saccade.observations.ObservationFormat`."""
        joined = np.concatenate(list(actions.values()), axis=-1)
        return like_features(joined if parsed.is_batched else joined[0], parsed.use_torch)

    def read_actions(self, actions: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.observations.ObservationFormat`."""
        return actions


def _renamed(observation: Mapping[str, Any], needs: Requirements) -> Mapping[str, Any]:
    """The observation with its keys renamed. In lerobot the later of two keys of one name counts."""
    if not needs.rename_map:
        return observation
    names, found = dict(needs.rename_map), {}
    for key, value in observation.items():
        name = names.get(key, key) if key.startswith("observation.") else key
        if name in found:
            both = [given for given in observation if names.get(given, given) == name]
            raise needs.input_error(name, "one key that is called so after renaming", " and ".join(both))
        found[name] = value
    return found


def _frames(observation: Mapping[str, Any], needs: Requirements) -> tuple[dict[str, UInt8Array], ...]:
    given = {key.removeprefix(IMAGES): key for key in observation if key.startswith(IMAGES.rstrip("."))}
    if not given and IMAGE in observation:
        given = {"image": IMAGE}
    frames = {}
    for camera, name in find_cameras(IMAGES, given, needs, sort=True):
        key = given[name]
        found = check_frames(key, _uint8(key, observation[key], needs), (3, 4, 5), camera, needs)
        if found.ndim == 3:
            found = found[None]
        frames[camera.name] = _aligned(found[:, None] if found.ndim == 4 else found, needs.video_horizon)
    return views(IMAGES, frames, None, needs)


def _aligned(frames: UInt8Array, horizon: int | None) -> UInt8Array:
    """The last frames ``(batch, horizon, ...)``. If there are too few, the first is repeated before them."""
    missing = 0 if horizon is None else horizon - frames.shape[1]
    if missing > 0:
        return np.concatenate([frames[:, :1].repeat(missing, axis=1), frames], axis=1)
    return frames[:, -missing:]


def _uint8(name: str, frames: Any, needs: Requirements) -> Any:
    """Frames as uint8 with the colours last."""
    frames = on_cpu(name, frames, needs)
    if is_torch(frames):
        # NumPy has no bfloat16; its products are rounded as lerobot's.
        frames = _from_unit(name, frames, needs).numpy() if frames.is_floating_point() else frames.numpy()
    if not isinstance(frames, np.ndarray):
        raise needs.dtype_error(name, "an array", type(frames).__name__)
    if frames.ndim not in (3, 4, 5) or 3 not in (frames.shape[-3], frames.shape[-1]):
        raise needs.shape_error(
            name, "(batch, 3, height, width), with time after the batch or without", f"shape {frames.shape}"
        )
    if frames.dtype.kind == "f":
        frames = _from_unit(name, frames, needs)
    is_last = frames.shape[-3] != 3 and frames.shape[-1] == 3
    return frames if is_last else np.moveaxis(frames, -3, -1)


def _from_unit(name: str, frames: Any, needs: Requirements) -> Any:
    """Floats from 0 to 1 as uint8, by truncation: NumPy arrays or torch tensors."""
    in_range = (frames >= LEAST) & (frames <= MOST)  # false for NaN
    if not bool(in_range.all()):
        raise needs.input_error(name, "float frames from 0 to 1", "other numbers")
    scaled = frames.clip(0, 1) * 255
    return scaled.byte() if is_torch(scaled) else scaled.astype(np.uint8)


def _texts(given: Any, count: int, needs: Requirements) -> tuple[str | None, ...]:
    """The instruction of each row. One is for every row. None or an empty one is the released default."""
    given = as_list(given)
    rows = (given or [None]) if isinstance(given, list) else [given]
    if given is not None and not isinstance(given, (list, str)):
        raise needs.input_error(TASK, "an instruction, or one for each row", repr(given))
    # Isaac-GR00T takes an empty text as it is where it has no default.
    is_default = [
        row is None or (isinstance(row, str) and not row and not needs.requires_language) for row in rows
    ]
    if any(is_default):
        default_instructions(TASK, count, needs)
    texts = [
        None if default else as_text(TASK, row, needs) for row, default in zip(rows, is_default, strict=True)
    ]
    return tuple(texts * count if len(texts) == 1 else texts)
