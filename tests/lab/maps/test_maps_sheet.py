"""The sheet of maps: where each patch is drawn, and what is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from saccade_lab.maps import record
from saccade_lab.maps.drawing import ranges
from saccade_lab.maps.notes import NO_FUTURE
from saccade_lab.maps.sheet import DOTS_PER_INCH, WIDTH, Sheet, write_sheet
from tests.helpers.maps_cases import one_hot_maps


def drawn(figure: Figure, shape: tuple[int, int]) -> list[Any]:
    """All maps of this shape on the sheet, in the order in which they were drawn."""
    arrays = [np.asarray(image.get_array()) for axes in figure.axes for image in axes.images]
    return [array for array in arrays if array.shape == shape]


def test_the_sheet_shows_each_patch_where_it_is() -> None:
    maps = one_hot_maps(steps=(1,))
    figure = Sheet(maps).draw()
    left, top = drawn(figure, (2, 2)), drawn(figure, (1, 3))
    # Occlusion, then state, future and action of block 0, then the future tokens one by one.
    assert len(left) == len(top) == 1 + 3 + 3
    np.testing.assert_allclose(left[0], [[0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(left[2], [[0.0, 0.0], [1 / 6, 0.0]], atol=1e-7)  # token 0 of 3, head 0 of 2
    np.testing.assert_allclose(top[2], [[0.0, 1 / 6, 1 / 6]], atol=1e-7)
    np.testing.assert_allclose(left[4], [[0.0, 0.0], [0.5, 0.0]])
    np.testing.assert_allclose(top[5], [[0.0, 0.5, 0.0]])
    np.testing.assert_allclose(top[6], [[0.0, 0.0, 0.5]])


def test_the_sheet_as_a_file(tmp_path: Path) -> None:
    write_sheet(one_hot_maps(), tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert sheet.width == WIDTH * DOTS_PER_INCH
        assert sheet.height > 1000
        assert np.asarray(sheet).std() > 10
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]


def texts(figure: Figure) -> str:
    return " ".join(" ".join(text.get_text().split()) for text in figure.texts)


def test_the_sheet_says_what_is_missing() -> None:
    without = texts(Sheet(one_hot_maps(future_tokens=0, images=False)).draw())
    assert record.CAVEAT in without
    assert record.OCCLUSION in without
    assert NO_FUTURE in without
    assert "one by one" not in without
    assert "maps are drawn on white" in without


def test_ranges() -> None:
    assert ranges((0,)) == "0"
    assert ranges((0, 1, 3, 4, 5, 9)) == "0-1, 3-5, 9"
