"""Pictures and curves in a terminal: in colour where it has any, in plain characters elsewhere."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Literal, TextIO, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import UInt8Array

#: How a terminal shows colours: 16 million of them, the 256 of xterm, or none.
Colours: TypeAlias = Literal["true", "256", "none"]

#: The upper half of a character cell in the colour of the text, the lower in that of the background.
HALF_BLOCK = "▀"
#: From low to high.
BARS = "▁▂▃▄▅▆▇█"
#: From dark to bright on a dark background.
SHADES = " .:-=+*#%@"
#: The levels of red, green and blue in xterm's cube of colours, which begins at number 16.
CUBE = np.array([0, 95, 135, 175, 215, 255])
RESET = "\x1b[0m"


def colours_of(stream: TextIO) -> Colours:
    """The colours that a stream shows.

    None if it is no terminal, if ``NO_COLOR`` is set, if ``TERM`` is ``dumb``, ``unknown`` or (except on
    Windows) not set, if its encoding has no half blocks, or if it is a Windows console that does not
    understand escape sequences.
    """
    terminal = os.environ.get("TERM") or ("" if sys.platform == "win32" else "unknown")
    dumb = os.environ.get("NO_COLOR") or terminal in ("dumb", "unknown")
    if dumb or not stream.isatty() or not can_write(stream, HALF_BLOCK):
        return "none"
    if sys.platform == "win32" and not _understands_escapes():
        return "none"
    has_true = sys.platform == "win32" or os.environ.get("COLORTERM") in ("truecolor", "24bit")
    return "true" if has_true else "256"


def can_write(stream: TextIO, text: str) -> bool:
    """Whether the stream's encoding has all characters of a text."""
    try:
        text.encode(stream.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def _understands_escapes() -> bool:
    """Asks a Windows console to understand escape sequences, which those before Windows 10 cannot."""
    if sys.platform == "win32":
        import ctypes

        output, processed, virtual_terminal = -11, 0x1, 0x4  # names of the Windows headers, in lower case
        kernel = ctypes.windll.kernel32
        handle, mode = kernel.GetStdHandle(output), ctypes.c_uint32()
        if kernel.GetConsoleMode(handle, ctypes.byref(mode)):
            return bool(kernel.SetConsoleMode(handle, mode.value | processed | virtual_terminal))
    return False


def shrink(image: UInt8Array, height: int, width: int) -> UInt8Array:
    """An image ``(H, W, 3)`` as ``(height, width, 3)``: each pixel the mean of the area that it covers."""
    rows, columns = coverage(image.shape[0], height), coverage(image.shape[1], width)
    mean = np.einsum("yh,hwc,xw->yxc", rows, image.astype(np.float64), columns)
    small: UInt8Array = np.rint(mean).astype(np.uint8)
    return small


def coverage(size: int, cells: int) -> npt.NDArray[np.float64]:
    """How much of each of `cells` equal cells each of `size` pixels covers, ``(cells, size)``; rows sum to 1.

    Example:
        >>> coverage(3, 2).round(2).tolist()
        [[0.67, 0.33, 0.0], [0.0, 0.33, 0.67]]
    """
    edges = np.arange(cells + 1) * size / cells
    pixels = np.arange(size)
    low, high = np.maximum(edges[:-1, None], pixels), np.minimum(edges[1:, None], pixels + 1)
    covered: npt.NDArray[np.float64] = np.maximum(high - low, 0.0) * (cells / size)
    return covered


def picture(image: UInt8Array, width: int, colours: Colours) -> list[str]:
    """The lines of an image ``(H, W, 3)``, `width` characters each; a cell is twice as high as wide."""
    height = max(1, round(width * image.shape[0] / image.shape[1] / 2))
    if colours == "none":
        return shaded(shrink(image, height, width))
    small = shrink(image, 2 * height, width)
    lines = []
    for upper, lower in zip(small[::2], small[1::2], strict=True):
        cells = [
            f"\x1b[38;{code(above, colours)};48;{code(below, colours)}m{HALF_BLOCK}"
            for above, below in zip(upper, lower, strict=True)
        ]
        lines.append("".join(cells) + RESET)
    return lines


def code(pixel: UInt8Array, colours: Colours) -> str:
    """The numbers of an escape sequence that name a colour."""
    red, green, blue = (int(value) for value in pixel)
    if colours == "true":
        return f"2;{red};{green};{blue}"
    level = [int(np.abs(CUBE - value).argmin()) for value in (red, green, blue)]
    return f"5;{16 + 36 * level[0] + 6 * level[1] + level[2]}"


def shaded(image: UInt8Array) -> list[str]:
    """An image in characters of more or less ink, from its darkest pixel to its brightest."""
    light = image.astype(np.float64) @ [0.299, 0.587, 0.114]
    low, high = float(light.min()), float(light.max())
    index = ((light - low) / max(high - low, 1.0) * (len(SHADES) - 1)).round().astype(int)
    return ["".join(SHADES[number] for number in row) for row in index]


def beside(pictures: Sequence[Sequence[str]], gap: str) -> list[str]:
    """Pictures with equally many lines, side by side."""
    return [gap.join(row) for row in zip(*pictures, strict=True)]


def bars(values: Sequence[float]) -> str:
    """A bar for each value; the lowest at -1 or below, the highest at 1 or above.

    Example:
        >>> bars([-2.0, -1.0, 0.0, 1.0])
        '▁▁▅█'
    """
    scaled = (np.clip(values, -1.0, 1.0) + 1.0) / 2.0 * len(BARS)
    return "".join(BARS[min(int(value), len(BARS) - 1)] for value in scaled)
