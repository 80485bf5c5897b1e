"""Positions of N1.7's prompts, in batches that repeat some, against a definition token by token."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from saccade import InputError
from saccade_lab.reference.backbone.qwen3_vl import prompt_positions

IMAGE, MERGE = 9, 2
SIZES: Any = SimpleNamespace(image_token=IMAGE, merge=MERGE)
SHORT = [1, *4 * [IMAGE], 2]  # a view of 4 x 4 patches
LONG = [1, *4 * [IMAGE], 3, 4, *4 * [IMAGE], 5]  # two of them
SQUARE, WIDE = (4, 4), (2, 8)


def batch(*prompts: list[int], left: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """Padded on one side by tokens that are not attended to."""
    length = max(map(len, prompts))
    ids, mask = torch.full((len(prompts), length), IMAGE), torch.zeros(len(prompts), length, dtype=torch.bool)
    for row, prompt in enumerate(prompts):
        place = slice(length - len(prompt), None) if left else slice(len(prompt))
        ids[row, place], mask[row, place] = torch.tensor(prompt, dtype=torch.long), True
    return ids, mask


def expected(ids: torch.Tensor, mask: torch.Tensor, grids: list[tuple[int, int]]) -> np.ndarray:
    found = np.ones((3, *ids.shape), np.int64)
    views = list(grids)
    for row in range(len(ids)):
        start, left, size = 0, 0, (0, 0)  # left: tokens of the current view that are still to come
        for column in range(ids.shape[1]):
            if not mask[row, column]:
                continue
            if ids[row, column] != IMAGE:
                found[:, row, column] = start
                start += 1
                continue
            if left == 0:
                height, width = (side // MERGE for side in views.pop(0))
                size, left = (height, width), height * width
            index = size[0] * size[1] - left
            found[:, row, column] = start, start + index // size[1], start + index % size[1]
            left -= 1
            if left == 0:
                start += max(size)
    return found


@pytest.mark.parametrize("left", [True, False])
@pytest.mark.parametrize(
    ("prompts", "grids"),
    [
        ([SHORT, SHORT, SHORT], 3 * [SQUARE]),
        ([LONG, SHORT, LONG, [1, 2], SHORT], 6 * [SQUARE]),
        ([SHORT, SHORT], [SQUARE, WIDE]),  # the same tokens, and views of other sides
        ([LONG, LONG], [SQUARE, WIDE, WIDE, SQUARE]),
        ([[1, 2], [1, 2], [3]], []),
        ([SHORT, SHORT], 3 * [SQUARE]),  # the model counts the views
        ([[]], []),
    ],
)
def test_positions(prompts: list[list[int]], grids: list[tuple[int, int]], left: bool) -> None:
    ids, mask = batch(*prompts, left=left)
    found = prompt_positions(ids, mask, grids, SIZES)
    assert found.dtype == torch.long
    np.testing.assert_array_equal(found.numpy(), expected(ids, mask, grids))


@pytest.mark.parametrize("shape", [(0, 5), (2, 0), (0, 0)])
def test_no_prompt_or_no_token(shape: tuple[int, int]) -> None:
    found = prompt_positions(
        torch.zeros(shape, dtype=torch.long), torch.ones(shape, dtype=torch.bool), [], SIZES
    )
    assert found.shape == (3, *shape)


@pytest.mark.parametrize(
    ("prompts", "grids", "message"),
    [
        ([SHORT, SHORT], [SQUARE], "0 x 0 image tokens of a view from position 1 of prompt 1"),
        ([SHORT, SHORT, SHORT], 2 * [SQUARE], "position 1 of prompt 2"),
        ([SHORT, [1, IMAGE, 2, *3 * [0]], [1, IMAGE, 0, *3 * [0]]], 3 * [SQUARE], "2 x 2 .* of prompt 1"),
        ([SHORT, SHORT], [SQUARE, (4, 8)], "2 x 4 .* of prompt 1"),
    ],
)
def test_the_first_prompt_whose_views_do_not_fit_is_named(
    prompts: list[list[int]], grids: list[tuple[int, int]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        prompt_positions(*batch(*prompts), grids, SIZES)
