"""The fixtures of the released processors, and what the tests of the processor compare with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade import BackboneInputs, _saccade

Array = npt.NDArray[Any]
Image = npt.NDArray[np.uint8]

DATA = Path(__file__).parents[1] / "data" / "backbone"
TOKENIZER = DATA / "tiny_tokenizer.json"
BLACK = np.zeros((64, 64, 3), np.uint8)
NOISE = np.random.default_rng(0).integers(0, 256, (90, 120, 3), np.uint8)

#: A frame that nothing but the last resize changes.
AS_IT_IS = {"shortest_image_edge": None, "image_target_size": None, "crop_fraction": 1.0, "min_pixels": 1}


def read(name: str) -> tuple[dict[str, Array], dict[str, Any]]:
    """The arrays of a fixture that are no weights, and its description."""
    path = DATA / f"{name}.safetensors"
    arrays = stored(path)
    with path.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    return arrays, json.loads(header["__metadata__"]["about"])


def stored(path: Path) -> dict[str, Array]:
    """The arrays of a file that are frames, numbers or ids."""
    kinds = {"U8": np.uint8, "F32": np.float32, "I64": np.int64}
    return {
        key: np.frombuffer(data, kinds[dtype]).reshape(shape)
        for key, (dtype, shape, data) in _saccade.read_stored(str(path)).items()
        if dtype in kinds
    }


def checkpoint(folder: Path, fixture: str, config: dict[str, Any] | None = None) -> Path:
    """A checkpoint that holds only a backbone."""
    folder.mkdir(exist_ok=True)
    shutil.copy(DATA / f"{fixture}.safetensors", folder / "model.safetensors")
    if config is not None:
        (folder / "config.json").write_text(json.dumps(config))
    return folder


def raw_frames(arrays: dict[str, Array], samples: int) -> list[list[Image]]:
    """The frames of each observation."""
    views = 1 + max(int(key.split(".")[2]) for key in arrays if key.startswith("_raw."))
    return [[arrays[f"_raw.{sample}.{view}"] for view in range(views)] for sample in range(samples)]


def samples(arrays: dict[str, Array]) -> list[str]:
    """The samples of an image fixture."""
    return [key.removesuffix(".raw") for key in arrays if key.endswith(".raw")]


def bytes_of(pixels: Array) -> Image:
    """The bytes that normalised planes `(..., 3, height, width)` were made of, channels last."""
    levels: Image = np.rint(np.moveaxis(pixels, -3, -1) * 127.5 + 127.5).astype(np.uint8)
    return levels


def from_patches(pixels: Array, height: int, width: int) -> Image:
    """The image that N1.7's patches were cut from."""
    blocks = pixels.reshape(height // 32, width // 32, 2, 2, 3, 2, 16, 16)
    assert_same(blocks[:, :, :, :, :, 0], blocks[:, :, :, :, :, 1])
    planes = blocks[:, :, :, :, :, 0].transpose(4, 0, 2, 5, 1, 3, 6).reshape(3, height, width)
    return bytes_of(planes)


def pixels_of(inputs: BackboneInputs) -> Array:
    """The one array of pixels that N1.5 and N1.7 have."""
    assert isinstance(inputs.pixel_values, np.ndarray)
    return inputs.pixel_values


def assert_same(found: Array, expected: Array) -> None:
    """Same shape and same values."""
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found, expected)
