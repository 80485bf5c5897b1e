"""A good checkpoint, what writes others from it, and what must hold whatever goes wrong."""

from __future__ import annotations

import contextlib
import faulthandler
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from saccade.checkpoints import convert, quantize, resize
from saccade.errors import SaccadeError
from tests.helpers.released import load_released

TINY = load_released("n15_tiny")
# What takes the path of a checkpoint and that of a new one; options are those of the function.
WRITERS: dict[str, Callable[..., object]] = {
    "quantize": quantize,
    "convert": lambda source, out, **options: convert(source, out, dtype="bfloat16", **options),
    "resize": lambda source, out, **options: resize(source, out, num_future_tokens=6, **options),
}


@pytest.fixture(autouse=True)
def no_hang() -> Iterator[None]:
    """What waits for a pipe waits for ever, and no signal wakes it: the process ends with a traceback."""
    faulthandler.dump_traceback_later(120, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture
def good(tmp_path: Path) -> Path:
    """A checkpoint with nothing wrong."""
    folder = tmp_path / "good"
    folder.mkdir()
    shutil.copyfile(TINY.path, folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(TINY.config))
    return folder


def refused(call: Callable[[], object], message: str) -> None:
    """That `call` raises an error of ours that can be read."""
    with pytest.raises((SaccadeError, FileNotFoundError, MemoryError), match=message) as caught:
        call()
    text = str(caught.value)
    assert "\x1b" not in text
    assert "\x9b" not in text
    assert len(text) < 2_000_000


def names(folder: Path) -> set[str]:
    """All that is in a folder, hidden files too."""
    return {entry.name for entry in folder.iterdir()}


@contextlib.contextmanager
def limited(kind: str, soft: int) -> Iterator[None]:
    """A limit of this process, such as `"RLIMIT_NOFILE"`, for a while. Skips where there are none."""
    resource = pytest.importorskip("resource")
    number = getattr(resource, kind)
    before = resource.getrlimit(number)
    resource.setrlimit(number, (soft, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(number, before)


class Meddler:
    """Does something once, in the middle of the writing."""

    def __init__(self, act: Callable[[], object]) -> None:
        self.act: Callable[[], object] | None = act

    def __call__(self, done: int, total: int) -> None:
        if self.act is not None and done > total // 3:
            act, self.act = self.act, None
            act()
