"""What observations of N1.5 and of lerobot may contain, for robots whose requirements the tests write out."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from saccade import DtypeError, InputError, ShapeError
from saccade.observations import Camera, Requirements, read

Observation = dict[str, Any]


#: Isaac-GR00T N1.5's, and lerobot's N1.7.
N15 = Requirements(
    embodiment="robot",
    cameras=(Camera("front", 6, 8), Camera("wrist", 6, 8)),
    state=(("arm", 5), ("grip", 1)),
    video_horizon=1,
    language_keys=("annotation.human.action.task_description",),
    any_annotation=True,
)
LEROBOT = Requirements(
    embodiment="robot",
    cameras=(Camera("wrist_image", alias="image2"), Camera("front")),
    state=(("arm", 5), ("grip", 1)),
    video_horizon=2,
    language_keys=("task",),
)


def n15(batch: int | None = 2) -> Observation:
    """An observation for `N15` without words; without a batch axis if `batch` is None."""
    rng = np.random.default_rng(0)
    axes = (1,) if batch is None else (batch, 1)
    frames = {
        f"video.{name}": rng.integers(0, 256, (*axes, 6, 8, 3), np.uint8) for name in ("front", "wrist")
    }
    return frames | {f"state.{key}": rng.random((*axes, width), np.float32) for key, width in N15.state}


def test_n15_ignores_what_it_does_not_need_and_takes_any_one_annotation() -> None:
    given = n15() | {
        "video.top": np.zeros((2, 1, 3, 3, 3)),
        "state.base": np.zeros((2, 3)),  # makes the released code fail; we decide by the keys of the robot
        "pose": "none",
        "my_annotations": ["a", "b"],
        "task": 5,
    }
    parsed = read(given, N15)
    assert (parsed.is_batched, parsed.instructions, parsed.is_plain) == (True, ("a", "b"), True)
    assert tuple(parsed.frames[0]) == ("front", "wrist")
    with pytest.raises(InputError, match=r"one instruction, got my_annotations, annotation\.b"):
        read(given | {"annotation.b": ["a", "b"]}, N15)
    for wrong in ("a", ["a"], np.array("a"), [["a", "b"], ["c", "d"]]):
        with pytest.raises((InputError, ShapeError), match="annotation"):
            read(n15() | {"annotation.a": wrong}, N15)
    missing = {key: value for key, value in given.items() if not key.startswith("state.")}
    with pytest.raises(
        InputError, match=r"state\.arm, state\.grip: expected arm, grip too, got none; .*needs"
    ):
        read(missing, N15)


@pytest.mark.parametrize(
    ("text", "is_plain"),
    [(["a"], False), (np.array(["a"]), False), (("a",), True), (np.array("a"), True), ("a", False)],
)
def test_n15s_prompt_of_one_observation_shows_lists_as_lists(text: Any, is_plain: bool) -> None:
    parsed = read(n15(None) | {"annotation.a": text}, N15)
    assert (parsed.instructions, parsed.is_plain) == (("a",), is_plain)


def lerobots(batch: int = 2) -> Observation:
    """An observation for `LEROBOT` with frames of two sizes."""
    rng = np.random.default_rng(0)
    return {
        "observation.images.front": rng.integers(0, 256, (batch, 3, 4, 5), np.uint8),
        "observation.images.wrist_image": rng.integers(0, 256, (batch, 3, 6, 8), np.uint8),
        "observation.state": rng.integers(-9, 9, (batch, 6)).astype(np.float32),
        "task": "a",
    }


def test_lerobots_cameras_are_those_of_the_checkpoint_or_all() -> None:
    given = lerobots() | {"observation.images.top": np.zeros((2, 3, 2, 2), np.uint8)}
    one = replace(LEROBOT, video_horizon=1)
    assert list(read(given, one).frames[0]) == ["wrist_image", "front"]
    every = replace(one, cameras=(Camera("front"),), takes_extra_cameras=True)
    assert list(read(given, every).frames[0]) == ["front", "top", "wrist_image"]
    nested_too = {
        "video": {name: np.zeros((1, 1, 2, 2, 3), np.uint8) for name in ("top", "front")},
        "state": {"arm": np.zeros((1, 1, 5)), "grip": np.zeros((1, 1, 1))},
        "language": {"task": [["a"]]},
    }
    assert list(read(nested_too, every).frames[0]) == ["front", "top"]
    given["observation.images.image2"] = given.pop("observation.images.wrist_image")
    parsed = read(given, one)
    assert np.array_equal(parsed.frames[1]["wrist_image"][..., 0], given["observation.images.image2"][1, 0])
    del given["observation.images.image2"]
    with pytest.raises(InputError, match=r"observation\.images\.wrist_image: .*wrist_image or image2, front"):
        read(given, one)
    del given["observation.images.front"]
    with pytest.raises(InputError, match=r"observation\.images\.front: expected cameras front, got top"):
        read(given, every)


def test_lerobots_frames_are_the_last_ones_or_the_first_repeated() -> None:
    given = lerobots()
    still = given["observation.images.wrist_image"]
    several = np.random.default_rng(1).integers(0, 256, (2, 3, 3, 4, 5), np.uint8)
    given["observation.images.front"] = several
    frames = read(given, LEROBOT).frames[1]
    assert list(frames) == ["wrist_image[0]", "front[0]", "wrist_image[1]", "front[1]"]
    for time in range(2):
        assert np.array_equal(frames[f"front[{time}]"], several[1, time + 1].transpose(1, 2, 0))
        assert np.array_equal(frames[f"wrist_image[{time}]"], still[1].transpose(1, 2, 0))
    longer = read(given, replace(LEROBOT, video_horizon=4)).frames[0]
    assert np.array_equal(longer["front[0]"], several[0, 0].transpose(1, 2, 0))
    assert np.array_equal(longer["front[1]"], longer["front[0]"])
    with pytest.raises(ShapeError, match="as many of every camera, got wrist_image 1, front 3"):
        read(given, replace(LEROBOT, video_horizon=None))


def test_lerobots_keys_are_renamed_first() -> None:
    needs = replace(
        LEROBOT,
        rename_map=(
            ("observation.images.top", "observation.images.front"),
            ("observation.pose", "observation.state"),
        ),
    )
    given = lerobots()
    expected = read(given, LEROBOT)
    renamed = dict(given)
    renamed["observation.images.top"] = renamed.pop("observation.images.front")
    renamed["observation.pose"] = renamed.pop("observation.state")
    for one in (given, renamed):
        parsed = read(one, needs)
        assert np.array_equal(parsed.state, expected.state)
        for found, other in zip(parsed.frames, expected.frames, strict=True):
            assert list(found) == list(other)
            assert all(np.array_equal(found[name], other[name]) for name in found)
    both = r"after renaming, got observation\.images\.front and observation\.images\.top"
    with pytest.raises(InputError, match=both):
        read(given | {"observation.images.top": given["observation.images.front"]}, needs)
    assert "after renaming observation.images.top to observation.images.front" in str(needs)


def test_integer_states_that_float32_holds_are_taken() -> None:
    given = lerobots()
    state = given["observation.state"]
    expected = read(given, LEROBOT).state
    for same in (
        state.astype(np.int64),
        state.astype(np.int8),
        state.tolist(),
        state.astype(int).tolist(),
        torch.from_numpy(state).long(),
    ):
        assert np.array_equal(read(given | {"observation.state": same}, LEROBOT).state, expected)
    exact = np.full((2, 6), 2**60)
    assert read(given | {"observation.state": exact}, LEROBOT).state[0, 0, 0] == 2**60
    for number in (2**60 + 1, 2**63 - 1):
        with pytest.raises(
            DtypeError, match=rf"observation\.state: .*astype\(np\.float32\), got int64 {number}"
        ):
            read(given | {"observation.state": np.full((2, 6), number)}, LEROBOT)
    with pytest.raises(InputError, match=r"got NaN or infinity in columns 4, 5 \(arm, grip\)"):
        read(given | {"observation.state": np.array([[0, 1, 2, 3, np.inf, np.nan]] * 2)}, LEROBOT)


def test_an_empty_text_is_lerobots_default_and_isaacs_text() -> None:
    given = lerobots()
    with pytest.warns(UserWarning, match="task: there is no instruction; the released default is used"):
        assert read(given | {"task": ""}, LEROBOT).instructions == (None, None)
    strict = replace(LEROBOT, requires_language=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(given | {"task": ""}, strict).instructions == ("", "")
        assert read(given, LEROBOT).instructions == ("a", "a")
    with pytest.raises(InputError, match="task: expected an instruction, got none"):
        read(given | {"task": None}, strict)
    with pytest.raises(InputError, match=r"language\.task: expected the key task, got other"):
        read(
            {
                "video": {name: np.zeros((1, 2, 2, 2, 3), np.uint8) for name in ("front", "image2")},
                "state": {"arm": np.zeros((1, 1, 5)), "grip": np.zeros((1, 1, 1))},
                "language": {"other": [["a"]]},
            },
            LEROBOT,
        )


def test_requirements_are_one_sentence() -> None:
    assert str(N15) == (
        "embodiment 'robot' needs cameras front (6 x 8), wrist (6 x 8); state keys arm (5), grip (1); an "
        "instruction under one key that contains 'annotation'"
    )
    many = replace(LEROBOT, language_keys=("task", "subtask"), takes_extra_cameras=True)
    assert str(many) == (
        "embodiment 'robot' needs cameras wrist_image or image2, front with 2 frames each (others are views "
        "too, all sorted by name); state keys arm (5), grip (1); language keys task, subtask (the first is "
        "the instruction)"
    )
