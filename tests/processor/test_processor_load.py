"""The processor of a checkpoint: what its files and tensors say, and options in their place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.errors import CheckpointError, InputError
from tests.helpers.processor_cases import AS_IT_IS, DATA, NOISE, TOKENIZER, assert_same, checkpoint
from tests.helpers.published import published

pytestmark = pytest.mark.usefixtures("cache")


def load(source: Path, **options: Any) -> saccade.Processor:
    return saccade.Processor.from_pretrained(source, tokenizer=TOKENIZER, **options)


@pytest.mark.parametrize(
    ("fixture", "version", "preprocessing", "size"),
    [
        ("n15_one_view", "n1.5", "isaac", (56, 16)),
        ("n15_two_views", "n1.5", "lerobot", (56, 16)),
        ("n15_pixel_shuffle", "n1.5", "isaac", (56, 4)),
        ("n16_two_views", "n1.6", "isaac", (None, None)),
        ("n17_one_view", "n1.7", "isaac", (None, None)),
    ],
)
def test_a_backbone_alone(
    tmp_path: Path, fixture: str, version: str, preprocessing: str, size: tuple[int | None, int | None]
) -> None:
    for source in (DATA / f"{fixture}.safetensors", checkpoint(tmp_path / "one", fixture)):
        processor = load(source)
        assert (processor.version, processor.preprocessing) == (version, preprocessing)
        assert (processor.image_size, processor.tokens_per_view) == size


@pytest.mark.parametrize(
    ("layout", "preprocessing"), [("nvidia", "isaac"), ("isaac", "isaac"), ("lerobot", "lerobot")]
)
def test_whole_checkpoints(layout: str, preprocessing: str) -> None:
    processor = load(published(layout))
    assert (processor.version, processor.preprocessing) == ("n1.5", preprocessing)


def test_the_preprocessing_may_be_another() -> None:
    source = DATA / "n15_two_views.safetensors"
    isaac = load(source, preprocessing="isaac")
    assert isaac.preprocessing == "isaac"
    expected = saccade.Processor("n1.5", TOKENIZER, preprocessing="isaac", image_size=56)
    assert_same(isaac.frame(NOISE), expected.frame(NOISE))
    with pytest.raises(InputError, match="preprocessing: expected"):
        load(source, preprocessing="n1.5")


def test_sizes_of_a_config_in_nvidias_layout(tmp_path: Path) -> None:
    def config(size: int) -> dict[str, Any]:
        eagle = {"force_image_size": size, "vision_config": {"patch_size": 14}}
        return {"model_type": "gr00t_n1_5", "backbone_cfg": {"eagle_config": eagle}}

    assert load(checkpoint(tmp_path / "fits", "n15_one_view", config(56))).image_size == 56
    with pytest.raises(CheckpointError, match=r"the image size is 224, but .* has 4 x 4 patches of 14"):
        load(checkpoint(tmp_path / "differs", "n15_one_view", config(224)))


def test_a_config_of_another_version(tmp_path: Path) -> None:
    source = checkpoint(tmp_path / "other", "n15_one_view", {"model_type": "Gr00tN1d7"})
    with pytest.raises(CheckpointError, match=r"model_type .* but the tensors are those of N1\.5"):
        load(source)


# --- options ---


@pytest.mark.parametrize("folder", [".", "processor"])
def test_options_of_isaac(tmp_path: Path, folder: str) -> None:
    source = checkpoint(tmp_path / "isaac", "n17_one_view")
    (source / folder).mkdir(exist_ok=True)
    options = {"use_albumentations": True, "shortest_image_edge": 64, "crop_fraction": 0.9}
    kwargs: dict[str, Any] = options | {"modality_configs": {}, "a key of a later release": None}
    (source / folder / "processor_config.json").write_text(json.dumps({"processor_kwargs": kwargs}))
    limits = {"size": {"shortest_edge": 4096, "longest_edge": 1 << 24}, "patch_size": 16}
    (source / "preprocessor_config.json").write_text(json.dumps(limits))
    expected = saccade.Processor("n1.7", TOKENIZER, options=options | {"min_pixels": 4096})
    assert_same(load(source).frame(NOISE), expected.frame(NOISE))


def test_options_of_lerobot(tmp_path: Path) -> None:
    source = checkpoint(tmp_path / "lerobot", "n17_one_view", {"type": "groot"})
    expected = saccade.Processor(
        "n1.7", TOKENIZER, preprocessing="lerobot", options={"use_albumentations": False}
        | {"image_crop_size": [230, 230], "image_target_size": [256, 256]},
    )  # fmt: skip
    assert_same(load(source).frame(NOISE), expected.frame(NOISE))
    step = {"image_target_size": [64, 64], "image_crop_size": [58, 58], "use_albumentations": True}
    (source / "policy_preprocessor.json").write_text(
        json.dumps(
            {
                "steps": [
                    {"registry_name": "groot_n1_7_pack_inputs_v1", "config": {"formalize_language": False}},
                    {"registry_name": "groot_n1_7_vlm_encode_v1", "config": step | {"device": "cpu"}},
                ]
            }
        )
    )
    options = step | {"formalize_language": False}
    expected = saccade.Processor("n1.7", TOKENIZER, preprocessing="lerobot", options=options)
    found = load(source)([NOISE], "Push!")
    assert_same(found.input_ids, expected([NOISE], "Push!").input_ids)
    assert_same(np.asarray(found.pixel_values), np.asarray(expected([NOISE], "Push!").pixel_values))


def write(path: Path, values: Any) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(values))


def isaac(tmp_path: Path, version: str = "n17", folder: str = ".", **kwargs: Any) -> Path:
    """A checkpoint with Isaac-GR00T's file."""
    source = checkpoint(tmp_path / version, {"n16": "n16_two_views", "n17": "n17_one_view"}[version])
    values = {"processor_class": f"Gr00tN1d{version[-1]}Processor", "processor_kwargs": kwargs}
    write(source / folder / "processor_config.json", values)
    return source


def lerobot(tmp_path: Path, steps: list[Any], fixture: str = "n17_one_view") -> Path:
    """A checkpoint with lerobot's file."""
    source = checkpoint(tmp_path / "steps", fixture, {"type": "groot"})
    write(source / "policy_preprocessor.json", {"name": "policy_preprocessor", "steps": steps})
    return source


def test_the_folder_processor_counts_where_the_root_has_no_file(tmp_path: Path) -> None:
    for version in ("n16", "n17"):
        source = isaac(tmp_path, version, "processor", use_albumentations=True, shortest_image_edge=64)
        options = {"use_albumentations": True, "shortest_image_edge": 64}
        name: Any = f"{version[:2]}.{version[2]}"
        assert_same(
            load(source).frame(NOISE), saccade.Processor(name, TOKENIZER, options=options).frame(NOISE)
        )
        options["shortest_image_edge"] = 128
        write(source / "processor_config.json", {"processor_kwargs": options})
        assert_same(
            load(source).frame(NOISE), saccade.Processor(name, TOKENIZER, options=options).frame(NOISE)
        )


@pytest.mark.parametrize("version", ["n16", "n17"])
def test_a_file_without_use_albumentations_has_torchvisions_path(tmp_path: Path, version: str) -> None:
    """It is the default of the released constructors, which then need the sizes."""
    with pytest.raises(InputError, match="image_target_size: expected a height and a width, since use_alb"):
        load(isaac(tmp_path, version, shortest_image_edge=256))
    sizes: dict[str, Any] = {"image_target_size": [64, 64], "image_crop_size": [60, 60]}
    found = load(isaac(tmp_path, version, **sizes)).frame(NOISE)
    options = {"use_albumentations": False, **sizes}
    name: Any = f"{version[:2]}.{version[2]}"
    assert_same(found, saccade.Processor(name, TOKENIZER, options=options).frame(NOISE))


@pytest.mark.parametrize(
    ("version", "kwargs", "key"),
    [
        ("n16", {"surprise": 1}, "surprise"),
        ("n17", {"surprise": "x"}, "surprise"),
        ("n17", {"surprise": 0.0}, "surprise"),
        ("n17", {"min_pixels": 1}, "min_pixels"),  # of another file
        ("n16", {"letter_box_transform": True}, "letter_box_transform"),
        ("n16", {"exclude_state": True}, "exclude_state"),
    ],
)
def test_keys_that_the_release_does_not_know(
    tmp_path: Path, version: str, kwargs: dict[str, Any], key: str
) -> None:
    whole: dict[str, Any] = {"use_albumentations": True, "shortest_image_edge": 64, "crop_fraction": 0.9}
    with pytest.raises(InputError, match=rf"processor_config\.json: processor_kwargs: {key}: expected none"):
        load(isaac(tmp_path, version, **whole, **kwargs))
    empty: tuple[Any, ...] = (None, False, "", [], {})
    for nothing in empty:
        load(isaac(tmp_path, version, **whole, surprise=nothing))


def test_every_argument_of_the_released_processors_is_known(tmp_path: Path) -> None:
    common = """modality_configs image_crop_size image_target_size use_albumentations random_rotation_angle
        color_jitter_params shortest_image_edge crop_fraction model_name model_type formalize_language
        max_state_dim max_action_dim max_action_horizon use_percentiles clip_outliers
        apply_sincos_state_encoding use_relative_action extra_augmentation_config
        transformers_loading_kwargs"""
    later = "letter_box_transform use_mean_std exclude_state state_dropout_prob"
    typed: dict[str, Any] = {"image_crop_size": [9, 9], "image_target_size": [9, 9], "crop_fraction": 0.5}
    typed |= {"use_albumentations": True, "formalize_language": True, "letter_box_transform": True}
    for version, names in (("n16", common), ("n17", common + " " + later)):
        load(isaac(tmp_path, version, **{name: typed.get(name, 1) for name in names.split()}))


def test_the_class_of_another_release(tmp_path: Path) -> None:
    source = isaac(tmp_path, use_albumentations=True)
    write(source / "processor_config.json", {"processor_class": "Gr00tN1d6Processor", "processor_kwargs": {}})
    with pytest.raises(CheckpointError, match="processor_class: expected Gr00tN1d7Processor"):
        load(source)


def test_steps_of_lerobot_that_are_not_known(tmp_path: Path) -> None:
    known = ["rename_observations_processor", "to_batch_processor", "device_processor"]
    known += ["relative_actions_processor", "delta_actions_processor", "groot_n1_7_pack_inputs_v1"]
    steps: list[Any] = [{"registry_name": name, "config": {}} for name in known]
    load(lerobot(tmp_path, steps))
    off = {"registry_name": "flip_frames", "config": {"enabled": False}}
    load(lerobot(tmp_path, [*steps, off]))
    for name, step in (
        ("flip_frames", {"registry_name": "flip_frames", "config": {"enabled": True}}),
        ("flip_frames", {"registry_name": "flip_frames"}),
        ("my.module.Flip", {"class": "my.module.Flip", "config": {}}),
        ("groot_n1_7_vlm_encode_v2", {"registry_name": "groot_n1_7_vlm_encode_v2", "config": {}}),
        ("a step without a name", 5),
    ):
        with pytest.raises(CheckpointError, match=rf"steps\[6\]: expected one of .*, got {name}"):
            load(lerobot(tmp_path, [*steps, step]))


@pytest.mark.parametrize(
    ("name", "fixture"),
    [
        ("groot_pack_inputs_v3", "n15_two_views"),
        ("groot_eagle_encode_v3", "n15_two_views"),
        ("groot_n1_7_pack_inputs_v1", "n17_one_view"),
        ("groot_n1_7_vlm_encode_v1", "n17_one_view"),
    ],
)
def test_keys_that_a_step_of_lerobot_does_not_have(tmp_path: Path, name: str, fixture: str) -> None:
    load(lerobot(tmp_path, [{"registry_name": name, "config": {"surprise": None}}], fixture))
    with pytest.raises(InputError, match=f"{name}: surprise: expected none"):
        load(lerobot(tmp_path, [{"registry_name": name, "config": {"surprise": 3}}], fixture))


def test_what_lerobots_step_leaves_out_has_the_default_of_its_class(tmp_path: Path) -> None:
    """No target: frames are not resized. The file of an NVIDIA checkpoint beside it plays no part."""
    encode = {"registry_name": "groot_n1_7_vlm_encode_v1", "config": {"model_name": "a/b"}}
    source = lerobot(tmp_path, [encode])
    write(source / "processor_config.json", {"processor_kwargs": {"use_albumentations": True}})
    expected = saccade.Processor(
        "n1.7", TOKENIZER, preprocessing="lerobot", options={"image_target_size": None}
    )
    assert_same(load(source).frame(NOISE), expected.frame(NOISE))


def test_an_nvidia_checkpoint_read_as_lerobot_reads_it(tmp_path: Path) -> None:
    """Its sizes count if it has a target; else those that lerobot writes."""
    kwargs: dict[str, Any] = {"use_albumentations": True, "shortest_image_edge": 64, "crop_fraction": 0.9}
    kwargs["letter_box_transform"] = True
    for target in (None, [96, 96]):
        source = isaac(tmp_path, image_target_size=target, image_crop_size=None, **kwargs)
        options = kwargs | {"image_target_size": target, "image_crop_size": None}
        if target is None:
            options |= {"image_target_size": [256, 256], "image_crop_size": [230, 230]}
            options |= {"shortest_image_edge": None, "crop_fraction": None}
        expected = saccade.Processor("n1.7", TOKENIZER, preprocessing="lerobot", options=options)
        assert_same(load(source, preprocessing="lerobot").frame(NOISE), expected.frame(NOISE))


# --- options in place of the checkpoint's ---


@pytest.mark.parametrize("version", ["n16", "n17"])
def test_single_options_are_replaced(tmp_path: Path, version: str) -> None:
    kwargs: dict[str, Any] = {"use_albumentations": True, "shortest_image_edge": 64, "crop_fraction": 0.9}
    kwargs |= {"image_target_size": [64, 64], "image_crop_size": [60, 60], "formalize_language": True}
    name: Any = f"{version[:2]}.{version[2]}"
    source = isaac(tmp_path, version, **kwargs)
    for replaced in (
        {"letter_box_transform": True},
        {"letter_box_transform": False},
        {"crop_fraction": 0.5, "shortest_image_edge": 96},
        {"crop_fraction": None, "shortest_image_edge": None},
        {"use_albumentations": False},
        {"formalize_language": False},
        {"min_pixels": 1},
        {"processor_kwargs": {"crop_fraction": 0.5}},
    ):
        expected = saccade.Processor(name, TOKENIZER, options=kwargs | replaced)([NOISE], "Push!")
        found = load(source, options=replaced)([NOISE], "Push!")
        assert_same(found.input_ids, expected.input_ids)
        assert_same(np.asarray(found.pixel_values), np.asarray(expected.pixel_values))
    assert_same(load(source, options={}).frame(NOISE), load(source).frame(NOISE))


def test_replaced_options_of_lerobot(tmp_path: Path) -> None:
    sizes = {"image_target_size": [64, 64], "image_crop_size": [58, 58]}
    source = lerobot(tmp_path, [{"registry_name": "groot_n1_7_vlm_encode_v1", "config": sizes}])
    options: dict[str, Any] = sizes | {"letter_box_transform": True}
    expected = saccade.Processor("n1.7", TOKENIZER, preprocessing="lerobot", options=options)
    assert_same(load(source, options={"letter_box_transform": True}).frame(NOISE), expected.frame(NOISE))


@pytest.mark.parametrize(
    ("replaced", "says"),
    [
        ({"letter_box": True}, "letter_box: expected a key of the released files"),
        ({"surprise": None}, "surprise: expected a key of the released files"),
        ({"clip_outliers": False}, "clip_outliers: expected a key about frames or words"),
        ({"use_percentiles": True, "b": 1}, "use_percentiles: expected a key about"),
        ({"letter_box_transform": "yes"}, "letter_box_transform: expected true or false"),
        ({"use_albumentations": False}, "image_target_size: expected a height and a width"),
        ([], "options: expected a mapping"),
    ],
)
def test_options_that_cannot_be_replaced(tmp_path: Path, replaced: Any, says: str) -> None:
    source = isaac(tmp_path, use_albumentations=True, shortest_image_edge=64, crop_fraction=0.9)
    with pytest.raises(InputError, match=says):
        load(source, options=replaced)


def test_lerobot_may_formalize_the_instructions_of_n15(tmp_path: Path) -> None:
    source = checkpoint(tmp_path / "n15", "n15_two_views", {"type": "groot"})
    steps = [{"registry_name": "groot_pack_inputs_v3", "config": {"formalize_language": True}}]
    (source / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    found = load(source)([NOISE], "Pick_up, THEN push!").input_ids
    plain = load(DATA / "n15_two_views.safetensors")([NOISE], "pickup then push").input_ids
    assert_same(found, plain)


@pytest.mark.parametrize("file", ["processor_config.json", "preprocessor_config.json", "config.json"])
@pytest.mark.parametrize("text", ["", "{", "[]", "7", '{"a": NaN}', "\udcff", '{"a":' * 10_000])
def test_files_that_are_none(tmp_path: Path, file: str, text: str) -> None:
    source = checkpoint(tmp_path / "broken", "n17_one_view")
    (source / file).write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(CheckpointError):
        load(source)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"crop_fraction": "1"},
        {"shortest_image_edge": 1 << 60},
        {"image_target_size": [[1], 2]},
        {"use_albumentations": "yes"},
        {"formalize_language": {}},
        {"min_pixels": -5},
    ],
)
def test_values_that_are_none(tmp_path: Path, kwargs: dict[str, Any]) -> None:
    source = checkpoint(tmp_path / "broken", "n17_one_view")
    (source / "processor_config.json").write_text(json.dumps({"processor_kwargs": kwargs}))
    with pytest.raises(InputError, match=next(iter(kwargs))):
        load(source)


def test_sources_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="source"):
        load(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match="source"):
        load(tmp_path)
    with pytest.raises(InputError, match="id_or_path: expected a path"):
        saccade.Processor.from_pretrained(7)  # type: ignore[arg-type]


def test_head_alone() -> None:
    """Its config says which version it is of."""
    processor = load(published("saccade"))
    assert processor.version in ("n1.5", "n1.6", "n1.7")


def test_frames_pass_unchanged_where_nothing_is_asked_for() -> None:
    """What the other tests of N1.7 build on."""
    image = NOISE[:64, :96]
    found = saccade.Processor("n1.7", TOKENIZER, options=AS_IT_IS).frame(image)
    assert found.shape == (24, 1536)
    assert found.max() == (image.max() - 127.5) / 127.5
