"""Files of seeded random tensors, drawn and written in blocks of bounded size. NumPy only."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade_lab.backbone_sizes import BackboneSizes

#: Numbers that are drawn at a time.
BLOCK = 1 << 22

#: Changes rows of a tensor in place: its name, the rows, and their values ``(rows, ...)``.
Plant: TypeAlias = Callable[[str, slice, Float32Array], None]

#: What `Outliers` multiplies rows, columns or values with; see there.
RESIDUAL = 40.0
GATE = 8.0
NUM_CHANNELS = 4


@dataclass(frozen=True)
class Tensor:
    """A tensor to be drawn: its name in the file, its shape, and how it is stored."""

    name: str
    shape: tuple[int, ...]
    dtype: str
    """``"BF16"`` or ``"F32"``."""

    @property
    def nbytes(self) -> int:
        """Size in the file."""
        return math.prod(self.shape) * {"BF16": 2, "F32": 4}[self.dtype]


@dataclass(frozen=True)
class Outliers:
    """Plants outliers where trained models have them, so that quantised activations can be judged.

    `NUM_CHANNELS` channels of SigLIP's (Qwen3-VL's) residual stream are `RESIDUAL` at every patch, by the
    bias of the patch embedding; typical values are about 1. In every feed-forward layer of the language model
    as many inputs of the down projection are about ``GATE**2 / 2`` times as large as the others, by larger
    rows of the gate and up projections; the columns of the down projection are smaller by the same factor, so
    that the residual stream stays tame.
    """

    sizes: BackboneSizes

    def channels(self, width: int) -> npt.NDArray[np.intp]:
        """The outlier channels among `width`."""
        return np.linspace(0, width, min(NUM_CHANNELS, width), endpoint=False).astype(np.intp) + width // 9

    def plant(self, name: str, rows: slice, values: Float32Array) -> None:
        """Changes rows of a tensor, `values (rows, ...)`, in place."""
        vision, text = self.sizes.vision.width, self.sizes.text.mlp_width
        if name.endswith(("patch_embedding.bias", "patch_embed.proj.bias")):
            channels = self.channels(vision)
            values[channels] = RESIDUAL * np.where(np.arange(len(channels)) % 2, -1, 1)
        elif name.endswith(("mlp.gate_proj.weight", "mlp.up_proj.weight")):
            channels = self.channels(text)
            here = channels[(channels >= rows.start) & (channels < rows.stop)] - rows.start
            values[here] *= GATE
        elif name.endswith("mlp.down_proj.weight"):
            values[:, self.channels(text)] /= GATE**2 / 2


def write_file(path: Path, tensors: Sequence[Tensor], seed: int, plant: Plant | None = None) -> None:
    """Writes tensors to a safetensors file.

    Args:
        path: The file.
        tensors: What to draw, in this order.
        seed: Seed of all tensors.
        plant: As :meth:`Outliers.plant`.
    """
    header: dict[str, Any] = {"__metadata__": {"format": "pt"}}
    end = 0
    for tensor in tensors:
        start, end = end, end + tensor.nbytes
        header[tensor.name] = {
            "dtype": tensor.dtype,
            "shape": list(tensor.shape),
            "data_offsets": [start, end],
        }
    encoded = json.dumps(header, separators=(",", ":")).encode()
    encoded += b" " * (-len(encoded) % 8)
    with path.open("wb") as file:
        file.write(len(encoded).to_bytes(8, "little"))
        file.write(encoded)
        for tensor in tensors:
            for block in blocks(tensor, seed, plant):
                file.write(block)


def blocks(tensor: Tensor, seed: int, plant: Plant | None = None) -> Iterator[bytes]:
    """The content of a tensor in row-major order, as it is stored.

    The numbers depend on the seed and the name only.

    Args:
        tensor: What to draw.
        seed: Seed of all tensors.
        plant: As :meth:`Outliers.plant`.
    """
    rng = np.random.Generator(np.random.SFC64([seed, zlib.crc32(tensor.name.encode())]))
    shape = tensor.shape or (1,)
    width = math.prod(shape[1:])
    offset, scale = mean_and_std(tensor.name, tensor.shape)
    rows = max(BLOCK // max(width, 1), 1)
    for start in range(0, shape[0], rows):
        part = slice(start, min(start + rows, shape[0]))
        values = rng.standard_normal((part.stop - part.start, width), np.float32)
        values *= np.float32(scale)
        values += np.float32(offset)
        if plant is not None:
            plant(tensor.name, part, values[:, 0] if len(shape) == 1 else values)
        yield bfloat16(values).tobytes() if tensor.dtype == "BF16" else values.tobytes()


def mean_and_std(name: str, shape: tuple[int, ...]) -> tuple[float, float]:
    """Mean and standard deviation of a tensor, such that activations stay of order one.

    Args:
        name: Name in the checkpoint, which distinguishes weights, biases, norms and tables.
        shape: Shape of the tensor.
    """
    if name.endswith((".bias", ".b", "in_proj_bias")) or not shape:
        return 0.0, 0.1
    if len(shape) == 1:
        return 1.0, 0.1  # the scale of a norm
    if any(
        table in name for table in ("position_embedding", "pos_embed", "embed_tokens", "lm_head", "_tokens.")
    ):
        return 0.0, 0.5
    if name.endswith(".W"):
        return 0.0, shape[1] ** -0.5  # (category, in, out)
    return 0.0, math.prod(shape[1:]) ** -0.5  # (out, in)


def bfloat16(values: Float32Array) -> npt.NDArray[np.uint16]:
    """The bits of finite numbers rounded to bfloat16, half to even."""
    bits = values.view(np.uint32)
    odd = (bits >> np.uint32(16)) & np.uint32(1)
    return ((bits + (odd + np.uint32(0x7FFF))) >> np.uint32(16)).astype(np.uint16)
