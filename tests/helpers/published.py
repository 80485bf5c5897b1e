"""Small published checkpoints that several tests read, each written once."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from pathlib import Path

from tests.helpers import layouts


@functools.cache
def published(layout: str, seed: int = 0) -> Path:
    """A checkpoint in this layout; not to be changed."""
    folder = Path(tempfile.mkdtemp(prefix=f"saccade-{layout}-"))
    atexit.register(shutil.rmtree, folder)
    layouts.write(folder, layout, seed=seed)
    return folder


def sidecars(folder: Path, layout: str, seed: int = 0) -> None:
    """Copies the other files of the checkpoint into `folder`."""
    shutil.copytree(
        published(layout, seed), folder, ignore=shutil.ignore_patterns("model*"), dirs_exist_ok=True
    )
