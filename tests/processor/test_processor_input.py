"""Kinds of frames, order of views, batches, instructions, and everything that is refused."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.errors import CheckpointError, DtypeError, InputError, SaccadeError, ShapeError
from tests.helpers.processor_cases import AS_IT_IS, BLACK, TOKENIZER, assert_same, pixels_of

LEROBOT = saccade.Processor("n1.5", TOKENIZER, image_size=28)
ISAAC = saccade.Processor("n1.5", TOKENIZER, preprocessing="isaac", image_size=28)
N16 = saccade.Processor("n1.6", TOKENIZER)
N17 = saccade.Processor("n1.7", TOKENIZER)
ALL = (LEROBOT, ISAAC, N16, N17)
NOISE = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)


def same_inputs(found: saccade.BackboneInputs, expected: saccade.BackboneInputs) -> None:
    assert_same(pixels_of(found), pixels_of(expected))
    assert_same(found.input_ids, expected.input_ids)


# --- frames ---


def test_kinds_of_arrays() -> None:
    import torch

    expected = LEROBOT.frame(NOISE)
    planes = np.ascontiguousarray(np.moveaxis(NOISE, -1, 0))
    ones = planes.astype(np.float32) / 255
    turned = NOISE[::-1, ::-1].copy()[::-1, ::-1]  # negative strides
    for frame in (
        turned,
        planes,
        torch.from_numpy(NOISE.copy()),
        torch.from_numpy(planes),
        ones,
        torch.from_numpy(ones),
        np.moveaxis(ones, 0, -1),
        planes.astype(np.float64) / 255,
    ):
        assert_same(LEROBOT.frame(frame), expected)
    readonly = NOISE.copy()
    readonly.flags.writeable = False
    assert_same(LEROBOT.frame(readonly), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floating_point_frames_become_bytes_as_torch_makes_them(dtype: type) -> None:
    """Clamped, times 255, truncated; beyond 0 to 1 as lerobot has it."""
    import torch

    values: np.ndarray[Any, Any] = np.concatenate([np.arange(256) / 255, np.linspace(-0.5, 1.5, 500)]).astype(
        dtype
    )
    frame = np.repeat(values[:, None, None], 3, axis=2)[:, [0] * 4]
    planes = torch.from_numpy(np.moveaxis(frame, -1, 0).copy())
    expected = (planes.clamp(0, 1) * 255.0).to(torch.uint8)
    assert_same(LEROBOT.frame(planes), LEROBOT.frame(expected))


@pytest.mark.parametrize(
    ("frame", "error", "says"),
    [
        (np.zeros((40, 60), np.uint8), ShapeError, "RGB frame"),
        (np.zeros((40, 60, 1), np.uint8), ShapeError, "RGB frame"),
        (np.zeros((40, 60, 4), np.uint8), ShapeError, r"got \(40, 60, 4\)"),
        (np.zeros((1, 40, 60, 3), np.uint8), ShapeError, "RGB frame"),
        (np.zeros((0, 60, 3), np.uint8), ShapeError, "at least one pixel"),
        (np.zeros((40, 0, 3), np.uint8), ShapeError, "at least one pixel"),
        (np.zeros((40, 60, 3), np.int64), DtypeError, "int64"),
        (np.zeros((40, 60, 3), np.bool_), DtypeError, "bool"),
        (np.zeros((40, 60, 3), np.float16), DtypeError, "float16"),
        (np.zeros((40, 60, 3), np.uint16), DtypeError, "uint16"),
        ("front.png", DtypeError, "expected a frame"),
        ([[1, 2], [3]], ShapeError, "expected an array"),
        (None, DtypeError, "object"),
    ],
)
def test_frames_that_are_none(frame: Any, error: type[SaccadeError], says: str) -> None:
    for processor in ALL:
        with pytest.raises(error, match=says):
            processor.frame(frame)
        with pytest.raises(error, match=r"frames\['front'\]"):
            processor({"front": frame}, "push")


def test_values_that_are_not_finite() -> None:
    for bad in (np.nan, np.inf, -np.inf):
        frame = np.zeros((4, 4, 3))
        frame[1, 2, 0] = bad
        for dtype in (np.float32, np.float64):
            with pytest.raises(InputError, match="finite"):
                LEROBOT.frame(frame.astype(dtype))


def test_only_lerobot_takes_floating_point_frames_and_planes() -> None:
    for processor in (ISAAC, N16, N17):
        with pytest.raises(InputError, match="uint8"):
            processor.frame(np.zeros((40, 60, 3), np.float32))
        with pytest.raises(ShapeError, match=r"expected an RGB frame \(height, width, 3\)"):
            processor.frame(np.zeros((3, 40, 60), np.uint8))
    lerobot = saccade.Processor("n1.7", TOKENIZER, preprocessing="lerobot")
    assert_same(lerobot.frame(np.ones((3, 64, 64), np.float32)), lerobot.frame(BLACK + 255))


def test_frames_that_are_too_long() -> None:
    """As the released processors of N1.6 and N1.7 say; N1.5 makes a square of anything."""
    for processor in (N16, N17):
        with pytest.raises(InputError, match="differ by a factor of at most 200"):
            processor.frame(np.zeros((1, 201, 3), np.uint8))
        with pytest.raises(InputError, match="less elongated than 20000 x 1, which becomes 5120000 x 256"):
            processor.frame(np.zeros((20_000, 1, 3), np.uint8))
        processor.frame(np.zeros((1, 30, 3), np.uint8))


# --- views ---


def test_order_of_the_views() -> None:
    frames = {"wrist": BLACK, "front": BLACK + 255, "Side": NOISE}
    assert LEROBOT(frames, "push").view_names == ("Side", "front", "wrist")
    assert ISAAC(frames, "push").view_names == ("wrist", "front", "Side")
    by_name = [frames[name] for name in ("Side", "front", "wrist")]
    same_inputs(LEROBOT(frames, "push"), LEROBOT(by_name, "push"))
    same_inputs(ISAAC(frames, "push"), ISAAC(list(frames.values()), "push"))
    assert LEROBOT(by_name, "push").view_names is None
    assert ISAAC(by_name, "push", view_names=["a", "b", "c"]).view_names == ("a", "b", "c")


def test_a_sequence_is_in_the_order_of_the_prompt_whatever_its_names() -> None:
    views = [BLACK, NOISE]
    named = LEROBOT(views, "push", view_names=["z", "a"])
    assert named.view_names == ("z", "a")
    same_inputs(named, LEROBOT(views, "push"))


def test_views_may_differ_in_size_and_may_be_one_array() -> None:
    same_inputs(LEROBOT(np.stack([BLACK, BLACK]), "push"), LEROBOT((BLACK, BLACK), "push"))
    two = LEROBOT([BLACK, NOISE], "push")
    assert_same(pixels_of(two)[1], LEROBOT.frame(NOISE))


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ({}, "at least one view"),
        ([], "at least one view"),
        (NOISE, "expected a mapping of names to frames or a sequence of frames"),
        (None, "expected a mapping"),
        ("front", "expected a mapping"),
        ({1: NOISE}, "frames: expected a string"),
        ({"\ud800": NOISE}, "valid Unicode"),
    ],
)
def test_frames_without_views(frames: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        LEROBOT(frames, "push")


# --- batches ---


@pytest.mark.parametrize("processor", ALL, ids=lambda one: f"{one.version} {one.preprocessing}")
def test_a_batch_is_its_observations(processor: saccade.Processor) -> None:
    observations = [{"a": NOISE, "b": BLACK}, {"a": BLACK, "b": BLACK}, {"a": BLACK, "b": NOISE}]
    instructions = ["push", "open the drawer of the cabinet", "pick"]
    batch = processor(observations, instructions)
    longest = batch.input_ids.shape[1]
    pixels: list[Any] = []
    padding = processor.tokens("<|endoftext|>")[0]
    for row, (frames, instruction) in enumerate(zip(observations, instructions, strict=True)):
        alone = processor(frames, instruction)
        pad = longest - alone.input_ids.shape[1]
        assert_same(batch.input_ids[row, pad:], alone.input_ids[0])
        assert (batch.input_ids[row, :pad] == padding).all()
        assert not batch.attention_mask[row, :pad].any()
        assert batch.attention_mask[row, pad:].all()
        pixels.extend(alone.pixel_values)
    for found, expected in zip(batch.pixel_values, pixels, strict=True):
        assert_same(found, expected)
    assert batch.view_names == ("a", "b")


@pytest.mark.parametrize(
    ("frames", "instruction", "says"),
    [
        ([[NOISE], [NOISE]], ["push"], "expected one for each of 2 observations"),
        ([[NOISE], [NOISE]], "push", "expected a list of 2"),
        ({"a": NOISE}, ["push"], "expected a list of 1 observations"),
        ([NOISE], ["push"], "expected a list of 1 observations"),
        ([[NOISE], [NOISE, NOISE]], ["push", "push"], "the same views in every observation"),
        ([{"a": NOISE}, {"b": NOISE}], ["push", "push"], "got a and b"),
        ([{"a": NOISE}, [NOISE]], ["push", "push"], "got a and 1 views"),
        ([{"a": NOISE}, NOISE], ["push", "push"], "expected a mapping"),
        ([], [], "expected a list of 0 observations"),
        ([[NOISE]], [7], "instruction: expected a string"),
    ],
)
def test_batches_that_are_none(frames: Any, instruction: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        LEROBOT(frames, instruction)


def test_a_batch_without_instructions() -> None:
    same_inputs(LEROBOT([[NOISE], [BLACK]]), LEROBOT([[NOISE], [BLACK]], ["Perform the task."] * 2))


# --- instructions ---


@pytest.mark.parametrize(
    ("processor", "nothing", "default"),
    [
        (LEROBOT, (None, ""), "Perform the task."),
        (saccade.Processor("n1.7", TOKENIZER, preprocessing="lerobot"), (None, ""), "perform the task"),
        (ISAAC, (None,), "Perform the default behavior."),
    ],
)
def test_released_defaults(processor: saccade.Processor, nothing: Sequence[str | None], default: str) -> None:
    for instruction in nothing:
        same_inputs(processor([BLACK], instruction), processor([BLACK], default))
    same_inputs(processor([BLACK]), processor([BLACK], default))


def test_no_instruction_where_nothing_is_released() -> None:
    for processor in (N16, N17):
        with pytest.raises(InputError, match="instruction: expected text: Isaac-GR00T N1"):
            processor([BLACK])
        processor([BLACK], "")


def test_special_tokens_in_an_instruction_become_tokens() -> None:
    ids = LEROBOT([BLACK], "a <|im_end|> inside").input_ids[0]
    end = LEROBOT.tokens("<|im_end|>")[0]
    assert (ids == end).sum() == 1 + (LEROBOT([BLACK], "a inside").input_ids == end).sum()
    # What is left of it is a word.
    same_inputs(N17([BLACK], "a <|im_end|> inside"), N17([BLACK], "a im_end inside"))


@pytest.mark.parametrize("token", ["<IMG_CONTEXT>", "put it on <IMG_CONTEXT><IMG_CONTEXT>"])
def test_tokens_that_stand_for_images_are_refused(token: str) -> None:
    plain = saccade.Processor("n1.5", TOKENIZER, plain_text=True)
    for processor in (LEROBOT, ISAAC, plain):
        with pytest.raises(InputError, match="instruction: expected no token that stands for an image, got"):
            processor([BLACK], token)
    raw = saccade.Processor("n1.7", TOKENIZER, options={"formalize_language": False})
    with pytest.raises(InputError, match="got 2 of them"):
        raw([BLACK], "<|image_pad|> and <|image_pad|>")


@pytest.mark.parametrize("text", ["<image-2>", "go to <video-1>", "<image-0>", "<image-\u0662>"])
def test_placeholders_are_refused(text: str) -> None:
    """The released processors would put a frame there, and shift those of the other samples of a batch."""
    raw = saccade.Processor("n1.6", TOKENIZER, options={"formalize_language": False})
    for processor in (LEROBOT, ISAAC, raw):
        with pytest.raises(InputError, match="placeholders that stand for a frame"):
            processor([BLACK, BLACK], text)
    N17([BLACK], text)
    N16([BLACK], text)
    LEROBOT([BLACK], "<image 2> <image-x> image-2")


def test_long_instructions() -> None:
    words = "open the drawer " * 200
    ids = LEROBOT([BLACK], words).input_ids
    assert ids.shape[1] > 600
    with pytest.raises(InputError, match="at most 40960 tokens"):
        LEROBOT([BLACK], "7" * 50_000)
    for processor in ALL:
        with pytest.raises(InputError, match="instruction: expected at most 262144 bytes of text"):
            processor([BLACK], "x" * 300_000)
        with pytest.raises(InputError, match="text: expected at most 262144 bytes of text"):
            processor.tokens("x" * 300_000)


@pytest.mark.parametrize("piece", [" ", "\n", " \n", "a ", "\u3000", "'", "\u0301", "<", "7"])
def test_the_longest_text_is_split_to_its_end(piece: str) -> None:
    """The pattern that splits text gives up silently on a million steps."""
    text = piece * (262_144 // len(piece.encode()) - 1) + "x"
    from tokenizers import Tokenizer

    expected = Tokenizer.from_file(str(TOKENIZER)).encode(text, add_special_tokens=False).ids
    assert_same(LEROBOT.tokens(text), np.asarray(expected))


@pytest.mark.parametrize("instruction", [b"push", 7, ["push"], "\ud800", np.array("push")])
def test_instructions_that_are_no_text(instruction: Any) -> None:
    with pytest.raises(InputError):
        LEROBOT({"front": BLACK}, instruction)


# --- arguments ---


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"version": "n1"}, 'version: expected "n1.5", "n1.6" or "n1.7"'),
        ({"version": "N1.5"}, "version: expected"),
        ({"version": 1.5}, "version: expected a string"),
        ({"preprocessing": "gr00t"}, 'preprocessing: expected "lerobot" or "isaac", got "gr00t"'),
        ({"preprocessing": True}, "preprocessing: expected a string"),
        ({"version": "n1.6", "preprocessing": "lerobot"}, "lerobot has no N1.6"),
        ({"image_size": 0}, "image_size: expected at least 1"),
        ({"image_size": 1 << 20}, "image_size: expected 1 to 4096"),
        ({"image_size": 13}, "tokens_per_view: expected"),
        ({"tokens_per_view": 2.0}, "tokens_per_view: expected an integer"),
        ({"version": "n1.7", "image_size": 256}, "image_size: expected none for N1.7"),
        ({"plain_text": 1}, "plain_text: expected True or False"),
        ({"tokenizer": 3}, "tokenizer: expected a path"),
        ({"tokenizer": "a\0b"}, "tokenizer: expected a path"),
        ({"options": []}, "options: expected a mapping"),
        ({"options": {"crop": 0.9}}, "crop: expected a key of the released files"),
        (
            {"options": {"crop_fraction": 1.5}},
            "crop_fraction: expected a number above 0 and up to 1, got 1.5",
        ),
        ({"options": {"crop_fraction": float("nan")}}, "values that JSON can represent"),
        ({"options": {"image_mean": [0.4, 0.5, 0.5]}}, "image_mean: expected 0.5"),
        ({"options": {"do_normalize": False}}, "do_normalize: expected true"),
        ({"options": {"resample": 2}}, "resample: expected 3"),
        ({"options": {"rescale_factor": 1.0}}, "rescale_factor: expected 1 / 255"),
        ({"options": {"size": {"height": 3, "width": 4}}}, "size: expected an equal height and width"),
        (
            {"version": "n1.7", "options": {"shortest_image_edge": -1}},
            "shortest_image_edge: expected a whole",
        ),
        ({"version": "n1.7", "options": {"shortest_image_edge": 1 << 40}}, "shortest_image_edge"),
        ({"version": "n1.7", "options": {"image_target_size": [1]}}, "image_target_size: expected a height"),
        ({"version": "n1.7", "options": {"min_pixels": 9, "max_pixels": 8}}, "min_pixels: expected at most"),
        ({"version": "n1.7", "options": {"patch_size": 14}}, "patch_size: expected 16"),
        ({"version": "n1.7", "options": {"use_albumentations": 1}}, "use_albumentations: expected true or"),
        ({"version": "n1.7", "options": {"processor_kwargs": 1}}, "processor_kwargs: expected an object"),
        ({"version": "n1.7", "options": {"use_tactile": True}}, "use_tactile: expected false"),
    ],
)
def test_arguments_that_are_refused(arguments: dict[str, Any], says: str) -> None:
    given: dict[str, Any] = {"version": "n1.5", "tokenizer": TOKENIZER} | arguments
    with pytest.raises(InputError, match=says):
        saccade.Processor(**given)


def test_all_problems_of_the_options_are_listed() -> None:
    options = {"crop_fraction": "half", "min_pixels": 0, "nothing": 1}
    with pytest.raises(InputError) as error:
        saccade.Processor("n1.7", TOKENIZER, options=options)
    assert all(key in str(error.value) for key in options)


def test_keys_of_the_whole_released_file_are_taken() -> None:
    whole = {
        "processor_class": "Gr00tN1d7Processor",
        "processor_kwargs": {"modality_configs": {}, "crop_fraction": 0.95, "max_action_dim": 132},
    }
    found = saccade.Processor("n1.7", TOKENIZER, options=whole)
    assert_same(found.frame(NOISE), N17.frame(NOISE))


def test_letter_boxes_are_black_bars() -> None:
    for height, width in itertools.permutations((20, 50)):
        image = np.full((height, width, 3), 255, np.uint8)
        square = np.zeros((50, 50, 3), np.uint8)
        top, left = (50 - height) // 2, (50 - width) // 2
        square[top : top + height, left : left + width] = 255
        options = AS_IT_IS | {"letter_box_transform": True}
        boxed = saccade.Processor("n1.7", TOKENIZER, options=options)
        assert_same(boxed.frame(image), saccade.Processor("n1.7", TOKENIZER, options=AS_IT_IS).frame(square))


def test_a_tokenizer_without_the_tokens_of_the_version(tmp_path: Any) -> None:
    text = TOKENIZER.read_text().replace("<IMG_CONTEXT>", "<IMAGE>").replace("<|image_pad|>", "<|picture|>")
    path = tmp_path / "tokenizer.json"
    path.write_text(text)
    for version, token in (("n1.5", "<IMG_CONTEXT>"), ("n1.7", r"<\|image_pad\|>")):
        with pytest.raises(CheckpointError, match=f"the special tokens of .* are missing: {token}"):
            saccade.Processor(version, path)  # type: ignore[arg-type]
