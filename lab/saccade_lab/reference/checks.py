"""Checks shapes, indices and embodiment ids."""

from collections.abc import Iterable

import numpy as np
import torch
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
    """Raises InputError unless all indices are below ``size``. None means all."""
    for index in indices or ():
        if index >= size:
            expected = f"0 to {size - 1}" if size > 0 else "no index, because there are no tokens"
            raise InputError(f"{name}: {index}, expected {expected}")


def as_embodiment(
    embodiment_id: int | Tensor | np.ndarray, batch: int, num_embodiments: int, device: torch.device
) -> int | Tensor:
    """Checks embodiment ids. One id stays an int, so that one matrix product serves the whole batch.

    Raises:
        InputError: They are not integers, or not below ``num_embodiments``.
        ShapeError: There is not one id for each row.
    """
    ids = embodiment_id if isinstance(embodiment_id, Tensor) else torch.tensor(embodiment_id)
    if ids.ndim > 0:
        check_shape("embodiment_id", ids, (batch,))
    if ids.is_floating_point() or ids.dtype == torch.bool:
        raise InputError(f"embodiment_id: {ids.dtype}, expected integers")
    if ids.numel() and not 0 <= int(ids.min()) <= int(ids.max()) < num_embodiments:
        raise InputError(f"embodiment_id: {ids.tolist()}, expected 0 to {num_embodiments - 1}")
    return int(ids) if ids.ndim == 0 else ids.to(dtype=torch.long, device=device)


def can_be_read(tensor: Tensor) -> bool:
    """Whether the values of a tensor can be looked at: not while they are recorded as a CUDA graph."""
    return not (tensor.is_cuda and torch.cuda.is_current_stream_capturing())
