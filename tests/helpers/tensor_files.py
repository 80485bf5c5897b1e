"""safetensors files as NumPy arrays, without a package: what the core tests read fixtures with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_DTYPES = {
    "F64": np.float64,
    "F32": np.float32,
    "F16": np.float16,
    "I64": np.int64,
    "I32": np.int32,
    "I8": np.int8,
    "U8": np.uint8,
    "BOOL": np.bool_,
}


def read_tensor_file(path: Path, prefix: str = "") -> tuple[dict[str, str], dict[str, NDArray[Any]]]:
    """Metadata and read-only tensors of a file.

    Args:
        path: The file.
        prefix: Only tensors whose names begin with it are read. Those of dtype BF16 must not be among them.
    """
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header: dict[str, Any] = json.loads(content[8 : 8 + size])
    metadata: dict[str, str] = header.pop("__metadata__", {})
    arrays = {}
    for name, entry in header.items():
        if name.startswith(prefix):
            start, end = entry["data_offsets"]
            data = content[8 + size + start : 8 + size + end]
            arrays[name] = np.frombuffer(data, _DTYPES[entry["dtype"]]).reshape(entry["shape"])
    return metadata, arrays


def write_tensor_file(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Writes arrays as a safetensors file."""
    names = {np.dtype(dtype): name for name, dtype in _DTYPES.items()}
    header, start, parts = {}, 0, []
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        offsets = [start, start + len(data)]
        header[name] = {"dtype": names[array.dtype], "shape": list(array.shape), "data_offsets": offsets}
        start += len(data)
        parts.append(data)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    path.write_bytes(len(text).to_bytes(8, "little") + text + b"".join(parts))
