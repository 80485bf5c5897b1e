"""Messages: msgpack with arrays, within limits."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from saccade.errors import InputError, SaccadeError
from saccade.serve.limits import Limits
from saccade.serve.npy import Bytes, from_msgpack_numpy, from_npy, to_msgpack_numpy, to_npy

#: Items of one list or map.
MOST_ITEMS = 4096
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

    msgpack bounds every list and map to `MOST_ITEMS` before it is built, and refuses extensions and a nesting
    deeper than its own stack (1024). It does not bound the number of values: lists and maps are counted as
    they are completed, because one byte of a message can become a list of 70.

    Args:
        data: The message.
        limits: See there.

    Raises:
        InputError, DtypeError, ShapeError: This is not msgpack, is beyond a limit, or contains anything but
            maps with text as keys, lists, text, bytes, numbers and arrays.

    Example:
        >>> unpack(pack({"endpoint": "ping"}), Limits()).value
        {'endpoint': 'ping'}
    """
    foreign, left = False, limits.objects

    def count(values: int) -> None:
        nonlocal left
        left -= values
        if left < 0:
            raise InputError(f"message: expected at most {limits.objects} values")

    def list_hook(values: list[Any]) -> list[Any]:
        count(1 + len(values))
        return values

    def object_hook(fields: dict[Any, Any]) -> Any:
        nonlocal foreign
        count(1 + 2 * len(fields))
        if NDARRAY in fields:
            return from_npy(fields.get("as_npy"), limits.array_elements)
        if b"nd" in fields or ("nd" in fields and "data" in fields):
            foreign = True
            return from_msgpack_numpy(fields, limits.array_elements)
        return fields

    try:
        value = msgpack.unpackb(
            data,
            object_hook=object_hook,
            list_hook=list_hook,
            ext_hook=_refuse_extension,
            max_array_len=MOST_ITEMS,
            max_map_len=MOST_ITEMS,
            max_ext_len=0,
        )
    except SaccadeError:
        raise
    except msgpack.StackError:
        raise InputError("message: nested too deeply for msgpack") from None
    except (msgpack.UnpackException, ValueError) as error:
        raise InputError(f"message: {str(error) or 'not msgpack'}") from None
    return Message(value, foreign)


def _refuse_extension(code: int, data: bytes) -> Any:
    raise InputError(f"message: expected no msgpack extension, got type {code}")


def _plain(value: Any, as_msgpack_numpy: bool) -> Any:
    if isinstance(value, np.ndarray):
        if as_msgpack_numpy:
            return to_msgpack_numpy(value)
        return {NDARRAY: True, "as_npy": to_npy(value)}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"message: cannot contain {type(value).__name__}")
