"""Refuses arrays and indices that do not fit, with what was given and what was expected."""

from collections.abc import Iterable

from torch import Tensor

from saccade.errors import InputError, ShapeError


def check_shape(name: str, tensor: Tensor, expected: tuple[int | None, ...]) -> None:
    """Refuses a tensor of another shape; None stands for any size."""
    given = tuple(tensor.shape)
    if len(given) == len(expected) and all(
        want in (None, have) for have, want in zip(given, expected, strict=True)
    ):
        return
    wanted = ", ".join("any" if size is None else str(size) for size in expected)
    raise ShapeError(f"{name}: shape {given}, expected ({wanted})")


def check_indices(name: str, indices: Iterable[int] | None, size: int) -> None:
    """Refuses indices that are not below `size`; None stands for all of them."""
    for index in indices or ():
        if index >= size:
            expected = f"0 to {size - 1}" if size > 0 else "no index, for there is nothing to choose from"
            raise InputError(f"{name}: {index}, expected {expected}")
