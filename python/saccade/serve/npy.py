"""Arrays in messages: the bytes of a .npy file, or maps of msgpack-numpy; never a pickle."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy_format

from saccade.errors import DtypeError, InputError, ShapeError

#: A header of numbers with as many axes as NumPy has is shorter. It is parsed as a Python literal.
LONGEST_HEADER = 1024
HEADERS = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}
MOST_AXES = 32
#: Kinds of dtypes: booleans, integers, floating point numbers and text.
KINDS = "biufU"
#: Their names, as NumPy writes them.
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

    Raises:
        InputError: This is no ``.npy`` file, or its array is too large.
        DtypeError: Its dtype is not a number, a boolean or text; arrays of objects contain pickles.
        ShapeError: A size is negative, or the bytes are more or less than the array's.

    Example:
        >>> import numpy as np
        >>> from_npy(to_npy(np.arange(3)), most_elements=3)
        array([0, 1, 2])
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InputError(f"array: expected bytes, got {type(data).__name__}")
    view = memoryview(data)
    start = io.BytesIO(view[: LONGEST_HEADER + 12])  # the magic and the length have at most 12 bytes
    try:
        read_header = HEADERS[npy_format.read_magic(start)]
        shape, is_fortran, dtype = read_header(start, max_header_size=LONGEST_HEADER)
    except Exception as error:  # whatever NumPy and Python's parser raise for hostile bytes
        raise InputError(
            f"array: expected the bytes of a .npy file of version 1 or 2: {error!r:.200}"
        ) from None
    return _array(view[start.tell() :], dtype, shape, most_elements, is_fortran=is_fortran)


def to_msgpack_numpy(array: npt.NDArray[Any]) -> dict[bytes, Any]:
    """The map of the package msgpack-numpy for an array."""
    layout = {b"nd": True, b"type": array.dtype.str, b"kind": b"", b"shape": array.shape}
    return {**layout, b"data": array.tobytes()}


def from_msgpack_numpy(fields: Mapping[Any, Any], most_elements: int) -> Any:
    """The same of a map of the package msgpack-numpy, whose keys are text or bytes; it may be a number."""
    names = ("nd", "type", "kind", "shape", "data")
    is_array, name, kind, shape, data = (fields.get(name.encode(), fields.get(name)) for name in names)
    if isinstance(name, bytes):
        name = name.decode("ascii", "replace")
    if kind in (b"O", "O") or name in ("O", "|O"):
        raise DtypeError(f"array: expected numbers, booleans or text, got objects: {PICKLES}")
    shape = shape if is_array else []
    if not isinstance(name, str) or not isinstance(data, bytes) or kind not in (None, b"", ""):
        raise DtypeError("array: expected numbers, booleans or text, got another msgpack-numpy value")
    if not isinstance(shape, list) or not all(type(size) is int for size in shape):
        raise ShapeError(f"array: shape: expected a list of integers, got {shape!r:.100}")
    try:
        if DTYPE.fullmatch(name) is None:
            raise TypeError
        dtype = np.dtype(name)
    except (TypeError, ValueError):
        raise DtypeError(f"array: expected numbers, booleans or text, got {name!r:.100}") from None
    array = _array(memoryview(data), dtype, tuple(shape), most_elements)
    return array if is_array else array[()]


def _array(
    data: memoryview,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    most_elements: int,
    *,
    is_fortran: bool = False,
) -> npt.NDArray[Any]:
    """The array of a layout, whose size is checked before anything is allocated."""
    if dtype.hasobject:
        raise DtypeError(f"array: expected numbers, booleans or text, got objects: {PICKLES}")
    if dtype.kind not in KINDS:
        raise DtypeError(f"array: expected numbers, booleans or text, got {str(dtype)!r:.100}")
    if len(shape) > MOST_AXES or any(size < 0 for size in shape):
        raise ShapeError(
            f"array: expected at most {MOST_AXES} axes of sizes of at least 0, got shape {shape!r:.100}"
        )
    elements = math.prod(shape)
    if elements > most_elements:
        raise InputError(f"array: expected at most {most_elements} elements, got shape {shape!r:.100}")
    if elements * dtype.itemsize != len(data):
        raise ShapeError(
            f"array: expected {elements * dtype.itemsize} bytes for {dtype} of shape {shape!r:.100}, got "
            f"{len(data)}"
        )
    try:
        array = np.frombuffer(data, dtype) if len(data) else np.empty(shape, dtype)
        array = array.reshape(shape, order="F" if is_fortran else "C")
    except ValueError as error:  # sizes next to a zero that NumPy cannot multiply
        raise ShapeError(f"array: shape {shape!r:.100}: {error}") from None
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))
