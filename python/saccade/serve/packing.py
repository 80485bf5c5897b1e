"""Messages: msgpack with arrays, within limits. Pickles of old clients are never loaded, and answered."""

from __future__ import annotations

import io
import pickle
import zipfile
from typing import Any, NamedTuple

import msgpack
import numpy as np

from saccade.errors import InputError, SaccadeError
from saccade.serve.limits import Limits
from saccade.serve.npy import Bytes, from_msgpack_numpy, from_npy, to_msgpack_numpy, to_npy

#: Items of one list or map.
MOST_ITEMS = 4096
NDARRAY = "__ndarray_class__"
#: How `torch.save` begins, which the clients of N1 and early N1.5 use: a zip file.
TORCH = b"PK\x03\x04"

REFUSAL = (
    "message: expected msgpack, got a pickle, which is never loaded: this client is of GR00T N1, or of N1.5 "
    "before 26 August 2025. Update it to Isaac-GR00T N1.5 with pull request 329 or later, N1.6 or N1.7"
)


class Message(NamedTuple):
    """An unpacked message, and whether it has arrays in the format of the package msgpack-numpy."""

    value: Any
    is_msgpack_numpy: bool


def pack(value: Any, *, as_msgpack_numpy: bool = False) -> bytes:
    """A message of dicts, lists, text, numbers and arrays, which go as ``.npy`` files or as msgpack-numpy's.

    Raises:
        TypeError: It contains anything else.
    """

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return to_msgpack_numpy(value) if as_msgpack_numpy else {NDARRAY: True, "as_npy": to_npy(value)}
        if isinstance(value, np.generic):
            return value.item()
        raise TypeError(f"message: cannot contain {type(value).__name__}")

    packed: bytes = msgpack.packb(value, default=plain)
    return packed


def unpack(data: Bytes, limits: Limits) -> Message:
    """The value in a message; its arrays share the memory of copies of parts of ``data``.

    msgpack bounds every list and map to `MOST_ITEMS` before it is built, and refuses extensions and a nesting
    deeper than its own stack (1024). It does not bound the number of values: lists and maps are counted as
    they are completed, because one byte of a message can become a list of 70.

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

    def refuse_extension(code: int, data: bytes) -> Any:
        raise InputError(f"message: expected no msgpack extension, got type {code}")

    try:
        value = msgpack.unpackb(
            data,
            object_hook=object_hook,
            list_hook=list_hook,
            ext_hook=refuse_extension,
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


def is_pickle(data: Bytes) -> bool:
    """Whether a message is a pickle of any protocol from 2 on, or a file of ``torch.save``.

    Example:
        >>> is_pickle(pickle.dumps({"endpoint": "ping"})), is_pickle(pack({"endpoint": "ping"}))
        (True, False)
    """
    start = bytes(memoryview(data)[:4])
    # As msgpack, a pickle would be an empty map with bytes after it.
    return start == TORCH or (len(data) > 2 and start[0] == 0x80 and 2 <= start[1] <= 5)


def refusal(data: Bytes) -> bytes:
    """The error for a client that sent a pickle, in a format that it can read.

    A client that uses ``torch.save`` gets what ``torch.load`` reads, so that its user sees the message.
    """
    error = {"error": REFUSAL}
    if bytes(memoryview(data)[:4]) != TORCH:
        return pack(error)
    output = io.BytesIO()
    with zipfile.ZipFile(output, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(error, protocol=2))
        archive.writestr("archive/version", "3\n")
    return output.getvalue()
