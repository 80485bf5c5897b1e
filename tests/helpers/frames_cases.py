"""Directories of pictures for the cameras of `whole_checkpoints`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from tests.helpers.whole_checkpoints import CAMERAS, HEIGHT, WIDTH


def write_pictures(folder: Path, seed: int = 0, names: Sequence[str] | None = None) -> Path:
    """Writes a random picture for each name; default: a PNG for each camera."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    for name in [f"{camera}.png" for camera in CAMERAS] if names is None else names:
        Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)).save(folder / name)
    return folder


def write_pictures_of(folder: Path, *names: str) -> Path:
    """Writes a folder of pictures for each name; returns `folder`."""
    for seed, name in enumerate(names):
        write_pictures(folder / name, seed)
    return folder
