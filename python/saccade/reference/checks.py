"""Checks shapes and indices."""

from collections.abc import Iterable

from torch import Tensor

from saccade.errors import InputError, ShapeError


def check_shape(name: str, tensor: Tensor, expected: tuple[int | None, ...]) -> None:
    """Raises ShapeError unless the tensor has the expected shape. None allows any size."""
    given = tuple(tensor.shape)
    if len(given) == len(expected) and all(
        want in (None, have) for have, want in zip(given, expected, strict=True)
    ):
        return
    wanted = ", ".join("any" if size is None else str(size) for size in expected)
    raise ShapeError(f"{name}: shape {given}, expected ({wanted})")


def check_indices(name: str, indices: Iterable[int] | None, size: int) -> None:
    """Raises InputError unless all indices are below `size`. None means all."""
    for index in indices or ():
        if index >= size:
            expected = f"0 to {size - 1}" if size > 0 else "no index, because there are no tokens"
            raise InputError(f"{name}: {index}, expected {expected}")
