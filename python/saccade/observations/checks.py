"""Checks that the observation formats share: frames, states, instructions, batch axes.

What does not fit is refused with an InputError, ShapeError or DtypeError, which lists what the robot needs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from saccade._internal.arrays import UINT8, Float32Array, UInt8Array, exact_float32, inexact, is_torch
from saccade._internal.warning import warn
from saccade.errors import DtypeError, ShapeError
from saccade.observations.requirements import Camera, Requirements

#: Key and width of each part of a state.
StateParts: TypeAlias = Sequence[tuple[str, int]]

NUMBERS = "floating point values, or integers that float32 holds exactly: convert with astype(np.float32)"


def find_cameras(
    prefix: str, given: Iterable[str], needs: Requirements, *, sort: bool
) -> list[tuple[Camera, str]]:
    """The cameras of an observation in the order of the prompt, each with the name that it has there.

    Cameras that the robot does not need are left out, unless it takes extra ones. With ``sort``, cameras that
    the checkpoint does not name are sorted by name.
    """
    names = list(given)
    chosen, missing = [], []
    for camera in needs.cameras or ():
        found = next((name for name in (camera.name, camera.alias) if name in names), None)
        if found is None:
            missing.append(camera.name)
        else:
            chosen.append((camera, found))
    if missing:
        keys = ", ".join(prefix + name for name in missing)
        expected = ", ".join(camera.name for camera in needs.cameras or ())
        raise needs.input_error(keys, f"cameras {expected}", ", ".join(names) or "none")
    if not names:
        raise needs.input_error(f"{prefix}*", "at least one camera", "none")
    if needs.cameras is not None and not needs.takes_extra_cameras:
        return chosen
    listed = {name: camera for camera, name in chosen}
    ordered = sorted(names) if sort or needs.takes_extra_cameras else names
    return [(listed.get(name, Camera(name)), name) for name in ordered]


def on_cpu(name: str, value: Any, needs: Requirements) -> Any:
    """A torch tensor without its gradient, or anything else as it is."""
    if not is_torch(value):
        return value
    if value.device.type != "cpu":
        raise needs.dtype_error(name, "an array on the CPU", f"a tensor on {value.device}")
    return value.detach()


def check_frames(
    name: str, frames: Any, axes: tuple[int, ...], camera: Camera, needs: Requirements
) -> UInt8Array:
    """Frames of one camera, uint8 with colours last; ``axes`` are the numbers of axes that they may have."""
    frames = on_cpu(name, frames, needs)
    if is_torch(frames):
        frames = frames.numpy()
    if not isinstance(frames, np.ndarray) or frames.dtype != UINT8 or not _is_rgb(frames.shape, axes):
        shape = f"uint8 of {' or '.join(map(str, axes))} axes that end in (height, width, 3)"
        if not isinstance(frames, np.ndarray):
            raise needs.dtype_error(name, f"an array, {shape}", type(frames).__name__)
        if frames.dtype != UINT8:
            raise needs.dtype_error(name, shape, frames.dtype)
        raise needs.shape_error(name, shape, f"shape {frames.shape}")
    height, width = frames.shape[-3:-1]
    if camera.height is not None and (height, width) != (camera.height, camera.width):
        raise needs.shape_error(
            name, f"frames of {camera.height} x {camera.width} pixels", f"{height} x {width}"
        )
    return frames


def _is_rgb(shape: tuple[int, ...], axes: tuple[int, ...]) -> bool:
    return len(shape) in axes and shape[-1] == 3 and 0 not in shape


def shape_of(name: str, value: Any, needs: Requirements) -> tuple[int, ...]:
    """The shape of an array, a tensor or a nested list."""
    try:
        return tuple(value.shape) if hasattr(value, "shape") else np.shape(value)
    except (TypeError, ValueError):
        raise needs.shape_error(name, "an array", type(value).__name__) from None


def check_state(name: str, state: Any, axes: int, parts: StateParts, needs: Requirements) -> Float32Array:
    """One part of the state, or several side by side: ``(..., width)`` of ``axes`` axes."""
    width = sum(size for _, size in parts)
    shape_of(name, state, needs)
    try:
        values = exact_float32(name, on_cpu(name, state, needs))
    except (DtypeError, ShapeError):
        wrong = inexact(state)
        got = getattr(state, "dtype", type(state).__name__)
        raise needs.dtype_error(name, NUMBERS, got if wrong is None else f"{got} {wrong}") from None
    if values.ndim != axes or values.shape[-1] != width or 0 in values.shape:
        raise needs.shape_error(name, f"{axes} axes, the last of {width}", f"shape {values.shape}")
    if not np.isfinite(values).all():
        raise needs.input_error(name, "finite numbers", f"NaN or infinity in {_not_finite(values, parts)}")
    return values


def _not_finite(values: Float32Array, parts: StateParts) -> str:
    """The columns that are not finite, with the keys of their parts where there are several parts."""
    bad = np.flatnonzero(~np.isfinite(values).reshape(-1, values.shape[-1]).all(axis=0)).tolist()
    columns = f"column{'s' if len(bad) > 1 else ''} {', '.join(map(str, bad))}"
    if len(parts) == 1:
        return columns
    keys = [key for key, size in parts for _ in range(size)]
    return f"{columns} ({', '.join(dict.fromkeys(keys[column] for column in bad))})"


def check_batch(sizes: Mapping[str, int], needs: Requirements) -> None:
    """Checks that all parts of an observation have the same batch size."""
    if len(set(sizes.values())) != 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise needs.shape_error("observation", "the same batch size everywhere", listed)


def views(
    prefix: str, frames: Mapping[str, UInt8Array], horizon: int | None, needs: Requirements
) -> tuple[dict[str, UInt8Array], ...]:
    """The views of each row, from frames ``(batch, time, height, width, 3)`` by camera."""
    horizons = {name: found.shape[1] for name, found in frames.items()}
    wrong = [name for name, found in horizons.items() if horizon not in (None, found)]
    if wrong or len(set(horizons.values())) > 1:
        keys = ", ".join(prefix + name for name in wrong) or f"{prefix}*"
        listed = ", ".join(f"{name} {found}" for name, found in horizons.items())
        wanted = "as many of every camera" if horizon is None else str(horizon)
        raise needs.shape_error(f"{keys}: frames along the time axis", wanted, listed)
    check_batch({f"{prefix}{name}": len(found) for name, found in frames.items()}, needs)
    places = view_places(frames)
    return tuple(
        {view: frames[name][row, time] for view, (name, time) in places.items()}
        for row in range(len(next(iter(frames.values()))))
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


def as_list(value: Any) -> Any:
    """Lists, tuples and arrays as a list; anything else, and an array without axes, as what it is."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, (list, tuple)) else value


def as_text(name: str, value: Any, needs: Requirements) -> str:
    """One instruction."""
    if not isinstance(value, str):
        raise needs.input_error(name, "an instruction", repr(value))
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise needs.input_error(name, "valid Unicode", f"{value!r} ({error.reason})") from None
    return str(value)


def default_instructions(name: str, count: int, needs: Requirements) -> tuple[None, ...]:
    """The released default for this many observations, with a warning, where the release has one."""
    if needs.requires_language:
        raise needs.input_error(name, "an instruction", "none")
    warn(f"{name}: there is no instruction; the released default is used")
    return (None,) * count
