"""Reads small files that are held in memory at once: JSON, and the tensors of statistics."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import saccade._saccade as _saccade
from saccade.errors import CheckpointError, SaccadeError, printable

#: A larger file is refused, since it is read at once. The engine has the same limit for its JSON files.
MOST_BYTES = 100_000_000

#: How the text of a Git LFS pointer begins: what a clone holds in place of a file that was not downloaded.
POINTER = b"version https://git-lfs.github.com/spec/v1"

#: The types of safetensors that statistics may have, and those of NumPy.
DTYPES = {
    "F64": "<f8",
    "F32": "<f4",
    "F16": "<f2",
    "I64": "<i8",
    "I32": "<i4",
    "I16": "<i2",
    "I8": "i1",
    "U8": "u1",
    "BOOL": "?",
}


def read_json(path: Path, error: type[SaccadeError] = CheckpointError) -> dict[str, Any]:
    """Reads a JSON file that contains an object.

    Args:
        path: The file.
        error: What is raised if the file is damaged.

    Raises:
        FileNotFoundError: The file does not exist.
        error: It contains something else, or cannot be read.
    """
    values = read_json_value(path, error)
    if not isinstance(values, dict):
        raise error(f"{path}: expected a JSON object, got {type(values).__name__}")
    return values


def read_json_value(path: Path, error: type[SaccadeError]) -> Any:
    """Reads a JSON file, whatever value it contains. Arguments and errors as of :func:`read_json`."""
    try:
        return json.loads(read_small(path))
    except FileNotFoundError:
        raise FileNotFoundError(printable(f"{path}: no such file")) from None
    except (OSError, ValueError, RecursionError) as cause:
        raise error(f"{path}: cannot be read as JSON: {cause}") from None


def read_small_tensors(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Reads a small ``.safetensors`` file with tensors of any dtype. lerobot stores counts as int64.

    Raises:
        FileNotFoundError: The file does not exist.
        CheckpointError: It is damaged.
    """
    try:
        check_small(path)
        tensors = {}
        for name, (dtype, shape, content) in _saccade.read_stored(str(path)).items():
            if dtype not in DTYPES:
                raise ValueError(f"{name} is {dtype}, expected one of {', '.join(DTYPES)}")
            tensors[name] = np.frombuffer(content, DTYPES[dtype]).reshape(shape)
    except FileNotFoundError:
        raise FileNotFoundError(printable(f"{path}: no such file")) from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read as safetensors: {error}") from None
    return tensors


def read_small(path: Path) -> bytes:
    """The content of a small file. Raises as :func:`check_small`."""
    check_small(path)
    return path.read_bytes()


def check_small(path: Path) -> None:
    """Checks that a path is a regular file of at most `MOST_BYTES`, and not a Git LFS pointer.

    Raises:
        OSError: The file does not exist or cannot be read.
        ValueError: It is something else.
    """
    about = path.stat()
    # Reading a pipe might wait forever, and a device might never end.
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("not a regular file")
    if about.st_size > MOST_BYTES:
        raise ValueError(f"more than {MOST_BYTES} bytes")
    with path.open("rb") as file:
        if file.read(len(POINTER)) == POINTER:
            raise ValueError(
                f"it is a Git LFS pointer, not the file itself: run `git lfs pull` in {path.parent}, or "
                "download the repository with `hf download`"
            )
