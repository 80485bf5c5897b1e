"""Counts values that are not finite in safetensors files, in little memory and by this file alone.

Loading refuses them too, but stops at the first tensor. Here a file is read once, in pieces, and every tensor
is named. The bits of the exponent decide, so nothing is converted.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from saccade.errors import CheckpointError

#: The exponent of each type of floating point: a value is NaN or infinite if all of its bits are set. And the
#: unsigned integers of its size.
EXPONENTS = {
    "F64": (0x7FF0_0000_0000_0000, "<u8"),
    "F32": (0x7F80_0000, "<u4"),
    "F16": (0x7C00, "<u2"),
    "BF16": (0x7F80, "<u2"),
}
#: Bytes that are read at a time.
PIECE = 1 << 24


def count_not_finite(files: Iterable[Path]) -> dict[str, tuple[int, int]]:
    """Tensors with values that are NaN or infinite: how many of them, and the number of all values.

    Args:
        files: Safetensors files whose headers were checked before, as opening a checkpoint does.

    Returns:
        By name, in the order of the files.

    Raises:
        CheckpointError: A file ends before its header says, because somebody is writing it.

    Example:
        >>> import saccade
        >>> count_not_finite([saccade.demo_checkpoint() / "model.safetensors"])
        {}
    """
    found: dict[str, tuple[int, int]] = {}
    for path in files:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            header = json.loads(file.read(length))
            header.pop("__metadata__", None)
            for name, entry in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
                first, end = entry["data_offsets"]
                if entry["dtype"] not in EXPONENTS:
                    continue
                mask, integers = EXPONENTS[entry["dtype"]]
                bits, count, left = np.dtype(integers), 0, end - first
                file.seek(8 + length + first)
                while left > 0:
                    piece = file.read(min(PIECE, left))
                    if len(piece) < min(PIECE, left):
                        missing = left - len(piece)
                        raise CheckpointError(
                            f"{path}: ends within {name}, {missing} bytes too early: it was cut off meanwhile"
                        )
                    values = np.frombuffer(piece, bits)
                    count += int(np.count_nonzero((values & bits.type(mask)) == mask))
                    left -= values.nbytes
                if count:
                    found[name] = (count, (end - first) // bits.itemsize)
    return found
