"""msgpack with limits: a message is checked from end to end before anything is built from it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from saccade.errors import InputError, SaccadeError
from saccade.serve.limits import Limits
from saccade.serve.npy import Bytes, from_msgpack_numpy, from_npy, to_msgpack_numpy, to_npy

#: Bytes of a number, or of the length that follows, by the first byte.
NUMBERS = {0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}
BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
LISTS = {0xDC: 2, 0xDD: 4}
MAPS = {0xDE: 2, 0xDF: 4}
CONSTANTS = (0xC0, 0xC2, 0xC3)

NDARRAY = "__ndarray_class__"


@dataclass(frozen=True, eq=False)
class Message:
    """An unpacked message.

    Attributes:
        value: What it contains.
        is_msgpack_numpy: Whether it has arrays in the form of the package msgpack-numpy.
    """

    value: Any
    is_msgpack_numpy: bool


def pack(value: Any, *, as_msgpack_numpy: bool = False) -> bytes:
    """A message of dicts, lists, text, numbers and arrays.

    Args:
        value: What it contains.
        as_msgpack_numpy: Whether arrays are maps of the package msgpack-numpy, instead of bytes of a ``.npy``
            file.

    Raises:
        TypeError: It contains anything else.
    """
    plain = functools.partial(_plain, as_msgpack_numpy=as_msgpack_numpy)
    packed: bytes = msgpack.packb(value, default=plain)
    return packed


def unpack(data: Bytes, limits: Limits) -> Message:
    """The value in a message; its arrays share the memory of copies of parts of ``data``.

    Raises:
        InputError, DtypeError, ShapeError: This is not msgpack, is beyond a limit, or contains anything but
            maps with text as keys, lists, text, bytes, numbers and arrays.

    Example:
        >>> unpack(pack({"endpoint": "ping"}), Limits()).value
        {'endpoint': 'ping'}
    """
    check(memoryview(data), limits)
    foreign = False

    def hook(fields: dict[Any, Any]) -> Any:
        nonlocal foreign
        if NDARRAY in fields:
            return from_npy(fields.get("as_npy"), limits.array_elements)
        if b"nd" in fields or ("nd" in fields and "data" in fields):
            foreign = True
            return from_msgpack_numpy(fields, limits.array_elements)
        return fields

    try:
        value = msgpack.unpackb(data, object_hook=hook)
    except SaccadeError:
        raise
    except (msgpack.UnpackException, ValueError) as error:
        raise InputError(f"message: {error}") from None
    return Message(value, foreign)


def check(data: memoryview, limits: Limits) -> None:
    """Checks the structure of a message without building anything.

    Raises:
        InputError: The message is empty, cut off, longer than its value, nested too deeply, has too many
            values, or contains a type that no request contains.
    """
    if not len(data):
        raise InputError("message: empty, expected a msgpack map")
    remaining = [1]  # the values that are still to come, by depth
    position = objects = 0
    while remaining:
        if not remaining[-1]:
            remaining.pop()
            continue
        remaining[-1] -= 1
        objects += 1
        if objects > limits.objects:
            raise InputError(f"message: expected at most {limits.objects} values")
        position, items = _value(data, position)
        if items is not None:
            if len(remaining) > limits.depth:
                raise InputError(f"message: expected a nesting of at most {limits.depth}")
            remaining.append(items)
    if position != len(data):
        raise InputError(f"message: expected one msgpack value, got {len(data) - position} bytes after it")


def _value(data: memoryview, position: int) -> tuple[int, int | None]:
    """Where a value ends, or its first item begins, and the number of its items if it is a container."""
    if position >= len(data):
        raise InputError(f"message: cut off after {len(data)} bytes")
    first = data[position]
    position += 1
    items = None
    if first <= 0x7F or first >= 0xE0 or first in CONSTANTS:
        return position, None
    if first <= 0x8F:
        items = 2 * (first & 0x0F)
    elif first <= 0x9F:
        items = first & 0x0F
    elif first <= 0xBF:
        position += first & 0x1F
    elif first in NUMBERS:
        position += NUMBERS[first]
    else:
        width = BYTES.get(first) or LISTS.get(first) or MAPS.get(first)
        if width is None:
            raise InputError(f"message: expected no msgpack extension, got type {first:#x}")
        length = int.from_bytes(data[position : position + width], "big")
        position += width
        if first in BYTES:
            position += length
        else:
            items = length if first in LISTS else 2 * length
    # Each item has a byte at least, so a list that claims more is cut off.
    if position + (items or 0) > len(data):
        raise InputError(f"message: cut off after {len(data)} bytes")
    return position, items


def _plain(value: Any, as_msgpack_numpy: bool) -> Any:
    if isinstance(value, np.ndarray):
        if as_msgpack_numpy:
            return to_msgpack_numpy(value)
        return {NDARRAY: True, "as_npy": to_npy(value)}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"message: cannot contain {type(value).__name__}")
