"""Where image tokens sit in T_vl: layouts written by hand, prompts of N1.5, image masks, the simulator."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from saccade.errors import InputError, ShapeError
from saccade_lab.maps.layout import (
    Layout,
    Token,
    ViewLayout,
    from_image_mask,
    from_input_ids,
    parse_grid,
    parse_layout,
)

IMG, IMG_CONTEXT, END_IMG, END_OF_TEXT, IM_START = 151670, 151669, 151671, 151643, 151644


def prompt(cameras: int, text: int, *, padding: int = 0) -> NDArray[np.int64]:
    """Token numbers of an N1.5 prompt as public users have measured them: 14 tokens of chat head; for each
    camera 5 of `<image k>`, `<img>`, 256 patches, `</img>`; then text, and 5 closing tokens.
    """
    ids = [END_OF_TEXT] * padding + [IM_START] + [100 + place for place in range(13)]
    for camera in range(cameras):
        ids += [200 + camera] * 5 + [IMG] + [IMG_CONTEXT] * 256 + [END_IMG]
    return np.array(ids + [300 + place for place in range(text + 5)])


@pytest.mark.parametrize("cameras", [1, 2, 3])
@pytest.mark.parametrize("padding", [0, 7])
def test_a_prompt_of_n15(cameras: int, padding: int) -> None:
    ids = prompt(cameras, 14, padding=padding)
    assert len(ids) == padding + 19 + 263 * cameras + 14
    layout = from_input_ids(ids)
    assert [camera.start for camera in layout.cameras] == [padding + 20 + 263 * k for k in range(cameras)]
    assert all((camera.rows, camera.columns) == (16, 16) for camera in layout.cameras)
    parts = layout.parts()
    special = [padding] + [
        place for k in range(cameras) for place in (padding + 19 + 263 * k, padding + 276 + 263 * k)
    ]
    assert parts["special"].tolist() == special
    assert parts.get("pad", np.zeros(0)).tolist() == list(range(padding))
    names = {token.position: token.name for token in layout.tokens}
    assert names[padding + 19] == "<img>"
    assert names[padding + 1] == "#100"


def test_every_position_is_in_one_part() -> None:
    layout = from_input_ids(prompt(2, 3, padding=4))
    together = np.sort(np.concatenate(list(layout.parts().values())))
    np.testing.assert_array_equal(together, np.arange(layout.num_tokens))
    kinds = layout.kinds()
    assert list(kinds) == ["image", "text", "special", "pad"]
    assert len(kinds["image"]) == 512


def test_pictures_without_anything_between_them_are_split() -> None:
    ids = np.array([1, 2] + [9] * 24 + [3])
    layout = from_input_ids(ids, image_token_index=9, grid=(3, 4))
    assert layout.cameras == (ViewLayout("camera 1", 2, 3, 4), ViewLayout("camera 2", 14, 3, 4))


def test_an_attention_mask_says_what_padding_is() -> None:
    ids = prompt(1, 3, padding=2)
    mask = np.ones(len(ids), dtype=np.bool_)
    mask[-3:] = False  # padded on the right instead
    layout = from_input_ids(ids, attention_mask=mask)
    assert layout.parts()["pad"].tolist() == [len(ids) - 3, len(ids) - 2, len(ids) - 1]
    assert layout.parts()["special"].tolist()[:2] == [0, 1]


def test_token_strings_are_shown() -> None:
    ids = np.array([5, 9, 9, 9, 9, 6])
    names = ["\u0120push", *["<IMG_CONTEXT>"] * 4, "\u010a"]
    layout = from_input_ids(ids, image_token_index=9, grid=(2, 2), names=names)
    assert [token.name for token in layout.tokens] == ["push", "\\n"]


def test_a_truncated_run_is_an_error() -> None:
    ids = prompt(2, 3)[: 20 + 263 + 200]  # the second picture is cut off
    with pytest.raises(InputError, match=r"a run of 200 image tokens at position 283.*cut off"):
        from_input_ids(ids)


def test_no_image_token_is_an_error_that_says_how_to_go_on() -> None:
    with pytest.raises(InputError, match=r"no image token 151655 among 302.*--image-token-index"):
        from_input_ids(prompt(1, 20), image_token_index=151655)
    with pytest.raises(InputError, match=r"image_mask: no image token among 5"):
        from_image_mask(np.zeros(5, dtype=np.bool_))


def test_an_image_mask() -> None:
    mask = np.array([False, True, True, True, True, False, True, True, True, True, False])
    layout = from_image_mask(mask)
    assert layout.cameras == (ViewLayout("camera 1", 1, 2, 2), ViewLayout("camera 2", 6, 2, 2))
    assert [token.name for token in layout.tokens] == ["text 0", "text 5", "text 10"]
    assert from_image_mask(mask, grid=(1, 4)).cameras[0] == ViewLayout("camera 1", 1, 1, 4)
    assert [camera.start for camera in from_image_mask(mask, grid=(2, 1)).cameras] == [1, 3, 6, 8]
    names = ["push", *["x"] * 4, "</img>", *["x"] * 4, "a < b"]
    assert from_image_mask(mask, names=names).parts()["special"].tolist() == [5]
    with pytest.raises(InputError, match=r"4 image tokens at position 1, expected a multiple of 9"):
        from_image_mask(mask, grid=(3, 3))
    with pytest.raises(InputError, match=r"3 image tokens are not a square"):
        from_image_mask(np.array([True, True, True]))


def test_a_layout_written_by_hand() -> None:
    layout = parse_layout("text:2=word, image:2x3=left, image:4, special:1=</img>, text:*, pad:2", 18)
    assert layout.cameras == (ViewLayout("left", 2, 2, 3), ViewLayout("camera 2", 8, 2, 2))
    assert [(token.position, token.kind, token.name) for token in layout.tokens] == [
        (0, "text", "word 1"),
        (1, "text", "word 2"),
        (12, "special", "</img>"),
        (13, "text", "text 1"),
        (14, "text", "text 2"),
        (15, "text", "text 3"),
        (16, "pad", "pad 1"),
        (17, "pad", "pad 2"),
    ]
    assert parse_layout("text:*", 3).cameras == ()
    assert len(parse_layout("image:2x2,text:*", 4).tokens) == 0
    assert parse_layout("text:1,image:1x1", 2, ["push", "x"]).tokens == (Token(0, "text", "push"),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot be read"),
        ("text", "cannot be read"),
        ("text:2,", "cannot be read"),
        ("text:-1", "cannot be read"),
        ("words:3", "unknown kind 'words'"),
        ("image:*", "cannot be read, expected ROWSxCOLUMNS|grid: given"),
        ("image:5", "5 image tokens are not a square"),
        ("image:0x4", "at least 1 row"),
        ("image:2x2x2", "expected ROWSxCOLUMNS"),
        ("text:2x2", "cannot be read"),
        ("text:*,pad:*", r"\* more than once"),
    ],
)
def test_what_is_no_layout(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_layout(text, 10)


@pytest.mark.parametrize("text", ["text:9", "text:11", "image:2x2,text:7", "image:4x4,text:*"])
def test_a_layout_of_another_length_is_an_error(text: str) -> None:
    with pytest.raises(ShapeError, match="T_vl 10"):
        parse_layout(text, 10)


def test_two_cameras_of_one_name_are_an_error() -> None:
    with pytest.raises(ShapeError, match="left, left"):
        parse_layout("image:1x1=left,image:1x1=left", 2)
    with pytest.raises(ShapeError, match="none of text"):
        parse_layout("image:1x1=text", 1)


def test_positions_are_described_once() -> None:
    with pytest.raises(ShapeError, match="position 2 is described 0 times"):
        Layout(3, (ViewLayout("left", 0, 1, 2),), ())
    with pytest.raises(ShapeError, match="position 1 is described 2 times"):
        Layout(2, (ViewLayout("left", 0, 1, 2),), (Token(1, "text", "x"),))
    with pytest.raises(ShapeError, match="positions 1 to 4, expected 0 to 2"):
        Layout(3, (ViewLayout("left", 1, 2, 2),), ())


@pytest.mark.parametrize(("text", "grid"), [("16x16", (16, 16)), ("3x4", (3, 4)), ("64", (8, 8))])
def test_grids(text: str, grid: tuple[int, int]) -> None:
    assert parse_grid(text) == grid


@pytest.mark.parametrize("text", ["", "x", "3x", "-3", "3.5", "5", "0"])
def test_what_is_no_grid(text: str) -> None:
    with pytest.raises(InputError, match="grid"):
        parse_grid(text)
