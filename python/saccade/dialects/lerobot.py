"""lerobot's form: ``observation.images.*``, ``observation.state``, ``task``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._arrays import Float32Array, UInt8Array, is_torch, like_features
from saccade.dialects.checks import as_text, check_batch, check_cameras, check_frames, check_state, views
from saccade.dialects.reading import Reading, StateReading
from saccade.dialects.requirements import Camera, Requirements

IMAGES, IMAGE, STATE, TASK = "observation.images.", "observation.image", "observation.state", "task"

#: Float frames are clamped to 0 and 1, as lerobot does. Values further out are of another scale, and refused.
LEAST, MOST = -1.0, 2.0


class Lerobot:
    """Frames ``(B, 3, H, W)``, uint8 or float from 0 to 1; the state ``(B, D)``; a string for each row.

    Frames may also have the colours last, as lerobot's robots and environments give them. The answer is one
    array, ``(B, T, D)``: a torch tensor if the observation contains one. Unlike lerobot, which gives the
    first instruction to the whole batch, every row keeps its own.
    """

    name = "lerobot"

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether a key begins with ``observation.``."""
        return any(key.startswith("observation.") for key in observation)

    def read(self, observation: Mapping[str, Any], state: StateReading, needs: Requirements) -> Reading:
        """See :class:`saccade.dialects.Dialect`."""
        frames = _frames(observation, state.is_batched, needs)
        texts = _texts(observation.get(TASK), state, needs)
        check_batch({STATE: len(state), f"{IMAGES}*": len(frames), TASK: len(texts)}, needs)
        return Reading(
            self, needs, state.is_batched, state.use_torch, state.state, frames, texts, is_plain=False
        )

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> StateReading:
        """See :class:`saccade.dialects.Dialect`."""
        given = observation.get(STATE)
        if given is None:
            raise needs.input_error(STATE, f"the state, {needs.state_width} numbers", "none")
        # One state, with or without a batch. A history has an axis of its own, with a batch only.
        axes = np.ndim(given) if not is_torch(given) else given.ndim
        state = check_state(STATE, given, axes if axes in (1, 2, 3) else 2, needs.state_width, needs)
        shaped = state.reshape(len(state) if axes > 1 else 1, -1, needs.state_width)
        if shaped.shape[1] != needs.state_history:
            raise needs.shape_error(STATE, f"{needs.state_history} states a row", f"shape {state.shape}")
        use_torch = any(is_torch(value) for key, value in observation.items() if "observation." in key)
        return StateReading(self, needs, axes > 1, use_torch, shaped)

    def answer(self, parts: Mapping[str, Float32Array], reading: StateReading) -> Any:
        """See :class:`saccade.dialects.Dialect`."""
        actions = np.concatenate(list(parts.values()), axis=-1)
        return like_features(actions if reading.is_batched else actions[0], reading.use_torch)

    def previous_chunk(self, answer: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.dialects.Dialect`."""
        return answer


def _frames(
    observation: Mapping[str, Any], is_batched: bool, needs: Requirements
) -> tuple[dict[str, UInt8Array], ...]:
    given = {key.removeprefix(IMAGES): key for key in observation if key.startswith(IMAGES)}
    if not given and IMAGE in observation:
        given = {"image": IMAGE}
    cameras = check_cameras(IMAGES, given, needs, sort=True)
    frames = {}
    for camera in cameras:
        key = given[camera.name]
        found = _uint8(key, observation[key], camera, needs)
        checked = check_frames(key, found, 4 if is_batched else 3, camera, needs)
        # (batch, 1, height, width, 3). lerobot repeats the frame if the checkpoint wants several.
        timed = checked[:, None] if is_batched else checked[None, None]
        frames[camera.name] = np.repeat(timed, needs.video_horizon or 1, axis=1)
    check_batch({f"{IMAGES}{name}": len(found) for name, found in frames.items()}, needs)
    return views(cameras, frames)


def _uint8(name: str, frames: Any, camera: Camera, needs: Requirements) -> Any:
    """Frames as uint8 with the colours last."""
    if is_torch(frames):
        if frames.device.type != "cpu":
            raise needs.dtype_error(name, "frames on the CPU", f"a tensor on {frames.device}")
        frames = frames.detach()
        # NumPy has no bfloat16; its products are rounded as lerobot's.
        frames = _from_unit(name, frames, needs).numpy() if frames.is_floating_point() else frames.numpy()
    if not isinstance(frames, np.ndarray):
        raise needs.dtype_error(name, "an array", type(frames).__name__)
    if frames.dtype.kind == "f":
        frames = _from_unit(name, frames, needs)
    if frames.ndim < 3:
        raise needs.shape_error(name, "(..., 3, height, width)", f"shape {frames.shape}")
    is_last = frames.shape[-3] != 3 and frames.shape[-1] == 3
    return frames if is_last else np.moveaxis(frames, -3, -1)


def _from_unit(name: str, frames: Any, needs: Requirements) -> Any:
    """Floats from 0 to 1 as uint8, by truncation: NumPy arrays or torch tensors."""
    in_range = (frames >= LEAST) & (frames <= MOST)  # false for NaN
    if not bool(in_range.all()):
        raise needs.input_error(name, "float frames from 0 to 1", "other numbers")
    scaled = frames.clip(0, 1) * 255
    return scaled.byte() if is_torch(scaled) else scaled.astype(np.uint8)


def _texts(given: Any, state: StateReading, needs: Requirements) -> tuple[str | None, ...]:
    """The instruction of each row. One string is for every row. None or an empty one is the default."""
    if given is None or isinstance(given, str):
        rows = [given] * len(state)
    elif isinstance(given, (list, tuple, np.ndarray)):
        rows = list(given)
    else:
        raise needs.input_error(TASK, "an instruction, or one for each row", repr(given))
    return tuple(as_text(TASK, row, needs) if row else None for row in rows)
