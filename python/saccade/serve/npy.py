"""Arrays as messages contain them: the bytes of a .npy file, or maps of msgpack-numpy; never a pickle."""

from __future__ import annotations

import functools
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.errors import DtypeError, InputError, ShapeError

#: NumPy writes its header in this form only, for the dtypes that are accepted. There is one way only to match
#: a text, so that the time is linear in its length.
HEADER = re.compile(
    rb"\{ *'descr': *'([<>|=]?[a-zA-Z]\d{0,9})', *'fortran_order': *(True|False), *"
    rb"'shape': *\(((?:-?\d{1,18} *, *)*(?:-?\d{1,18} *)?)\) *(?:, *)?\} *\n?"
)
MAGIC = b"\x93NUMPY"
#: Bytes before the header, by version of the format.
START = {1: 10, 2: 12, 3: 12}
#: NumPy refuses longer headers too.
LONGEST_HEADER = 10_000
MOST_AXES = 32

#: Names of dtypes as NumPy writes them: booleans, integers, floating point numbers and text.
DTYPE = re.compile(r"[<>|=]?[biufU]\d{1,9}")
PICKLES = "arrays of objects contain pickles, which are never loaded"

Bytes = bytes | bytearray | memoryview


def to_npy(array: npt.NDArray[Any]) -> bytes:
    """The bytes of a ``.npy`` file of an array."""
    output = io.BytesIO()
    np.save(output, array, allow_pickle=False)
    return output.getvalue()


def from_npy(data: Any, most_elements: int) -> npt.NDArray[Any]:
    """The array in the bytes of a ``.npy`` file; it shares their memory.

    Args:
        data: The bytes.
        most_elements: A larger array is refused.

    Raises:
        InputError: This is no ``.npy`` file, or its array is too large or has a negative size.
        DtypeError: Its dtype is not a number, a boolean or text; arrays of objects contain pickles.
        ShapeError: The bytes are more or less than the array's.

    Example:
        >>> import numpy as np
        >>> from_npy(to_npy(np.arange(3)), most_elements=3)
        array([0, 1, 2])
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InputError(f"array: expected bytes, got {type(data).__name__}")
    view = memoryview(data)
    start = START.get(view[6] if len(view) > 6 else 0)
    if bytes(view[:6]) != MAGIC or start is None or len(view) < start:
        raise InputError("array: expected the bytes of a .npy file")
    length = int.from_bytes(view[8:start], "little")
    if length > min(LONGEST_HEADER, len(view) - start):
        raise InputError(f"array: header of {length} bytes, expected at most {LONGEST_HEADER}")
    layout = _header(bytes(view[start : start + length]))
    return _array(view[start + length :], layout, most_elements)


@functools.lru_cache(maxsize=256)  # a client's arrays have the same headers in every request
def _header(header: bytes) -> _Layout:
    found = HEADER.fullmatch(header)
    if found is None:
        raise DtypeError("array: expected a header of numbers, booleans or text, without fields")
    shape = tuple(int(size) for size in found[3].decode().replace(" ", "").split(",") if size)
    return _layout(found[1].decode(), shape, found[2] == b"True")


def to_msgpack_numpy(array: npt.NDArray[Any]) -> dict[bytes, Any]:
    """The map of the package msgpack-numpy for an array."""
    return {
        b"nd": True,
        b"type": array.dtype.str,
        b"kind": b"",
        b"shape": array.shape,
        b"data": array.tobytes(),
    }


def from_msgpack_numpy(fields: Mapping[Any, Any], most_elements: int) -> Any:
    """The array or number in a map of the package msgpack-numpy, which N1.7 clients send.

    Args:
        fields: The map, with ``nd``, ``type``, ``kind``, ``shape`` and ``data`` as text or bytes.
        most_elements: A larger array is refused.

    Raises:
        InputError, DtypeError, ShapeError: As :func:`from_npy`.
    """

    def field(name: str) -> Any:
        return fields.get(name.encode(), fields.get(name))

    kind = field("kind")
    if kind in (b"O", "O"):
        raise DtypeError(f"array: expected numbers, booleans or text, got objects: {PICKLES}")
    given = field("type")
    name = given.decode("ascii", "replace") if isinstance(given, bytes) else given
    data, shape = field("data"), field("shape") if field("nd") else []
    if not isinstance(name, str) or not isinstance(data, bytes) or kind not in (None, b"", ""):
        raise DtypeError("array: expected numbers, booleans or text, got another msgpack-numpy value")
    if not isinstance(shape, list) or not all(type(size) is int for size in shape):
        raise ShapeError(f"array: shape: expected a list of integers, got {shape!r:.100}")
    array = _array(memoryview(data), _layout(name, tuple(shape), False), most_elements)
    return array if field("nd") else array[()]


@dataclass(frozen=True)
class _Layout:
    """An array without its values, which is small however large the shape is."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    is_fortran: bool
    elements: int


def _layout(dtype_name: str, shape: tuple[int, ...], is_fortran: bool) -> _Layout:
    if dtype_name in ("O", "|O"):
        raise DtypeError(f"array: expected numbers, booleans or text, got objects: {PICKLES}")
    try:
        if DTYPE.fullmatch(dtype_name) is None:
            raise TypeError
        dtype = np.dtype(dtype_name)
    except (TypeError, ValueError):
        raise DtypeError(f"array: expected numbers, booleans or text, got {dtype_name!r:.100}") from None
    if len(shape) > MOST_AXES or any(size < 0 for size in shape):
        raise ShapeError(
            f"array: expected at most {MOST_AXES} axes of sizes of at least 0, got shape {shape!r:.100}"
        )
    return _Layout(dtype, shape, is_fortran, math.prod(shape))


def _array(data: memoryview, layout: _Layout, most_elements: int) -> npt.NDArray[Any]:
    dtype, shape, elements = layout.dtype, layout.shape, layout.elements
    if elements > most_elements:
        raise InputError(f"array: expected at most {most_elements} elements, got {elements} (shape {shape})")
    if elements * dtype.itemsize != len(data):
        raise ShapeError(
            f"array: expected {elements * dtype.itemsize} bytes for {dtype} of shape {shape}, got {len(data)}"
        )
    try:
        array = np.frombuffer(data, dtype) if elements else np.empty(shape, dtype)
        array = array.reshape(shape, order="F" if layout.is_fortran else "C")
    except ValueError as error:  # sizes beside a zero that NumPy cannot multiply
        raise ShapeError(f"array: shape {shape!r:.100}: {error}") from None
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))
