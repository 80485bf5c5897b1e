"""Frames and words against the released processors, whose inputs and outputs are in tests/data/backbone."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade._internal import hub_cache
from saccade.errors import CheckpointError
from tests.helpers.processor_cases import (
    AS_IT_IS,
    BLACK,
    TOKENIZER,
    assert_same,
    bytes_of,
    from_patches,
    pixels_of,
    raw_frames,
    read,
    samples,
)


@pytest.mark.parametrize("name", ["one_view", "two_views", "batch_padded", "bf16", "pixel_shuffle"])
def test_n15_inputs(name: str, isa: str) -> None:
    arrays, about = read(f"n15_{name}")
    image, patch = about["vision_config"]["image_size"], about["vision_config"]["patch_size"]
    tokens = (image // patch) ** 2
    if about["eagle"]["use_pixel_shuffle"]:
        tokens = int(tokens * about["eagle"]["downsample_ratio"] ** 2)
    processor = saccade.Processor("n1.5", TOKENIZER, image_size=image, tokens_per_view=tokens)
    check_inputs(processor, arrays, about["instructions"])


@pytest.mark.parametrize("name", ["one_view", "two_views", "batch_padded"])
@pytest.mark.parametrize("options", [AS_IT_IS, {"shortest_image_edge": 64, "crop_fraction": 1.0}])
def test_n17_inputs(name: str, options: dict[str, Any]) -> None:
    arrays, about = read(f"n17_{name}")
    processor = saccade.Processor("n1.7", TOKENIZER, options=options | {"min_pixels": 4096})
    inputs = check_inputs(processor, arrays, about["instructions"])
    assert inputs.image_grid_thw is not None
    assert_same(inputs.image_grid_thw, arrays["_in.image_grid_thw"])


def check_inputs(
    processor: saccade.Processor, arrays: dict[str, Any], instructions: list[str]
) -> saccade.BackboneInputs:
    frames = raw_frames(arrays, len(instructions))
    if len(instructions) == 1:
        inputs = processor(frames[0], instructions[0])
    else:
        inputs = processor(frames, instructions)
    assert_same(pixels_of(inputs), arrays["_in.pixel_values"])
    assert_same(inputs.input_ids, arrays["_in.input_ids"])
    assert_same(inputs.attention_mask, arrays["_in.attention_mask"].astype(np.bool_))
    return inputs


@pytest.mark.parametrize("options", [AS_IT_IS, {"shortest_image_edge": 56, "crop_fraction": 1.0}])
def test_n16_inputs(options: dict[str, Any]) -> None:
    arrays, _ = read("n16_two_views")
    inputs = saccade.Processor("n1.6", TOKENIZER, options=options)(
        raw_frames(arrays, 1)[0], "Open the drawer!"
    )
    assert isinstance(inputs.pixel_values, tuple)
    for view, pixels in enumerate(inputs.pixel_values):
        assert_same(pixels, arrays[f"_in.pixel_values.{view}"])
    assert_same(inputs.input_ids, arrays["_in.input_ids"])
    assert inputs.attention_mask.all()


@pytest.mark.parametrize("sample", samples(read("image_lerobot")[0]))
def test_images_of_lerobot(sample: str, isa: str) -> None:
    arrays, _ = read("image_lerobot")
    size = int(sample.split(".")[0].removeprefix("tile"))
    processor = saccade.Processor("n1.5", TOKENIZER, image_size=size)
    pixels = processor.frame(arrays[f"{sample}.raw"])
    assert_same(bytes_of(pixels), np.moveaxis(arrays[f"{sample}.resized_u8"], 0, -1))
    if f"{sample}.pixel_values" in arrays:
        assert_same(pixels, arrays[f"{sample}.pixel_values"])


@pytest.mark.parametrize("sample", samples(read("image_isaac")[0]))
def test_images_of_isaac(sample: str, isa: str) -> None:
    arrays, _ = read("image_isaac")
    size = int(sample.split(".")[0].removeprefix("tile"))
    processor = saccade.Processor("n1.5", TOKENIZER, preprocessing="isaac", image_size=size)
    assert_same(bytes_of(processor.frame(arrays[f"{sample}.raw"])), arrays[f"{sample}.u8"])


@pytest.mark.parametrize("sample", samples(read("image_n17")[0]))
def test_images_of_n17_and_n16(sample: str, isa: str) -> None:
    """The steps between are in the Rust tests."""
    arrays, _ = read("image_n17")
    raw = arrays[f"{sample}.raw"]
    options: dict[str, Any] = {"shortest_image_edge": 64, "crop_fraction": 0.95}
    if f"{sample}.pixel_values" in arrays:
        processor = saccade.Processor("n1.7", TOKENIZER, options=options | {"min_pixels": 4096})
        assert_same(processor.frame(raw), arrays[f"{sample}.pixel_values"])
        assert_same(np.asarray(processor([raw], "a").image_grid_thw), arrays[f"{sample}.grid"])
    processor = saccade.Processor("n1.6", TOKENIZER, options=options | {"min_pixels": 1})
    assert_same(bytes_of(processor.frame(raw)[0]), arrays[f"{sample}.n16_multiple_of_28"])
    # lerobot's without albumentations makes squares.
    options = {"image_crop_size": [58, 58], "image_target_size": [64, 64], "use_albumentations": False}
    processor = saccade.Processor(
        "n1.7", TOKENIZER, preprocessing="lerobot", options=options | {"min_pixels": 1}
    )
    assert_same(from_patches(processor.frame(raw), 64, 64), arrays[f"{sample}.lerobot_torch_58"])


def tokenizer_of_qwen3() -> Path | None:
    """The real vocabulary, which is too large for the repository."""
    given = os.environ.get("SACCADE_QWEN3_TOKENIZER")
    if given:
        return Path(given)
    names = ("lerobot/eagle2hg-processor-groot-n1p5", "Qwen/Qwen3-VL-2B-Instruct", "nvidia/Cosmos-Reason2-2B")
    folders = [
        folder for folder in (hub_cache.folder_of(name, "main") for name in names) if folder is not None
    ]
    files = ("tokenizer.json", "vocab.json")
    return next((one for one in folders if any((one / file).is_file() for file in files)), None)


def check_tokens(name: str, tokenizer: Path) -> None:
    arrays, about = read(name)
    versions: tuple[Any, ...] = ("n1.5", "n1.7")
    processors = []
    for version in versions:
        try:
            processors.append(saccade.Processor(version, tokenizer))
        except CheckpointError:
            assert (
                len(versions) > 1
            )  # Qwen's own tokenizer has none of Eagle's tokens, and the other way round
    assert processors
    for processor in processors:
        for index, text in enumerate(about["instructions"]):
            assert_same(processor.tokens(text), arrays[f"plain.{index}"])
        if processor.version == "n1.5":
            for index, views, instruction, _, length in about["prompts"]:
                ids = processor([BLACK] * views, instruction).input_ids
                assert_same(ids, arrays[f"prompt.{index}.{views}"][None])
                assert ids.shape == (1, length)


def test_tokens_of_a_small_vocabulary() -> None:
    check_tokens("tokens_tiny", TOKENIZER)


def test_tokens_of_the_real_vocabulary() -> None:
    tokenizer = tokenizer_of_qwen3()
    if tokenizer is None:
        pytest.skip(
            "needs the vocabulary of Qwen3: SACCADE_QWEN3_TOKENIZER, or "
            "lerobot/eagle2hg-processor-groot-n1p5 or Qwen/Qwen3-VL-2B-Instruct in the Hugging Face cache"
        )
    check_tokens("tokens_qwen3", tokenizer)


def test_both_renderings_of_the_instruction() -> None:
    """A list of one string, as both released processors print it, and the plain text that training saw."""
    prompts = [
        saccade.Processor("n1.5", TOKENIZER, plain_text=plain)([BLACK], "open the drawer").input_ids[0]
        for plain in (False, True)
    ]
    processor = saccade.Processor("n1.5", TOKENIZER)
    start = processor.tokens("<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n")
    view = processor.tokens("<image 1><img>" + "<IMG_CONTEXT>" * 256 + "</img>")
    end = processor.tokens("<|im_end|>\n<|im_start|>assistant\n")
    for prompt, text in zip(prompts, ("['open the drawer']", "open the drawer"), strict=True):
        assert_same(prompt, np.concatenate([start, view, processor.tokens(text), end]))


def test_what_was_resolved_is_shown() -> None:
    processor = saccade.Processor("n1.5", TOKENIZER)
    assert repr(processor) == (
        "<saccade.Processor version=n1.5 preprocessing=lerobot image_size=224 tokens_per_view=256 tokens=443>"
    )
    assert (processor.image_size, processor.tokens_per_view) == (224, 256)
    later = saccade.Processor("n1.7", TOKENIZER)
    assert (later.version, later.preprocessing, later.image_size) == ("n1.7", "isaac", None)
    assert saccade.Processor("n1.6", TOKENIZER).preprocessing == "isaac"
