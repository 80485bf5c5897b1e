"""Checks that the forms of observations share: frames, states, instructions, batch axes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from saccade._arrays import Float32Array, UInt8Array, float32, is_torch
from saccade.dialects.requirements import Camera, Requirements
from saccade.errors import DtypeError, ShapeError


def check_cameras(prefix: str, given: Iterable[str], needs: Requirements, *, sort: bool) -> list[Camera]:
    """The cameras of an observation in the order of the prompt.

    Args:
        prefix: What the keys of cameras begin with, for messages.
        given: The cameras of the observation, without prefix.
        needs: What the robot needs.
        sort: Whether cameras that the checkpoint does not name are sorted by name.

    Raises:
        InputError: A camera is missing or unknown, or there is none.
    """
    names = list(given)
    if needs.cameras is None:
        if not names:
            raise needs.input_error(f"{prefix}*", "at least one camera", "none")
        return [Camera(name) for name in (sorted(names) if sort else names)]
    expected = [camera.name for camera in needs.cameras]
    if set(names) != set(expected):
        raise needs.input_error(f"{prefix}*", f"cameras {', '.join(expected)}", ", ".join(names) or "none")
    return list(needs.cameras)


def check_frames(name: str, frames: Any, axes: int, camera: Camera, needs: Requirements) -> UInt8Array:
    """Frames of one camera, with colours last.

    Args:
        name: The key, for messages.
        frames: uint8, with three colours in the last of ``axes`` axes.
        axes: The number of axes, those of batch and time included.
        camera: The camera.
        needs: What the robot needs.

    Raises:
        ShapeError, DtypeError: They do not fit.
    """
    shape = f"uint8 of {axes} axes that end in (height, width, 3)"
    if is_torch(frames):
        if frames.device.type != "cpu":
            raise needs.dtype_error(name, "frames on the CPU", f"a tensor on {frames.device}")
        frames = frames.detach().numpy()
    if not isinstance(frames, np.ndarray):
        raise needs.dtype_error(name, f"an array, {shape}", type(frames).__name__)
    if frames.dtype != np.uint8:
        raise needs.dtype_error(name, shape, frames.dtype)
    if frames.ndim != axes or frames.shape[-1] != 3 or 0 in frames.shape:
        raise needs.shape_error(name, shape, f"shape {frames.shape}")
    height, width = frames.shape[-3:-1]
    if camera.height is not None and (height, width) != (camera.height, camera.width):
        raise needs.shape_error(
            name, f"frames of {camera.height} x {camera.width} pixels", f"{height} x {width}"
        )
    return frames


def check_state(name: str, state: Any, axes: int, width: int, needs: Requirements) -> Float32Array:
    """One part of the state, ``(..., width)`` of ``axes`` axes.

    Raises:
        ShapeError, DtypeError, InputError: It does not fit or is not finite.
    """
    try:
        values = float32(name, state)
    except ShapeError:
        raise needs.shape_error(name, f"an array (..., {width})", type(state).__name__) from None
    except DtypeError:
        got = getattr(state, "dtype", type(state).__name__)
        raise needs.dtype_error(name, "floating point values on the CPU", got) from None
    if values.ndim != axes or values.shape[-1] != width or 0 in values.shape:
        raise needs.shape_error(name, f"{axes} axes, the last of {width}", f"shape {values.shape}")
    if not np.isfinite(values).all():
        raise needs.input_error(name, "finite numbers", "NaN or infinity")
    return values


def check_batch(sizes: Mapping[str, int], needs: Requirements) -> int:
    """The batch size that all parts of an observation have.

    Raises:
        ShapeError: They differ.
    """
    if len(set(sizes.values())) != 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise needs.shape_error("observation", "the same batch size everywhere", listed)
    return next(iter(sizes.values()))


def views(cameras: Sequence[Camera], frames: Mapping[str, UInt8Array]) -> tuple[dict[str, UInt8Array], ...]:
    """The views of each observation, from frames ``(batch, time, height, width, 3)`` by camera."""
    ordered = {camera.name: frames[camera.name] for camera in cameras}
    places = view_places(ordered)
    return tuple(
        {view: frames[name][row, time] for view, (name, time) in places.items()}
        for row in range(len(frames[cameras[0].name]))
    )


def view_places(frames: Mapping[str, Any]) -> dict[str, tuple[str, int]]:
    """The camera and the time of each view, by its name, in the order of the prompt: by time before camera.

    Args:
        frames: Frames ``(batch, time, height, width, 3)`` by camera.

    Example:
        >>> view_places({"front": np.zeros((1, 2, 8, 8, 3), np.uint8)})
        {'front[0]': ('front', 0), 'front[1]': ('front', 1)}
    """
    horizon = next(iter(frames.values())).shape[1]
    return {
        name if horizon == 1 else f"{name}[{time}]": (name, time)
        for time in range(horizon)
        for name in frames
    }


def as_text(name: str, value: Any, needs: Requirements) -> str:
    """One instruction.

    Raises:
        InputError: It is not a string, or not valid Unicode.
    """
    if not isinstance(value, str):
        raise needs.input_error(name, "an instruction", repr(value))
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise needs.input_error(name, "valid Unicode", f"{value!r} ({error.reason})") from None
    return str(value)
