"""Frames and prompts as training keeps and feeds them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from saccade.processor import Processor

PIXEL_CENTRE = np.float32(127.5)  # pixels are scaled as (u8 - 127.5) / 127.5
# Of N1.7's tower, which is made for videos.
N17_REPEATS = 2  # of a frame in its patches
N17_PATCH, N17_MERGE = 16, 2  # pixels along a patch, patches along a square; as published


def prepared(images: npt.NDArray[np.uint8], processor: Processor) -> npt.NDArray[np.uint8]:
    """Frames as the vision tower sees them, before they are scaled to [-1, 1].

    Args:
        images: ``(frames, cameras, H, W, 3)``, square.
        processor: Processor of the policy.

    Returns:
        ``(frames, cameras, 3, image_size, image_size)``.
    """
    views = np.stack([processor.frame(image) for image in images.reshape(-1, *images.shape[2:])])
    pixels = np.rint(views * PIXEL_CENTRE + PIXEL_CENTRE).astype(np.uint8)
    if processor.version == "n1.7":
        pixels = _joined(pixels)
    return np.asarray(pixels.reshape(*images.shape[:2], *pixels.shape[1:]), np.uint8)


def padded(
    prompts: Sequence[npt.NDArray[np.int64]], length: int = 0
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Prompts padded on the left, as the released processors do, and which tokens are not padding.

    Args:
        prompts: The token ids of each.
        length: Tokens to pad to at least. Default: those of the longest prompt.

    Returns:
        ``(B, T)`` each.

    Example:
        >>> ids, mask = padded([np.array([5, 6]), np.array([7])])
        >>> ids.tolist(), mask.tolist()
        ([[5, 6], [0, 7]], [[True, True], [False, True]])
    """
    length = max(length, *map(len, prompts))
    ids, mask = np.zeros((len(prompts), length), np.int64), np.zeros((len(prompts), length), np.bool_)
    for row, prompt in enumerate(prompts):
        ids[row, length - len(prompt) :], mask[row, length - len(prompt) :] = prompt, True
    return ids, mask


def _joined(patches: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """N1.7's patches of square views, ``(V, patches, values)``, as frames, ``(V, 3, H, W)``."""
    side = round(patches.shape[1] ** 0.5) // N17_MERGE  # squares along a view
    once = patches.reshape(*patches.shape[:2], 3, N17_REPEATS, -1)[:, :, :, 0]
    squares = once.reshape(-1, side, side, N17_MERGE, N17_MERGE, 3, N17_PATCH, N17_PATCH)
    pixels = side * N17_MERGE * N17_PATCH
    return squares.transpose(0, 5, 1, 3, 6, 2, 4, 7).reshape(-1, 3, pixels, pixels)
