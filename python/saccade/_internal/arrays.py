"""Converts arguments to the arrays of the engine, and results to NumPy or torch like the arguments.

Errors name the argument. A DtypeError says that numbers are of another kind, or that a tensor is not dense or
not on the CPU; a ShapeError that something is no array, or has another shape; an InputError that an integer,
text or index is something else or out of range.
"""

from __future__ import annotations

import math
import numbers
import operator
import sys
from collections.abc import Collection, Mapping, Sequence, Set
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from saccade.errors import DtypeError, InputError, ShapeError

if TYPE_CHECKING:
    import torch

    Tensor: TypeAlias = torch.Tensor

#: As dtypes: a comparison with the type `np.float32` makes a dtype each time.
FLOAT32 = np.dtype(np.float32)
INT64 = np.dtype(np.int64)
UINT8 = np.dtype(np.uint8)

#: The precisions that weights are loaded in.
PRECISIONS = ("float32", "bfloat16", "int8", "int4")

#: What else decides how a policy is loaded: arguments of ``Policy.from_pretrained``, and flags.
LOADING_OPTIONS = (
    "embodiment",
    "preprocessing",
    "tokenizer",
    "data_config",
    "action_horizon",
    "processor_options",
)

#: The largest number that the engine computes with, float32's.
LARGEST = float(np.finfo(np.float32).max)

#: No head has as many tokens. A larger range is refused, since it would be slow to write out.
LARGEST_RANGE = 1 << 20

Float32Array: TypeAlias = npt.NDArray[np.float32]
Float64Array: TypeAlias = npt.NDArray[np.float64]
UInt8Array: TypeAlias = npt.NDArray[np.uint8]
#: A tensor as the engine takes it: float32, or the name of a 16-bit type and the bits.
StoredTensor: TypeAlias = "Float32Array | tuple[str, npt.NDArray[np.uint16]]"
#: Array arguments: NumPy arrays of any strides, torch CPU tensors, or nested sequences of floats.
ArrayLike: TypeAlias = "npt.ArrayLike | Tensor"
#: Results: float32, NumPy or torch like the features that they were computed from.
Array: TypeAlias = "Float32Array | Tensor"


def is_torch(value: object) -> bool:
    """Whether ``value`` is a torch tensor. Does not import torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def float32(name: str, value: ArrayLike) -> Float32Array:
    """``value`` as a C-contiguous float32 array. It is not copied if it is one already.

    float64, float16 and bfloat16 are converted. A value beyond the range of float32 becomes infinite, which
    the engine refuses.
    """
    if is_torch(value):
        value = _torch_floats(name, value, "float32")
    array = _asarray(name, value)
    # The case of a control loop. The rest takes a microsecond or two, as long as all other checks of a call.
    if array.dtype == FLOAT32 and array.flags.carray:
        return cast("Float32Array", array)
    # bfloat16 of the ml_dtypes package is of kind "V".
    if array.dtype.kind != "f" and array.dtype.name != "bfloat16":
        raise DtypeError(f"{name}: expected floating point values, got {array.dtype}")
    with np.errstate(over="ignore"):
        return np.require(array, np.float32, ["C", "A"])


def float64(name: str, value: ArrayLike) -> Float64Array:
    """``value`` as a C-contiguous float64 array; integers are converted too."""
    if is_torch(value) and value.dtype.is_floating_point:  # type: ignore[union-attr]
        value = _torch_floats(name, value, "float64")
    array = _asarray(name, value)
    if array.dtype.kind not in "iuf" and array.dtype.name != "bfloat16":
        raise DtypeError(f"{name}: expected numbers, got {array.dtype}")
    return np.require(array, np.float64, ["C", "A"])


def _torch_floats(name: str, tensor: Any, dtype: str) -> npt.NDArray[Any]:
    if not tensor.dtype.is_floating_point:
        raise DtypeError(f"{name}: expected floating point values, got {tensor.dtype}")
    return _torch_memory(name, tensor, getattr(sys.modules["torch"], dtype))


def exact_float32(name: str, value: ArrayLike) -> Float32Array:
    """As `float32`, for numbers in a robot's units: integers are taken if float32 holds them exactly."""
    if isinstance(value, np.ma.MaskedArray):
        raise DtypeError(f"{name}: expected an array without a mask, got {type(value).__name__}")
    if is_torch(value) and (value.is_floating_point() or value.is_complex() or value.is_sparse):  # type: ignore[union-attr]
        return float32(name, value)
    array = _asarray(name, value)
    if array.dtype.kind not in "iu":
        return float32(name, array)
    wrong = inexact(array)
    if wrong is not None:
        raise DtypeError(
            f"{name}: expected numbers that float32 holds exactly, got {array.dtype} {wrong}: convert with "
            "astype(np.float32)"
        )
    return np.require(array, np.float32, ["C", "A"])


def inexact(integers: Any) -> int | None:
    """The first of an array's integers that float32 does not hold exactly, or None."""
    array = np.asarray(integers)
    if array.dtype.kind not in "iu":
        return None
    # As Python's numbers, which compare integers and floats exactly.
    wrong = array[array.astype(np.float32).astype(object) != array.astype(object)]
    return int(wrong.flat[0]) if wrong.size else None


def frame(name: str, value: ArrayLike) -> npt.NDArray[Any]:
    """A camera frame as a C-contiguous array of uint8, float32 or float64, copied only if it must be."""
    if type(value) is np.ndarray and value.dtype == UINT8 and value.flags.c_contiguous:
        return value  # the case of a control loop
    array = _asarray(name, value)
    if array.dtype not in (np.uint8, np.float32, np.float64):
        raise DtypeError(f"{name}: expected a frame of uint8, float32 or float64, got {array.dtype}")
    return np.require(array, requirements=["C", "A"])


def as_stored(tensors: Mapping[str, ArrayLike]) -> dict[str, StoredTensor]:
    """Tensors in their own dtype, C-contiguous. Those that are contiguous already are not copied.

    Raises:
        DtypeError: ``tensors`` is not a mapping of names to arrays of float32, bfloat16 or float16 on the
            CPU. The message lists every problem.
        InputError: A name is not valid Unicode.
    """
    if not isinstance(tensors, Mapping):
        raise DtypeError(f"tensors: expected a mapping of names to arrays, got {type(tensors).__name__}")
    found, problems = {}, []
    for name, tensor in tensors.items():
        try:
            if not isinstance(name, str):
                raise DtypeError(f"{name!r}: expected a name, got {type(name).__name__}")
            text("tensors", name)
            found[name] = _as_stored(name, tensor)
        except DtypeError as error:
            problems.append(str(error))
    if problems:
        raise DtypeError("tensors: " + "\n  ".join(problems))
    return found


def _as_stored(name: str, tensor: Any) -> StoredTensor:
    if is_torch(tensor):
        dtype = str(tensor.dtype).removeprefix("torch.")
    elif isinstance(tensor, np.ndarray):
        dtype = tensor.dtype.name
    else:
        raise DtypeError(f"{name}: expected an array, got {type(tensor).__name__}")
    if dtype not in ("float32", "bfloat16", "float16"):
        raise DtypeError(f"{name}: expected float32, bfloat16 or float16, got {dtype}")
    if is_torch(tensor):
        torch = sys.modules["torch"]
        if tensor.layout != torch.strided:
            raise DtypeError(f"{name}: expected a dense tensor, got one of layout {tensor.layout}")
        tensor = tensor.detach()
        # NumPy has no bfloat16: its bits pass as integers.
        tensor = _torch_memory(name, tensor.view(torch.int16) if dtype == "bfloat16" else tensor)
    if dtype == "bfloat16":
        return dtype, np.require(tensor, requirements=["C", "A"]).view(np.uint16)
    if dtype == "float16":
        return dtype, np.require(tensor, np.float16, ["C", "A"]).view(np.uint16)
    return np.require(tensor, np.float32, ["C", "A"])


def text(name: str, value: Any) -> str:
    """``value`` as text that the engine can take."""
    if not isinstance(value, str):
        raise InputError(f"{name}: expected a string, got {value!r} ({type(value).__name__})")
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{name}: expected valid Unicode, got {value!r} ({error.reason})") from None
    return value


def check_precision(precision: str) -> None:
    """Checks that ``precision`` is text. The engine checks which text."""
    if not isinstance(precision, str):
        raise InputError(
            f"precision: expected one of {str(PRECISIONS)[1:-1]}, got {precision!r} "
            f"({type(precision).__name__})"
        )
    text("precision", precision)


def boolean(name: str, value: ArrayLike | None) -> npt.NDArray[np.bool_] | None:
    """``value`` as a C-contiguous boolean array. None stays None.

    A view of other memory may have bytes that are neither 0 nor 1. They count as True, as they do in NumPy.
    """
    if value is None:
        return None
    array = _asarray(name, value)
    if array.dtype != np.bool_:
        raise DtypeError(f"{name}: expected booleans, got {array.dtype}")
    return np.require(array.view(np.uint8) != 0, np.bool_, ["C", "A"])


def mask_bytes(name: str, value: ArrayLike | None) -> UInt8Array | None:
    """:func:`boolean` as bytes for the engine, since not every byte of NumPy is a boolean of Rust."""
    array = boolean(name, value)
    return None if array is None else array.view(np.uint8)


def int64(name: str, value: ArrayLike | int) -> npt.NDArray[np.int64]:
    """One or several integers as a C-contiguous int64 array."""
    try:
        array = _asarray(name, value)
    except ShapeError as error:
        raise InputError(str(error)) from None
    if array.dtype == INT64 and array.flags.carray:
        return cast("npt.NDArray[np.int64]", array)
    if array.dtype.kind not in "iu":
        shown = repr(value) if array.ndim == 0 else f"an array of {array.dtype}"
        raise InputError(f"{name}: expected an integer or an array of integers, got {shown}")
    if array.dtype.kind == "u" and array.size and int(array.max()) > np.iinfo(np.int64).max:
        raise InputError(f"{name}: expected integers that fit in 64 bits, got {array.max()}")
    # ascontiguousarray would give a scalar an axis.
    return np.require(array, np.int64, ["C", "A"])


def optional_integers(name: str, values: Sequence[int] | None) -> list[int] | None:
    """A sequence of integers as a list. None stays None."""
    if values is None:
        return None
    try:
        is_empty = len(values) == 0
    except OverflowError:  # a range of more numbers than 64 bits count
        raise InputError(f"{name}: expected at most {LARGEST_RANGE} integers, got {values!r}") from None
    except TypeError:
        raise InputError(f"{name}: expected a sequence of integers, such as [0], got {values!r}") from None
    # NumPy would write a range out, however long it is.
    if isinstance(values, range) and len(values) > LARGEST_RANGE:
        raise InputError(f"{name}: expected at most {LARGEST_RANGE} integers, got {values!r}")
    # NumPy takes an empty list for one of floats.
    return [] if is_empty else int64(name, values).reshape(-1).tolist()


def integer(name: str, value: int, least: int = 1) -> int:
    """``value`` as an integer of at least ``least``."""
    try:
        if isinstance(value, (bool, np.bool_)):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise InputError(f"{name}: expected an integer, got {value!r}") from None
    # The engine counts in 64 bits.
    if number < least:
        raise InputError(f"{name}: expected at least {least}, got {number}")
    if number >= 2**63:
        raise InputError(f"{name}: expected a number below 2**63, got {number}")
    return number


def real(value: object) -> float:
    """A number, of Python or NumPy, as a float: infinity if none can hold it, NaN for what is no number."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def indices(name: str, value: Any) -> tuple[int, ...] | None:
    """One or several distinct indices in the order given; those of a set ascending. None stays None."""
    if value is None:
        return None
    if isinstance(value, (str, bytes)):
        raise InputError(f"{name}: expected an index or several, got {value!r}")
    if (
        isinstance(value, range)
        and value
        and (min(value[0], value[-1]) < 0 or max(value[0], value[-1]) >= LARGEST_RANGE)
    ):
        raise InputError(f"{name}: expected indices of 0 to {LARGEST_RANGE - 1}, got {value!r}")
    unordered = isinstance(value, Set)
    if isinstance(value, Collection) and not is_torch(value) and not isinstance(value, np.ndarray):
        value = list(value)
        if not value:
            return ()
    array = np.atleast_1d(int64(name, value))
    if array.ndim > 1:
        raise InputError(f"{name}: expected one row of indices, got shape {array.shape}")
    distinct, counts = np.unique(array, return_counts=True)
    if len(distinct) and distinct[0] < 0:
        raise InputError(f"{name}: expected indices of at least 0, got {distinct[0]}")
    if len(distinct) < len(array):
        raise InputError(f"{name}: expected distinct indices, got {distinct[counts > 1][0]} more than once")
    return tuple((distinct if unordered else array).tolist())


def result(shape: tuple[int, ...], out: ArrayLike | None) -> Float32Array:
    """The array that a result of this shape is written to: a new one, or the memory of ``out``.

    Raises:
        DtypeError: ``out`` is not a float32 array on the CPU.
        ShapeError: ``out`` has another shape.
        InputError: ``out`` cannot be written to, or is not C-contiguous.
        MemoryError: There is no memory for a new array.
    """
    if out is None:
        try:
            return np.empty(shape, np.float32)
        except (MemoryError, ValueError):
            raise does_not_fit("a result", shape) from None
    array: Any = out
    if is_torch(out):
        if out.requires_grad:  # type: ignore[union-attr]
            raise InputError("out: expected a tensor that does not require a gradient")
        array = _torch_memory("out", out)
    if not isinstance(array, np.ndarray):
        raise DtypeError(f"out: expected a float32 array, got {type(out).__name__}")
    if array.dtype != FLOAT32:
        raise DtypeError(f"out: expected float32, got {array.dtype}")
    if array.shape != shape:
        raise ShapeError(f"out: expected {shape}, got {array.shape}")
    if not array.flags.carray:  # C-contiguous, writable and aligned
        raise InputError("out: expected a writable, C-contiguous array")
    return array


def does_not_fit(what: str, shape: tuple[int, ...]) -> MemoryError:
    """The error for a float32 array that cannot be allocated."""
    nbytes = 4 * math.prod(shape)
    size = f"{nbytes / 1e9:,.1f} GB" if nbytes >= 1e9 else f"{nbytes / 1e6:.1f} MB"
    return MemoryError(f"{what} of shape {shape} ({size}) does not fit in memory")


def apart(array: Float32Array, output: Float32Array) -> Float32Array:
    """``array``, or a copy of it if it may share memory with the output."""
    # The case of a control loop: two arrays, each of which owns its memory.
    if array is not output and array.flags.owndata and output.flags.owndata:
        return array
    return array.copy() if np.may_share_memory(array, output) else array


def like_features(array: npt.NDArray[Any], use_torch: bool) -> Array:
    """``array``, or a torch tensor that shares its memory."""
    return cast("Array", sys.modules["torch"].from_numpy(array)) if use_torch else array


def _asarray(name: str, value: Any) -> npt.NDArray[Any]:
    """``value`` as an array, which shares the memory of an array or a tensor."""
    if is_torch(value):
        return _torch_memory(name, value)
    try:
        return np.asarray(value)
    except OverflowError as error:
        raise InputError(f"{name}: {error}") from None
    except (TypeError, ValueError, RuntimeError) as error:
        raise ShapeError(f"{name}: expected an array, got {type(value).__name__} ({error})") from None


def _torch_memory(name: str, tensor: Any, dtype: Any = None) -> npt.NDArray[Any]:
    if tensor.device.type != "cpu":
        raise DtypeError(f"{name}: expected a tensor on the CPU, got one on {tensor.device}")
    tensor = tensor.detach()
    try:
        return (tensor if dtype is None else tensor.to(dtype)).numpy()  # type: ignore[no-any-return]
    except (TypeError, RuntimeError) as error:
        raise DtypeError(f"{name}: expected a dense tensor that NumPy can hold: {error}") from None
