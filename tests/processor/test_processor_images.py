"""Resizing against the installed torch and Pillow, on random sizes and on every instruction set."""

from __future__ import annotations

import numpy as np
import pytest

import saccade
from benches.image_differences import differences
from tests.helpers.processor_cases import AS_IT_IS, TOKENIZER, assert_same, bytes_of, from_patches


@pytest.mark.parametrize(
    "name", ["torch uint8 cubic", "torch uint8 linear", "torch float32 linear", "Pillow cubic, width first"]
)
def test_random_sizes(name: str, isa: str) -> None:
    found = differences(name, count=12, seed=3, longest=160)
    assert found.any(), "the library is installed for the tests"
    # Builds of torch may order the sums of float32 differently, which truncation makes a level of.
    most = 1 if "float32" in name else 0
    assert not found[most + 1 :].any()
    assert found[1:].sum() <= 0.01 * found.sum()


@pytest.mark.parametrize("size", [(1, 1), (1, 150), (150, 1), (3, 2), (17, 400)])
def test_narrow_frames(size: tuple[int, int], isa: str) -> None:
    """Taps end at the edges, and blocks of rows are not full."""
    import torch

    image = np.random.default_rng(0).integers(0, 256, (*size, 3), np.uint8)
    found = bytes_of(saccade.Processor("n1.5", TOKENIZER, image_size=42).frame(image))
    planes = torch.from_numpy(np.moveaxis(image, -1, 0).copy())[None]
    expected = torch.nn.functional.interpolate(planes, (42, 42), mode="bicubic", antialias=True)
    assert_same(found, np.moveaxis(expected[0].numpy(), 0, -1))


@pytest.mark.parametrize("version", ["n1.6", "n1.7"])
def test_every_instruction_set_gives_the_same_bits(version: saccade.processor.Version, isa: str) -> None:
    image = np.random.default_rng(1).integers(0, 256, (61, 97, 3), np.uint8)
    found = saccade.Processor(version, TOKENIZER).frame(image)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SACCADE_ISA", "portable")
        assert_same(found, saccade.Processor(version, TOKENIZER).frame(image))


@pytest.mark.parametrize("factor", [2, 3, 5, 8])
def test_area_of_whole_factors_is_the_mean(factor: int) -> None:
    """OpenCV is not in the tests' environment: see benches/image_differences.py. A mean needs no peer."""
    image = np.random.default_rng(2).integers(0, 256, (32 * factor, 32 * factor, 3), np.uint8)
    options = AS_IT_IS | {"shortest_image_edge": 32}
    found = from_patches(saccade.Processor("n1.7", TOKENIZER, options=options).frame(image), 32, 32)
    cells = image.reshape(32, factor, 32, factor, 3).mean(axis=(1, 3))
    assert np.abs(found - cells).max() <= 0.5 + 1e-3


def test_large_frames() -> None:
    """Twenty thousand pixels on a side, and a frame of one row."""
    tall = np.full((20_000, 4, 3), 200, np.uint8)
    for preprocessing in ("lerobot", "isaac"):
        processor = saccade.Processor("n1.5", TOKENIZER, preprocessing=preprocessing, image_size=56)
        for image in (tall, tall.reshape(4, 20_000, 3), tall.reshape(1, -1, 3)):
            found = bytes_of(processor.frame(image)).astype(int)
            assert np.abs(found - 200).max() <= 1  # Isaac-GR00T truncates
