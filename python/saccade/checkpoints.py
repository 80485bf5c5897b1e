"""Reading checkpoints without torch."""

from __future__ import annotations

import os

from saccade import _saccade
from saccade._arrays import Float32Array


def read_tensors(source: str | os.PathLike[str], prefix: str = "") -> dict[str, Float32Array]:
    """Reads the tensors whose names begin with ``prefix``, as float32; the prefix is cut off the names.

    Args:
        source: One ``.safetensors`` file, or a directory with one or more of them, with or without an index.
        prefix: For instance ``"backbone."``.

    Returns:
        Name to array, sorted by name. float16 and bfloat16 are widened, which is exact.

    Raises:
        FileNotFoundError: there is no such path.
        CheckpointError: the file is broken, or a tensor is not F32, BF16 or F16.
    """
    return _saccade.read_tensors(os.fspath(source), prefix)
