"""What a backbone takes, from frames on its device and prompts."""

# Some methods of tensors are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from saccade_lab.reference import Backbone
from saccade_lab.reference.backbone import PreparedInputs
from saccade_lab.reference.backbone.model import Eagle
from saccade_lab.training.frames import N17_MERGE, N17_PATCH, N17_REPEATS, PIXEL_CENTRE, padded


def shifted(views: Tensor, moves: Tensor, largest: int) -> Tensor:
    """Views shifted by whole numbers of pixels; edges are repeated.

    Args:
        views: ``(V, 3, H, W)``.
        moves: Pixels by which what is seen begins further down and to the right, ``(V, 2)``.
        largest: What no move exceeds in either direction.

    Example:
        >>> view = torch.arange(4).reshape(1, 1, 2, 2)
        >>> shifted(view, torch.tensor([[1, 0]]), 1).tolist()
        [[[[2, 3], [2, 3]]]]
    """
    height, width = views.shape[2:]
    above, below = (views[:, :, row : row + 1].expand(-1, -1, largest, -1) for row in (0, height - 1))
    wider = torch.cat((above, views, below), dim=2)
    left, right = (wider[..., column : column + 1].expand(-1, -1, -1, largest) for column in (0, width - 1))
    places = torch.cat((left, wider, right), dim=3).unfold(2, height, 1).unfold(3, width, 1)
    first = moves + largest
    return places[torch.arange(len(views), device=views.device), :, first[:, 0], first[:, 1]]


def prepared_inputs(
    backbone: Backbone, images: Tensor, prompts: Sequence[npt.NDArray[np.int64]], length: int = 0
) -> PreparedInputs:
    """What a backbone takes.

    Args:
        backbone: The backbone.
        images: Frames as ``frames.prepared`` returns them, ``(B, cameras, 3, H, W)`` uint8.
        prompts, length: See ``frames.padded``.

    Raises:
        ShapeError, InputError: As ``Backbone.prepare``.
    """
    # As a tensor: a GPU multiplies by the inverse of a number, which rounds otherwise.
    centre = torch.full((), float(PIXEL_CENTRE), device=images.device)
    # In place, and before patches repeat each frame: it is a large part of a training step.
    views = images.flatten(0, 1).to(torch.float32, copy=True).sub_(centre).div_(centre)
    core = backbone.core
    if isinstance(core, Eagle):
        shown, grids = views, core.grids(views)
    else:
        shown, grids = patches(views), [grid_of(views)] * len(views)
    return backbone.with_prompts([shown], grids, *padded(prompts, length))


def grid_of(views: Tensor) -> tuple[int, int]:
    """Rows and columns of N1.7's patches in views ``(V, 3, H, W)``."""
    return views.shape[2] // N17_PATCH, views.shape[3] // N17_PATCH


def patches(views: Tensor) -> Tensor:
    """``(V, 3, H, W)`` to N1.7's patches, ``(V * patches, 3 * repeats * patch**2)``, square after square."""
    down, across = ((pixels // (N17_MERGE * N17_PATCH), N17_MERGE, N17_PATCH) for pixels in views.shape[2:])
    squares = views.unflatten(3, across).unflatten(2, down)  # (V, 3, down, patches, y, right, patches, x)
    ordered = squares.permute(0, 2, 5, 3, 6, 1, 4, 7)  # (V, down, right, patches, patches, 3, y, x)
    once = ordered.reshape(-1, views.shape[1], 1, N17_PATCH**2)
    return once.expand(-1, -1, N17_REPEATS, -1).flatten(1)
