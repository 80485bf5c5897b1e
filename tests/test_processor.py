"""Frames and words against the released processors, whose inputs and outputs are in tests/data/backbone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import saccade
from saccade import _saccade

DATA = Path(__file__).parent / "data" / "backbone"
TOKENIZER = DATA / "tiny_tokenizer.json"


def read(name: str) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """The arrays of a fixture, and its description."""
    arrays = {}
    path = DATA / f"{name}.safetensors"
    for key, (dtype, shape, data) in _saccade.read_stored(str(path)).items():
        kind = {"U8": np.uint8, "F32": np.float32, "I64": np.int64}.get(dtype)
        if kind is not None:
            arrays[key] = np.frombuffer(data, kind).reshape(shape)
    with path.open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    return arrays, json.loads(header["__metadata__"]["about"])


def raw_frames(arrays: dict[str, npt.NDArray[Any]], samples: int) -> list[list[npt.NDArray[np.uint8]]]:
    """The frames of each observation."""
    views = 1 + max(int(key.split(".")[2]) for key in arrays if key.startswith("_raw."))
    return [[arrays[f"_raw.{sample}.{view}"] for view in range(views)] for sample in range(samples)]


def assert_same_bits(found: npt.NDArray[Any], expected: npt.NDArray[Any]) -> None:
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("name", ["one_view", "two_views", "batch_padded", "bf16", "pixel_shuffle"])
def test_n15_backbone_fixtures(name: str, isa: str) -> None:
    arrays, about = read(f"n15_{name}")
    image, patch = about["vision_config"]["image_size"], about["vision_config"]["patch_size"]
    tokens = (image // patch) ** 2
    if about["eagle"]["use_pixel_shuffle"]:
        tokens = int(tokens * about["eagle"]["downsample_ratio"] ** 2)
    processor = saccade.Processor("n1.5", TOKENIZER, image_size=image, tokens_per_view=tokens)
    instructions = about["instructions"]
    frames = raw_frames(arrays, len(instructions))
    if len(instructions) == 1:
        inputs = processor(frames[0], instructions[0])
    else:
        inputs = processor(frames, instructions)
    assert isinstance(inputs.pixel_values, np.ndarray)
    assert_same_bits(inputs.pixel_values, arrays["_in.pixel_values"])
    assert_same_bits(inputs.input_ids, arrays["_in.input_ids"])
    assert_same_bits(inputs.attention_mask, arrays["_in.attention_mask"].astype(np.bool_))
