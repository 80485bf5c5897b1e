"""Reads pictures from files. Needs Pillow."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from saccade._arguments import UsageError
from saccade._arrays import UInt8Array

#: Kinds of pictures with eight bits a colour, as Pillow names them. Transparency is dropped.
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "HSV", "LAB")


def read_picture(path: Path) -> UInt8Array:
    """The picture in a file, ``(height, width, 3)``, turned as a camera's orientation tag says.

    Raises:
        FileNotFoundError: There is no such file.
        UsageError: It is no picture, is damaged, has more than eight bits a colour, or is too large.
    """
    from PIL import Image, ImageOps

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with Image.open(path) as picture:
            if picture.mode not in MODES:
                raise UsageError(f"{path}: expected a picture with 8 bits a colour, got mode {picture.mode}")
            turned = ImageOps.exif_transpose(picture)
            return cast("UInt8Array", np.asarray(turned.convert("RGB")))
    # Pillow raises SyntaxError and others for files that are damaged in their own ways.
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise UsageError(f"{path}: cannot be read as a picture: {error}") from None
