"""Every option about frames, against those that the released processors made, and what is refused at load."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import saccade
from saccade.errors import InputError
from saccade.processor import Version
from tests.helpers.processor_cases import AS_IT_IS, TOKENIZER, assert_same, bytes_of, from_patches, stored

IMAGES = Path(__file__).parents[1] / "data" / "images"
RELEASES: dict[str, Version] = {"N1.6": "n1.6", "N1.7": "n1.7"}

#: Frames go to the last resize as they are.
UNCHANGED = {key: value for key, value in AS_IT_IS.items() if key != "min_pixels"}

NOISE = np.random.default_rng(0).integers(0, 256, (90, 161, 3), np.uint8)


def case(name: str) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """A case's description and its arrays."""
    return json.loads((IMAGES / name / "case.json").read_text()), stored(IMAGES / name / "case.safetensors")


def made(version: Version, options: Mapping[str, Any] | None = None, **others: Any) -> saccade.Processor:
    return saccade.Processor(version, TOKENIZER, options=options, **others)


# --- fixtures ---


@pytest.mark.parametrize("name", sorted(path.name for path in IMAGES.glob("[0-9]*")))
def test_frames_of_the_released_processors(name: str, isa: str) -> None:
    about, arrays = case(name)
    version = RELEASES[about["release"]]
    processor, unchanged = made(version, about["options"]), made(version, UNCHANGED)
    frames = [key for key in arrays if key.startswith("frame.")]
    assert len(frames) >= 2
    for key in frames:
        expected = unchanged.frame(arrays[key.replace("frame", "out")])
        assert_same(processor.frame(arrays[key]), expected)


@pytest.mark.parametrize("name", ["lerobot-n17-rename", "lerobot-n17-native-libero"])
def test_frames_and_words_of_lerobot(name: str, tmp_path: Path) -> None:
    """What lerobot gives to Qwen's processor, whose least area would hide it."""
    about, arrays = case(name)
    file = json.loads((IMAGES / name / "policy_preprocessor.json").read_text())
    steps = {step["registry_name"]: step["config"] for step in file["steps"]}
    encode, pack = steps["groot_n1_7_vlm_encode_v1"], steps["groot_n1_7_pack_inputs_v1"]
    options = {key: value for key, value in encode.items() if key not in ("device", "model_name")}
    options |= {"formalize_language": pack["formalize_language"], "min_pixels": 1}
    processor = made("n1.7", options, preprocessing="lerobot")
    unchanged = made("n1.7", {"image_target_size": None, "min_pixels": 1}, preprocessing="lerobot")
    renamed = {new: old for old, new in steps["rename_observations_processor"]["rename_map"].items()}
    for view, key in enumerate(about["views"]):
        for row, frame in enumerate(arrays[renamed.get(key, key)]):
            expected = arrays["frames"][row, view]
            height, width = expected.shape[:2]
            found = from_patches(processor.frame(frame), height, width)
            assert_same(from_patches(unchanged.frame(expected), height, width), expected)
            # torchvision's fixed point, whose last bit depends on the machine; see the README of the data.
            difference = np.abs(found.astype(int) - expected)
            assert difference.max() <= 2
            assert difference.mean() < 0.1
    task = about["task"] if isinstance(about["task"], str) else about["task"][0]
    frame = arrays["frames"][0, 0]
    words = processor([frame], task).input_ids
    assert_same(words, made("n1.7", {**options, "formalize_language": False}, preprocessing="lerobot")(
        [frame], about["texts"][0]
    ).input_ids)  # fmt: skip


def test_lerobots_n15_leaves_the_resizing_to_eagle() -> None:
    about, arrays = case("lerobot-n15-044-nostats")
    processor = made("n1.5", image_size=28)
    for view, key in enumerate(about["views"]):
        for frame, expected in zip(arrays[key], arrays["frames"][:, view], strict=True):
            assert_same(processor.frame(frame), processor.frame(expected))
    plain = made("n1.5", image_size=28, plain_text=True)
    frames = [arrays["frames"][0, 0]]
    assert_same(processor(frames, about["task"][0]).input_ids, plain(frames, about["texts"][0]).input_ids)


# --- torchvision's path, against torch ---


def torchvision(frame: npt.NDArray[np.uint8], target: list[int], crop: list[int]) -> npt.NDArray[np.uint8]:
    """Resize, centre crop, resize."""
    import torch

    def resized(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
        found = torch.nn.functional.interpolate(planes, size=target, mode="bilinear", antialias=True)
        return np.ascontiguousarray(found[0].permute(1, 2, 0).numpy())

    image = resized(frame)
    lacking = [max(part - side, 0) for part, side in zip(crop, image.shape[:2], strict=True)]
    image = np.pad(image, [(lack // 2, lack - lack // 2) for lack in lacking] + [(0, 0)])
    top, left = (round((side - part) / 2) for side, part in zip(image.shape[:2], crop, strict=True))
    return resized(image[top : top + crop[0], left : left + crop[1]])


@pytest.mark.parametrize("version", ["n1.6", "n1.7"])
@pytest.mark.parametrize("seed", range(6))
def test_random_sizes_without_albumentations(version: Version, seed: int, isa: str) -> None:
    rng = np.random.default_rng(seed)
    frame = rng.integers(0, 256, (*rng.integers(20, 200, 2), 3), np.uint8)
    unit = 32 if version == "n1.7" else 28
    target = [int(side) * unit for side in rng.integers(1, 6, 2)]
    # Also crops that are larger than what they are taken from.
    crop = [int(side * share) for side, share in zip(target, rng.uniform(0.6, 1.2, 2), strict=True)]
    options = {"image_target_size": target, "image_crop_size": crop, "use_albumentations": False}
    options |= {"letter_box_transform": False, "min_pixels": 1}
    pixels = made(version, options).frame(frame)
    found = from_patches(pixels, *target) if version == "n1.7" else bytes_of(pixels[0])
    assert_same(found, torchvision(frame, target, crop))


# --- what the options mean ---


def test_missing_keys_have_the_defaults_of_the_released_constructor() -> None:
    said = {"use_albumentations": True}
    edges: dict[Version, int] = {"n1.6": 512, "n1.7": 256}
    for version, edge in edges.items():
        full = said | {"shortest_image_edge": edge, "crop_fraction": 0.95}
        # Sizes do not take the place of what is missing, only of what is null.
        sizes = {"image_target_size": [64, 64], "image_crop_size": [32, 32]}
        for options in (said, said | sizes):
            assert_same(made(version, options).frame(NOISE), made(version, full).frame(NOISE))
    # Options that are no whole file complete those of the published checkpoints.
    published = {"shortest_image_edge": 256, "crop_fraction": 0.95, "letter_box_transform": False}
    for version in RELEASES.values():
        assert_same(made(version).frame(NOISE), made(version, said | published).frame(NOISE))


def test_only_heights_count_and_each_option_falls_back_for_itself() -> None:
    sizes = {"use_albumentations": True, "image_target_size": [96, 300], "image_crop_size": [48, 1]}
    for edge, fraction in itertools.product((96, None), (0.5, None)):
        options = sizes | {"shortest_image_edge": edge, "crop_fraction": fraction}
        full = {"use_albumentations": True, "shortest_image_edge": 96, "crop_fraction": 0.5}
        assert_same(made("n1.7", options).frame(NOISE), made("n1.7", full).frame(NOISE))


@pytest.mark.parametrize("use_albumentations", [True, False])
def test_black_bars(use_albumentations: bool) -> None:
    """N1.6 always adds them, N1.7 if it is told to, and every release can be told otherwise."""
    square = np.zeros((161, 161, 3), np.uint8)
    square[35:125] = NOISE
    options: dict[str, Any] = {"use_albumentations": use_albumentations}
    options |= {"image_target_size": [64, 64], "image_crop_size": [60, 60]}
    defaults: dict[Version, bool] = {"n1.6": True, "n1.7": False}
    for version, default in defaults.items():
        boxed = made(version, options).frame(square)
        bare = made(version, options | {"letter_box_transform": False}).frame(NOISE)
        assert boxed.shape != bare.shape or (boxed != bare).any()
        assert_same(made(version, options).frame(NOISE), boxed if default else bare)
        assert_same(made(version, options | {"letter_box_transform": True}).frame(NOISE), boxed)


def test_null_switches_are_off() -> None:
    options = {"use_albumentations": True, "letter_box_transform": None, "formalize_language": None}
    expected = {"use_albumentations": True, "letter_box_transform": False, "formalize_language": False}
    found = made("n1.7", options)([NOISE], "Push!")
    assert_same(found.input_ids, made("n1.7", expected)([NOISE], "Push!").input_ids)


@pytest.mark.parametrize("use_albumentations", [True, False])
def test_lerobot_without_a_target_leaves_frames_alone(use_albumentations: bool) -> None:
    options = {"image_target_size": None, "shortest_image_edge": 64, "crop_fraction": 0.5, "min_pixels": 1}
    options |= {"letter_box_transform": True, "use_albumentations": use_albumentations}
    found = made("n1.7", options, preprocessing="lerobot").frame(NOISE[:64, :96])
    assert_same(from_patches(found, 64, 96), NOISE[:64, :96])


@pytest.mark.parametrize("fraction", [0, -1, 1, 1.5])
def test_lerobot_crops_by_a_part_only(fraction: float) -> None:
    options = {"image_target_size": [64, 64], "image_crop_size": None}
    whole = made("n1.7", options | {"crop_fraction": None}, preprocessing="lerobot")
    found = made("n1.7", options | {"crop_fraction": fraction}, preprocessing="lerobot")
    assert_same(found.frame(NOISE), whole.frame(NOISE))


# --- what is refused when the processor is made ---

ALB = {"use_albumentations": True, "shortest_image_edge": 256, "crop_fraction": 0.95}
SIZES = {"image_target_size": [256, 256], "image_crop_size": [230, 230]}
VISION = {"use_albumentations": False, **SIZES}


@pytest.mark.parametrize("version", ["n1.6", "n1.7"])
@pytest.mark.parametrize(
    ("options", "key"),
    [
        (VISION | {"image_target_size": None}, "image_target_size"),
        (VISION | {"image_crop_size": None}, "image_crop_size"),
        ({"use_albumentations": False}, "image_target_size"),
        ({"use_albumentations": None}, "image_target_size"),
        (VISION | {"image_target_size": [256]}, "image_target_size"),
        (VISION | {"image_target_size": 256}, "image_target_size"),
        (VISION | {"image_crop_size": [0, 4]}, "image_crop_size"),
        (VISION | {"image_crop_size": [2.5, 4]}, "image_crop_size"),
        (ALB | {"crop_fraction": None}, "crop_fraction"),
        (ALB | {"crop_fraction": None, "image_target_size": [256, 256]}, "crop_fraction"),
        (ALB | {"crop_fraction": None, "image_crop_size": [256, 256]}, "crop_fraction"),
        (ALB | SIZES | {"crop_fraction": None, "image_crop_size": [257, 1]}, "image_crop_size"),
        (ALB | {"crop_fraction": 0}, "crop_fraction"),
        (ALB | {"crop_fraction": 1.01}, "crop_fraction"),
        (ALB | {"crop_fraction": True}, "crop_fraction"),
        (ALB | {"shortest_image_edge": None}, "shortest_image_edge"),
        (ALB | {"shortest_image_edge": None, "crop_fraction": 1}, "shortest_image_edge"),
        (ALB | {"shortest_image_edge": 0}, "shortest_image_edge"),
        (ALB | {"shortest_image_edge": 256.5}, "shortest_image_edge"),
        ({"shortest_image_edge": None, "crop_fraction": 0.9}, "shortest_image_edge"),
        (ALB | {"letter_box_transform": 1}, "letter_box_transform"),
        (ALB | {"formalize_language": "no"}, "formalize_language"),
        (ALB | {"surprise": 1}, "surprise"),
    ],
)
def test_options_that_cannot_be_used(version: Version, options: dict[str, Any], key: str) -> None:
    with pytest.raises(InputError, match=f"{key}: expected"):
        made(version, options)


def test_each_problem_is_named_once() -> None:
    with pytest.raises(InputError) as error:
        made("n1.7", {"use_albumentations": False, "image_target_size": "large"})
    assert str(error.value).count("image_target_size") == 1
    assert str(error.value).count("image_crop_size") == 1


@pytest.mark.parametrize(
    "option",
    [
        {"letter_box_transform": True},
        {"use_albumentations": True},
        {"shortest_image_edge": 256},
        {"image_target_size": [224, 224]},
        {"image_crop_size": [200, 200]},
        {"crop_fraction": 0.9},
    ],
)
def test_options_that_n15_does_not_have(option: dict[str, Any]) -> None:
    (key,) = option
    with pytest.raises(InputError, match=f"{key}: expected none"):
        made("n1.5", option)
    made("n1.5", {key: None})


@pytest.mark.parametrize("preprocessing", ["isaac", "lerobot"])
def test_every_combination_is_used_or_refused_at_load(preprocessing: Any) -> None:
    """A processor that could be made prepares a frame."""
    values: dict[str, list[Any]] = {
        "use_albumentations": [True, False],
        "letter_box_transform": [True, False],
        "shortest_image_edge": [None, 64],
        "crop_fraction": [None, 0.9],
        "image_crop_size": [None, [50, 60]],
        "image_target_size": [None, [64, 96]],
    }
    taken = 0
    refused: list[tuple[str, list[str]]] = []
    for chosen in itertools.product(*values.values()):
        options = dict(zip(values, chosen, strict=True))
        try:
            processor = made("n1.7", options | {"min_pixels": 1}, preprocessing=preprocessing)
        except InputError as error:
            refused.append((str(error), [key for key, value in options.items() if value is None]))
            continue
        processor.frame(NOISE)
        taken += 1
    assert all(any(f"{key}: expected" in text for key in keys) for text, keys in refused)
    # Isaac-GR00T: of 16 each, 8 with albumentations (edge and fraction, or what replaces them), 4 without.
    assert taken == (64 if preprocessing == "lerobot" else 2 * (8 + 4))
