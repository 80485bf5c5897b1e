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

#: Bytes of a number, or of the length that follows, by the first byte of a value.
NUMBERS = {0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}
BYTES = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
LISTS = {0xDC: 2, 0xDD: 4}
MAPS = {0xDE: 2, 0xDF: 4}
CONSTANTS = (0xC0, 0xC2, 0xC3)


def _kind(first: int) -> tuple[int, int, int | None]:
    """What the first byte of a value says.

    Returns:
        The bytes until the value's contents or end, 0 for a type that is refused; how many of them are a
        length; and the items of a container, those of each unit of the length if there is one, else None.
    """
    if first <= 0x7F or first >= 0xE0 or first in CONSTANTS:
        return 1, 0, None
    if first <= 0x8F:
        return 1, 0, 2 * (first & 0x0F)
    if first <= 0x9F:
        return 1, 0, first & 0x0F
    if first <= 0xBF:
        return 1 + (first & 0x1F), 0, None
    if first in NUMBERS:
        return 1 + NUMBERS[first], 0, None
    width = BYTES.get(first) or LISTS.get(first) or MAPS.get(first) or 0
    return (1 + width if width else 0), width, None if first in BYTES or not width else 1 + (first in MAPS)


LENGTHS, WIDTHS, ITEMS = zip(*map(_kind, range(256)), strict=True)

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
    size = len(data)
    if not size:
        raise InputError("message: empty, expected a msgpack map")
    outer: list[int] = []  # the values that are still to come, by depth, of the containers around this one
    remaining, objects, position = 1, 1, 0
    while True:
        while not remaining:
            if not outer:
                if position != size:
                    raise InputError(
                        f"message: expected one msgpack value, got {size - position} bytes after it"
                    )
                return
            remaining = outer.pop()
        remaining -= 1
        if position >= size:
            raise _cut_off(size)
        first = data[position]
        position += LENGTHS[first]
        items = ITEMS[first]
        width = WIDTHS[first]
        if width:
            length = int.from_bytes(data[position - width : position], "big")
            if items is None:
                position += length
            else:
                items *= length
        elif not LENGTHS[first]:
            raise InputError(f"message: expected no msgpack extension, got type {first:#x}")
        # Each item has a byte at least, so a list that claims more is cut off.
        if position + (items or 0) > size:
            raise _cut_off(size)
        if items is not None:
            objects += items
            if objects > limits.objects:
                raise InputError(f"message: expected at most {limits.objects} values")
            if len(outer) >= limits.depth:
                raise InputError(f"message: expected a nesting of at most {limits.depth}")
            outer.append(remaining)
            remaining = items


def _cut_off(size: int) -> InputError:
    return InputError(f"message: cut off after {size} bytes")


def _plain(value: Any, as_msgpack_numpy: bool) -> Any:
    if isinstance(value, np.ndarray):
        if as_msgpack_numpy:
            return to_msgpack_numpy(value)
        return {NDARRAY: True, "as_npy": to_npy(value)}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"message: cannot contain {type(value).__name__}")
