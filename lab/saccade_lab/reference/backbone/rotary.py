"""Rotary positions: of the language model on one or three axes, and of N1.7's vision tower on two."""

from collections.abc import Sequence

import torch
from torch import Tensor


def rotate(x: Tensor, angles: Tensor) -> Tensor:
    """Rotates the pairs ``(k, k + half)`` of the last axis.

    Args:
        x: ``(..., rows, 2 * half)``.
        angles: ``(..., rows, half)``, broadcast.
    """
    cos, sin = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
    first, second = x.chunk(2, dim=-1)
    return torch.cat((first * cos - second * sin, second * cos + first * sin), dim=-1)


def frequencies(theta: float, half: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``theta ** (-k / half)`` for k from 0, ``(half,)``, in float32 or wider."""
    exponents = torch.arange(half, dtype=torch.float64, device=device) / half
    return (theta**-exponents).to(torch.promote_types(dtype, torch.float32))


def text_angles(positions: Tensor, theta: float, half: int, dtype: torch.dtype) -> Tensor:
    """Angles of positions on one axis, ``(...)`` to ``(..., half)``."""
    inverse = frequencies(theta, half, dtype, positions.device)
    return positions[..., None].to(inverse.dtype) * inverse


def interleaved_angles(
    positions: Tensor, theta: float, half: int, sections: Sequence[int], dtype: torch.dtype
) -> Tensor:
    """Angles of positions on three axes (N1.7).

    Angle k uses the height axis if k mod 3 = 1, the width axis if k mod 3 = 2, for as many angles as the
    section of that axis has, and else the time axis.

    Args:
        positions: ``(3, ...)``: time, height, width.
        theta: Base of the frequencies.
        half: Number of angles.
        sections: Number of angles of each axis; they add up to ``half``.
        dtype: Dtype of the model.

    Returns:
        ``(..., half)``.
    """
    angles = text_angles(positions, theta, half, dtype)  # (3, ..., half)
    k = torch.arange(half, device=angles.device)
    mixed = angles[0]
    for axis in (1, 2):
        uses = (k % 3 == axis) & (k < 3 * sections[axis])  # (half,)
        mixed = torch.where(uses, angles[axis], mixed)
    return mixed


def grid_angles(rows: Tensor, columns: Tensor, half: int, dtype: torch.dtype) -> Tensor:
    """Angles of patches on a grid: half of them by row, half by column.

    Args:
        rows, columns: ``(patches,)``.
        half: Number of angles, even.
        dtype: Dtype of the model.

    Returns:
        ``(patches, half)``.
    """
    by_row = text_angles(rows, 10000.0, half // 2, dtype)
    by_column = text_angles(columns, 10000.0, half // 2, dtype)
    return torch.cat((by_row, by_column), dim=-1)
