"""What Isaac-GR00T's two forms share: frames and states with a time axis, and rows of text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array, UInt8Array, float32
from saccade.errors import InputError, ShapeError
from saccade.observations.checks import (
    as_text,
    check_batch,
    check_frames,
    check_horizons,
    check_state,
    find_cameras,
    shape_of,
    views,
)
from saccade.observations.requirements import Requirements


def read_frames(
    prefix: str, given: Mapping[str, Any], is_batched: bool, needs: Requirements
) -> tuple[dict[str, UInt8Array], ...]:
    """The views of each observation.

    Args:
        prefix: What the keys begin with, for messages.
        given: Frames by camera, ``(batch, time, height, width, 3)``, or without batch.
        is_batched: Whether there is a batch axis.
        needs: What the robot needs.
    """
    cameras = find_cameras(prefix, given, needs, sort=False)
    frames = {}
    for camera, found in cameras:
        checked = check_frames(prefix + found, given[found], (5,) if is_batched else (4,), camera, needs)
        frames[camera.name] = checked if is_batched else checked[None]
    horizons = {name: found.shape[1] for name, found in frames.items()}
    check_horizons(prefix, horizons, needs.video_horizon, needs)
    check_batch({f"{prefix}{name}": len(found) for name, found in frames.items()}, needs)
    return views([camera for camera, _ in cameras], frames)


def is_batched(prefix: str, state: Mapping[str, Any], needs: Requirements) -> bool:
    """Whether the state has a batch axis: ``(batch, time, width)``.

    As Isaac-GR00T decides it, but by the parts that the robot needs. N1.5 looks at others too, and then fails
    if one of them lacks the axis.
    """
    shapes = {key: shape_of(prefix + key, value, needs) for key, value in state.items()}
    axes = {len(shape) for shape in shapes.values()}
    if len(axes) != 1 or not axes <= {2, 3}:
        listed = ", ".join(f"{key} {shape}" for key, shape in shapes.items())
        raise needs.shape_error(
            f"{prefix}*", "(batch, time, width) everywhere, or (time, width) everywhere", listed or "none"
        )
    return axes == {3}


def read_state(prefix: str, given: Mapping[str, Any], needs: Requirements) -> tuple[Float32Array, bool]:
    """The state ``(batch, state_history, state_width)``, and whether it had a batch axis.

    Args:
        prefix: What the keys begin with, for messages.
        given: Parts of the state by key, ``(batch, time, width)``, or without batch. Parts that the robot
            does not need are ignored, as in Isaac-GR00T.
        needs: What the robot needs.
    """
    missing = [key for key, _ in needs.state if key not in given]
    if missing:
        keys = ", ".join(prefix + key for key in missing)
        raise needs.input_error(keys, f"{', '.join(missing)} too", ", ".join(given) or "none")
    chosen = {key: given[key] for key, _ in needs.state}
    batched = is_batched(prefix, chosen, needs)
    parts = {}
    for key, width in needs.state:
        part = check_state(prefix + key, chosen[key], 3 if batched else 2, [(key, width)], needs)
        parts[key] = part if batched else part[None]
        if parts[key].shape[1] != needs.state_history:
            raise needs.shape_error(
                f"{prefix}{key}", f"{needs.state_history} along the time axis", f"shape {part.shape}"
            )
    check_batch({f"{prefix}{key}": len(part) for key, part in parts.items()}, needs)
    return np.concatenate(list(parts.values()), axis=-1), batched


def read_texts(name: str, rows: Any, needs: Requirements) -> tuple[tuple[str, ...], bool]:
    """The instruction of each row, and whether all were given as plain strings.

    Args:
        name: The key, for messages.
        rows: A list, tuple or array with a string, or a list of one string, for each row.
        needs: What the robot needs.
    """
    given = listed(rows)
    if not isinstance(given, list):
        raise needs.input_error(name, "one instruction for each row of the batch", repr(rows))
    found, plain = [], []
    for row in given:
        text = listed(row)
        plain.append(not isinstance(text, list))
        if isinstance(text, list):
            if len(text) != 1:
                raise needs.input_error(name, "one instruction for each observation", repr(row))
            text = text[0]
        found.append(as_text(name, text, needs))
    if len(set(plain)) > 1:
        raise needs.input_error(name, "strings only, or lists of one string only", repr(rows))
    return tuple(found), all(plain)


def listed(value: Any) -> Any:
    """Lists, tuples and arrays as a list; anything else, and an array without axes, as what it is."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, (list, tuple)) else value


def answer(parts: Mapping[str, Float32Array], prefix: str, is_batched: bool) -> dict[str, Float32Array]:
    """Actions by key, without the batch axis if the observation had none."""
    return {f"{prefix}{key}": part if is_batched else part[0] for key, part in parts.items()}


def joined(answer: Any, prefix: str, keys: tuple[str, ...], needs: str) -> Any:
    """The inverse of `answer`: one array. Anything but a mapping is returned unchanged."""
    if not isinstance(answer, Mapping):
        return answer
    missing = [prefix + key for key in keys if prefix + key not in answer]
    if missing:
        raise InputError(
            f"{needs}: expected actions {', '.join(prefix + key for key in keys)}, got {', '.join(answer)}"
        )
    parts = {key: float32(needs, answer[prefix + key]) for key in keys}
    shapes = {part.shape[:-1] if part.ndim else None for part in parts.values()}
    if len(shapes) != 1 or None in shapes:
        listed = ", ".join(f"{prefix}{key} {part.shape}" for key, part in parts.items())
        raise ShapeError(f"{needs}: expected actions of one number of rows and steps, got {listed}")
    return np.concatenate(list(parts.values()), axis=-1)
