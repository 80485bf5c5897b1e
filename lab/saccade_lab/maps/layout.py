"""The layout of T_vl: positions of each camera's patches, of words, special tokens and padding."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError, ShapeError

#: Kinds of tokens that are not image patches, in the order in which they are listed.
OTHER_KINDS = ("text", "special", "pad")

# GR00T N1.5 with Qwen3's tokenizer: tokens with this id or a larger one are special.
FIRST_SPECIAL_ID = 151643
PADDING_ID = 151643
IMAGE_TOKEN_INDEX = 151669
SPECIAL_NAMES = {
    151643: "<|endoftext|>",
    151644: "<|im_start|>",
    151645: "<|im_end|>",
    151669: "<IMG_CONTEXT>",
    151670: "<img>",
    151671: "</img>",
}
DEFAULT_GRID = (16, 16)  # patches of a picture in GR00T N1.5: 224 px, patch size 14

#: Left, top, right and bottom of what the tokens of a picture see, as shares of its width and height.
Region: TypeAlias = tuple[float, float, float, float]
WHOLE: Region = (0.0, 0.0, 1.0, 1.0)

GRAMMAR = "parts KIND:SIZE[=NAME] with commas, such as text:14,image:16x16=left,special:1,text:*"


@dataclass(frozen=True)
class ViewLayout:
    """The patches of one picture: consecutive positions, row by row from the top left.

    Attributes:
        name: Name of the camera.
        start: Position of its first patch.
        rows, columns: Its grid.
        region: The part of the picture that the grid covers. It reaches beyond the picture where a processor
            adds bars to it.
    """

    name: str
    start: int
    rows: int
    columns: int
    region: Region = WHOLE

    @property
    def positions(self) -> slice:
        """Positions of its patches in T_vl."""
        return slice(self.start, self.start + self.rows * self.columns)


@dataclass(frozen=True)
class Token:
    """A token that is not an image patch.

    Attributes:
        position: Position in T_vl.
        kind: One of ``OTHER_KINDS``. Special tokens (brackets around pictures, registers, turns of a chat)
            are often attention sinks, so their mass is reported separately.
        name: Its text.
    """

    position: int
    kind: str
    name: str


@dataclass(frozen=True)
class Layout:
    """What is at each of the ``num_tokens`` positions of T_vl.

    Raises:
        ShapeError: A position is described twice or not at all, or two cameras have one name.

    Example:
        >>> layout = parse_layout("text:2,image:2x2=left,special:1=</img>,pad:*", num_tokens=9)
        >>> layout.cameras
        (ViewLayout(name='left', start=2, rows=2, columns=2, region=(0.0, 0.0, 1.0, 1.0)),)
        >>> {name: positions.tolist() for name, positions in layout.parts().items()}
        {'left': [2, 3, 4, 5], 'text': [0, 1], 'special': [6], 'pad': [7, 8]}
    """

    num_tokens: int
    cameras: tuple[ViewLayout, ...]
    tokens: tuple[Token, ...]

    def __post_init__(self) -> None:
        taken = np.zeros(self.num_tokens, dtype=np.int64)
        for camera in self.cameras:
            if camera.start < 0 or camera.positions.stop > self.num_tokens:
                raise ShapeError(
                    f"layout: camera {camera.name} has positions {camera.start} to "
                    f"{camera.positions.stop - 1}, expected 0 to {self.num_tokens - 1}"
                )
            taken[camera.positions] += 1
        for token in self.tokens:
            taken[token.position] += 1
        if (taken != 1).any():
            position = int(np.flatnonzero(taken != 1)[0])
            raise ShapeError(
                f"layout: position {position} is described {taken[position]} times, expected once"
            )
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names) or set(names) & set(OTHER_KINDS):
            raise ShapeError(
                f"layout: cameras {', '.join(names)}; expected different names, none of "
                f"{', '.join(OTHER_KINDS)}"
            )

    def parts(self) -> dict[str, npt.NDArray[np.int64]]:
        """Positions by camera name, then by kind; empty parts are left out."""
        parts = {camera.name: np.arange(self.num_tokens)[camera.positions] for camera in self.cameras}
        for kind in OTHER_KINDS:
            positions = [token.position for token in self.tokens if token.kind == kind]
            if positions:
                parts[kind] = np.array(positions, dtype=np.int64)
        return parts

    def kinds(self) -> dict[str, npt.NDArray[np.int64]]:
        """As ``parts``, with the patches of all cameras under ``"image"``."""
        parts = self.parts()
        image = [parts.pop(camera.name) for camera in self.cameras]
        return ({"image": np.concatenate(image)} if image else {}) | parts

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "num_tokens": self.num_tokens,
            "cameras": [vars(camera) for camera in self.cameras],
            "tokens": [vars(token) for token in self.tokens],
        }


def parse_grid(text: str) -> tuple[int, int]:
    """``"16x16"`` to rows and columns; a single number is the patches of a square picture.

    Raises:
        InputError: It is neither.

    Example:
        >>> parse_grid("3x4"), parse_grid("256")
        ((3, 4), (16, 16))
    """
    found = re.fullmatch(r"(\d{1,9})(?:x(\d{1,9}))?", text)
    if found is None:
        raise InputError(f"grid: given {text!r}, expected ROWSxCOLUMNS or a square number")
    first, second = found.groups()
    rows, columns = (int(first), int(second)) if second else square(int(first), "grid")
    if min(rows, columns) < 1:
        raise InputError(f"grid: given {text!r}, expected at least 1 row and 1 column")
    return rows, columns


def square(patches: int, what: str) -> tuple[int, int]:
    """The square grid with that number of patches; raises ``InputError`` if there is none."""
    side = math.isqrt(patches)
    if side * side != patches:
        raise InputError(f"{what}: {patches} image tokens are not a square; give the grid as ROWSxCOLUMNS")
    return side, side


def parse_layout(text: str, num_tokens: int, names: Sequence[str] | None = None) -> Layout:
    """Reads a layout written by hand.

    The grammar: parts in the order of their positions, separated by commas. A part is ``KIND:SIZE`` or
    ``KIND:SIZE=NAME``. KIND is ``image``, ``text``, ``special`` or ``pad``. SIZE is ``ROWSxCOLUMNS`` or a
    square number for ``image`` (one camera), the number of tokens for the others; one of those may have
    ``*``, for all remaining positions. NAME is the name of the camera or of the tokens (numbered if there are
    several).

    Args:
        text: The layout, for instance ``"text:14,image:16x16=left,special:1=</img>,text:*"``.
        num_tokens: T_vl.
        names: Names of all tokens. Default: generated.

    Raises:
        InputError: The text does not follow the grammar.
        ShapeError: It describes another number of tokens.
    """
    parts = [_parse_part(part) for part in text.split(",")]
    open_parts = [part for part in parts if part[1] is None]
    if len(open_parts) > 1:
        raise InputError(f"layout: {text!r} has * more than once")
    sizes = [0 if grid is None else grid[0] * grid[1] for _, grid, _ in parts]
    left = num_tokens - sum(sizes)
    if left < 0 or (left > 0 and not open_parts):
        raise ShapeError(
            f"layout: {text!r} has {sum(sizes)} positions{' and *' if open_parts else ''}, "
            f"the features have T_vl {num_tokens}"
        )
    cameras: list[ViewLayout] = []
    tokens: list[Token] = []
    position = 0
    for (kind, grid, name), given_size in zip(parts, sizes, strict=True):
        size = left if grid is None else given_size
        if kind == "image":
            assert grid is not None
            cameras.append(ViewLayout(name or f"camera {len(cameras) + 1}", position, *grid))
        else:
            label = name or kind
            for index in range(size):
                made_up = f"{label} {index + 1}" if size > 1 else label
                place = position + index
                tokens.append(Token(place, kind, made_up if names is None else names[place]))
        position += size
    return Layout(num_tokens, tuple(cameras), tuple(tokens))


def _parse_part(part: str) -> tuple[str, tuple[int, int] | None, str | None]:
    """Kind, grid (``(1, size)`` for what is not an image, None for ``*``) and name."""
    found = re.fullmatch(r"\s*(\w+)\s*:\s*([\dx*]+)\s*(?:=\s*(.+?)\s*)?", part)
    if found is None:
        raise InputError(f"layout: {part!r} cannot be read, expected {GRAMMAR}")
    kind, size, name = found.groups()
    if kind not in ("image", *OTHER_KINDS):
        raise InputError(f"layout: unknown kind {kind!r}, expected image, {', '.join(OTHER_KINDS)}")
    if kind == "image":
        return kind, parse_grid(size), name
    if size == "*":
        return kind, None, name
    if not size.isdecimal():
        raise InputError(f"layout: {part!r} cannot be read, expected {GRAMMAR}")
    return kind, (1, int(size)), name


def from_input_ids(
    input_ids: npt.NDArray[np.integer[Any]],
    *,
    image_token_index: int = IMAGE_TOKEN_INDEX,
    grid: tuple[int, int] = DEFAULT_GRID,
    names: Sequence[str] | None = None,
    attention_mask: npt.NDArray[np.bool_] | None = None,
) -> Layout:
    """The layout of a prompt: each run of image tokens is split into pictures of ``grid``.

    Args:
        input_ids: ``(T_vl,)``.
        image_token_index: Id of the token that stands for one patch.
        grid: Rows and columns of a picture.
        names: Strings of all tokens; default: their ids.
        attention_mask: ``(T_vl,)``, False at padding; default: a leading run of ``PADDING_ID`` is padding.

    Raises:
        InputError: There is no image token, or a run does not split into pictures.
    """
    padding = (
        np.logical_and.accumulate(input_ids == PADDING_ID) if attention_mask is None else ~attention_mask
    )
    image = (input_ids == image_token_index) & ~padding
    if not image.any():
        raise InputError(
            f"input_ids: no image token {image_token_index} among {len(input_ids)}; choose another with "
            "--image-token-index, or --layout text:* if there are no pictures"
        )
    return _from_mask(
        image,
        grid,
        "input_ids",
        padding=padding,
        special=input_ids >= FIRST_SPECIAL_ID,
        names=names or [SPECIAL_NAMES.get(int(number), f"#{number}") for number in input_ids],
    )


def from_image_mask(
    image_mask: npt.NDArray[np.bool_],
    *,
    grid: tuple[int, int] | None = None,
    names: Sequence[str] | None = None,
    attention_mask: npt.NDArray[np.bool_] | None = None,
) -> Layout:
    """The layout given by the image mask of a ``Context``.

    Args:
        image_mask: ``(T_vl,)``, True at image tokens.
        grid: Rows and columns of a picture; default: each run of image tokens is one square picture.
        names: Strings of all tokens; those in angle brackets count as special.
        attention_mask: ``(T_vl,)``, False at padding.

    Raises:
        InputError: There is no image token, or a run does not split into pictures.
    """
    length = len(image_mask)
    padding = np.zeros(length, dtype=np.bool_) if attention_mask is None else ~attention_mask
    image = image_mask & ~padding
    if not image.any():
        raise InputError(
            f"image_mask: no image token among {length}; if there are no pictures: --layout text:*"
        )
    if names is None:
        special, names = np.zeros(length, dtype=np.bool_), [f"text {place}" for place in range(length)]
    else:
        special = np.array([is_special(name) for name in names])
    return _from_mask(image, grid, "image_mask", padding=padding, special=special, names=names)


def _from_mask(
    image: npt.NDArray[np.bool_],
    grid: tuple[int, int] | None,
    what: str,
    *,
    padding: npt.NDArray[np.bool_],
    special: npt.NDArray[np.bool_],
    names: Sequence[str],
) -> Layout:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], image.astype(np.int8), [0]))))
    cameras: list[ViewLayout] = []
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        length = stop - start
        rows, columns = grid or square(length, f"{what}: a run at position {start}")
        if length % (rows * columns):
            raise InputError(
                f"{what}: a run of {length} image tokens at position {start}, expected a multiple of "
                f"{rows * columns} ({rows} x {columns} per picture); the prompt may have been cut off"
            )
        for first in range(start, stop, rows * columns):
            cameras.append(ViewLayout(f"camera {len(cameras) + 1}", first, rows, columns))
    tokens = []
    for position in np.flatnonzero(~image).tolist():
        kind = "pad" if padding[position] else "special" if special[position] else "text"
        tokens.append(Token(position, kind, readable(names[position])))
    return Layout(len(image), tuple(cameras), tuple(tokens))


def kind_of(position: int, text: str) -> Token:
    """A token that is no image patch, by its text: those in angle brackets are special.

    Example:
        >>> kind_of(3, " puck"), kind_of(4, "<|im_end|>").kind
        (Token(position=3, kind='text', name='puck'), 'special')
    """
    return Token(position, "special" if is_special(text) else "text", readable(text))


def is_special(text: str) -> bool:
    """Whether the text of a token is that of a special token, such as ``"</img>"``."""
    return re.fullmatch(r"<[^<>\s]+>", text) is not None


def readable(name: str) -> str:
    r"""A token's string without the characters that byte-level tokenizers use for spaces and line ends.

    Example:
        >>> readable("\u0120puck"), readable("\u010a")
        ('puck', '\\n')
    """
    shown = name.replace("\u0120", " ").replace("\u010a", "\n").strip(" ").replace("\n", "\\n")
    return shown or "␣"
