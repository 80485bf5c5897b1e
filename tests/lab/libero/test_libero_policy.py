"""Checkpoints as policies of LIBERO: observations in, actions of the environment out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.errors import InputError
from saccade_lab.libero.gripper import GripperRule, gripper_rule
from saccade_lab.libero.policy import LiberoPolicy, as_floats
from saccade_lab.libero.protocols import PROTOCOLS
from tests.helpers import libero_runs
from tests.helpers.libero_runs import INSTRUCTION, checkpoint, seen, whole

KEYS = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")


def policy_of(version: str, asked: str) -> LiberoPolicy:
    return LiberoPolicy(whole(version), checkpoint(version), asked)


@pytest.mark.parametrize("version", ["n1.6", "n1.7"])
def test_isaacs_client_gets_the_same_actions(version: str) -> None:
    """Beside what Isaac-GR00T's vector environment and `Gr00tSimPolicyWrapper` hand to a policy."""
    policy, shown = policy_of(version, "isaac-n17"), seen(256)
    state = shown["state"].reshape(1, 1, 8)
    nested = {
        "video": {name: shown["images"][name][None, None] for name in ("image", "wrist_image")},
        "state": {
            **{key: state[..., [place]] for place, key in enumerate(KEYS[:6])},
            "gripper": state[..., 6:],
        },
        "language": {"annotation.human.action.task_description": [[INSTRUCTION]]},
    }
    answer = whole(version).act(nested, seed=5)
    expected = np.concatenate([answer[key][0] for key in KEYS], axis=-1)
    chunk = policy.act(shown, seed=5)
    assert np.array_equal(chunk.actions[:, :6], expected[:, :6])
    assert np.array_equal(chunk.actions[:, 6], np.where(expected[:, 6] > 0.5, -1, 1))
    assert chunk.actions.shape == (16, 7)
    assert chunk.actions.dtype == np.float32
    assert set(chunk.seconds) == {"encode", "sample"}
    assert policy.execute_steps == 8


def test_n15s_client_gets_the_same_actions() -> None:
    """Beside the dictionary of `run_libero_eval.py`, and 8 denoising steps."""
    policy, shown = policy_of("n1.5", "isaac-n15"), seen(256)
    state = shown["state"]
    flat = {
        "video.image": shown["images"]["image"][None],
        "video.wrist_image": shown["images"]["wrist_image"][None],
        **{f"state.{key}": state[None, [place]] for place, key in enumerate(KEYS[:6])},
        "state.gripper": state[None, 6:],
        "annotation.human.action.task_description": [INSTRUCTION],
    }
    answer = whole("n1.5").act(flat, seed=5, num_steps=8)
    expected = [np.atleast_1d(answer[f"action.{key}"][0])[0] for key in KEYS]
    first = policy.act(shown, seed=5).actions[0]
    assert np.array_equal(first[:6], np.array(expected[:6], np.float32))
    assert first[6] == np.sign(1 - 2 * expected[6])
    assert (policy.execute_steps, policy.num_steps) == (1, 8)


def test_lerobots_form_is_lerobots() -> None:
    """Beside what lerobot's `preprocess_observation` and `LiberoProcessorStep` hand to saccade's plugin."""
    policy, shown = policy_of("n1.7", "lerobot"), seen(360)
    given = policy.observation(shown)
    for name in ("image", "wrist_image"):
        frame = shown["images"][name].astype(np.float32).transpose(2, 0, 1)
        frame /= 255
        assert np.array_equal(given[f"observation.images.{name}"], frame)
    batch = {key: value[None] if isinstance(value, np.ndarray) else [value] for key, value in given.items()}
    expected = whole("n1.7").act(batch, seed=2)[0]
    actions = policy.act(shown, seed=2).actions
    assert np.array_equal(actions[:, :6], expected[:, :6])
    assert np.array_equal(actions[:, 6], -np.sign(2 * expected[:, 6] - 1))


def test_every_value_of_a_pixel_survives_lerobots_floats() -> None:
    values = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=-1)
    floats = as_floats(values)
    assert floats.dtype == np.float32
    assert floats.shape == (3, 16, 16)
    assert np.array_equal((floats * 255).astype(np.uint8), np.moveaxis(values, -1, 0))


def test_the_seed_decides_the_actions() -> None:
    policy, shown = policy_of("n1.7", "auto"), seen(256)
    one, again, other = (policy.act(shown, seed=seed).actions for seed in (0, 0, 1))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
    turned = {**shown, "images": {name: frame[::-1] for name, frame in shown["images"].items()}}
    assert not np.array_equal(policy.act(turned, seed=0).actions, one)


@pytest.mark.parametrize(
    ("version", "asked", "steps", "rule", "reason"),
    [
        ("n1.7", "auto", 8, "-sign(2 g - 1)", "statistics from 0 to 1"),
        ("n1.7", "isaac-n17", 8, "-sign(2 g - 1)", "the program does it with every checkpoint"),
        ("n1.7", "lerobot", 8, "-sign(2 g - 1)", "lerobot does it for the embodiment libero_sim"),
        ("n1.6", "isaac-n17", 8, "-sign(2 g - 1)", "the program does it with every checkpoint"),
        ("n1.5", "auto", 1, "-sign(2 g - 1)", "statistics from 0 to 1"),
    ],
)
def test_the_record_says_what_was_chosen_and_why(
    version: str, asked: str, steps: int, rule: str, reason: str
) -> None:
    record = policy_of(version, asked).record(["libero_object"])
    assert record["execute_steps"] == steps
    assert record["gripper"]["rule"] == rule
    assert reason in record["gripper"]["reason"]
    assert record["cameras"] == {"image": "image", "wrist_image": "wrist_image"}
    assert record["preprocessing"] == "isaac"
    with_plugin = asked == "lerobot"
    assert ("saccade's plugin" in record["program"]) is with_plugin
    assert ("prepared by Isaac-GR00T's steps" in record["remark"]) is with_plugin
    if not with_plugin:
        assert f"Isaac-GR00T {version.upper()}" in record["program"]


def with_gripper(low: float, high: float, mode: str = "min_max") -> saccade.Policy:
    """The small N1.7 with other bounds of the gripper."""
    given = whole("n1.7")
    groups = [
        replace(group, mode=mode, first=np.array([low]), second=np.array([high]))
        if group.key == "gripper"
        else group
        for group in given.normalizer.action_groups
    ]
    normalizer = replace(given.normalizer, action_groups=tuple(groups))
    return saccade.Policy(
        given.head,
        normalizer,
        backbone=given.backbone,
        processor=given.processor,
        requirements=given.requirements,
    )


def test_auto_reads_the_gripper_from_the_statistics() -> None:
    protocol = PROTOCOLS["isaac-n17"]
    rule = gripper_rule(with_gripper(-1, 1), protocol, by_statistics=True)
    assert (rule.rule, rule.reason) == ("as given", "the checkpoint's statistics from -1 to 1")
    given = gripper_rule(with_gripper(-1, 1), protocol, by_statistics=False)
    assert given.rule == "-sign(2 g - 1)"
    assert given.reason.endswith("the checkpoint's statistics from -1 to 1 say as given")
    for low, high, mode in ((0, 0.5, "min_max"), (-0.1, 1.1, "q99"), (0, 1, "mean_std")):
        with pytest.raises(InputError, match="pass --protocol isaac-n17 to do what its program does"):
            gripper_rule(with_gripper(low, high, mode), protocol, by_statistics=True)
        assert gripper_rule(with_gripper(low, high, mode), protocol, by_statistics=False).rule.startswith("-")


@pytest.mark.parametrize("given", [0.0, 0.2, 0.5, 0.50001, 0.9, 1.0, -0.3, 1.4])
def test_the_gripper_is_that_of_the_released_clients(given: float) -> None:
    """Scaled to -1 and 1, then its sign, then inverted."""
    actions = np.zeros((2, 7), np.float32)
    actions[:, -1] = given
    scaled = 2 * (np.float32(given) - 0.0) / (1.0 - 0.0) - 1
    before = actions.copy()
    found = GripperRule("-sign(2 g - 1)", "").applied(actions)
    assert np.array_equal(found[:, -1], np.full(2, np.sign(scaled) * -1.0, np.float32))
    assert np.array_equal(actions, before)
    assert np.array_equal(GripperRule("as given", "").applied(actions), before)


def other_robot(version: str = "n1.7", **robot: Any) -> saccade.Policy:
    """The small policy with other requirements."""
    given = whole(version)
    found = saccade.Policy(
        given.head,
        given.normalizer,
        backbone=given.backbone,
        processor=given.processor,
        requirements=replace(given.requirements, **robot),
    )
    return found


def test_cameras_that_are_not_known_are_refused_by_name() -> None:
    camera = type(whole("n1.7").requirements.cameras[0])  # type: ignore[index]
    policy = other_robot(cameras=(camera("image"), camera("front")))
    with pytest.raises(InputError, match="image, image2, wrist_image, got front: which"):
        LiberoPolicy(policy, checkpoint("n1.7"), "auto")


def test_lerobots_name_of_the_wrist_camera_is_known() -> None:
    camera = type(whole("n1.7").requirements.cameras[0])  # type: ignore[index]
    policy = LiberoPolicy(
        other_robot(cameras=(camera("image"), camera("image2"))), checkpoint("n1.7"), "isaac-n17"
    )
    shown = seen(256)
    assert np.array_equal(policy.observation(shown)["video.image2"][0], shown["images"]["wrist_image"])
    assert policy.act(shown, seed=0).actions.shape == (16, 7)


def test_another_robot_is_refused_by_name(tmp_path: Path) -> None:
    from saccade_lab import random_checkpoint

    arm = random_checkpoint.write(
        tmp_path / "arm",
        "n1.7",
        backbone=random_checkpoint.small_backbone("n1.7"),
        head=random_checkpoint.small_head("n1.7"),
    )
    policy = saccade.Policy.from_pretrained(arm)
    with pytest.raises(InputError, match=r"actions of LIBERO.*got single_arm \(5\), gripper \(1\)"):
        LiberoPolicy(policy, arm, "isaac-n17")
    with pytest.raises(InputError, match="robot: unknown name 'table', expected one of arm, libero"):
        random_checkpoint.write(tmp_path / "none", "n1.7", robot="table")


@pytest.mark.parametrize("asked", ["auto", "isaac-n15"])
def test_n15_wants_its_data_config(asked: str) -> None:
    with pytest.warns(UserWarning, match="data_config"):
        policy = saccade.Policy.from_pretrained(checkpoint("n1.5"))
    with pytest.raises(InputError, match=r"--data-config: .*LiberoDataConfigMeanStd for libero_goal"):
        LiberoPolicy(policy, checkpoint("n1.5"), asked)


def test_a_checkpoint_must_say_its_cameras() -> None:
    with pytest.raises(InputError, match="cameras: expected names, but it does not say"):
        LiberoPolicy(other_robot(cameras=None), checkpoint("n1.7"), "isaac-n17")


def test_an_observation_that_is_not_whole_is_refused() -> None:
    policy, shown = policy_of("n1.7", "isaac-n17"), seen(256)
    with pytest.raises(InputError, match="wrist_image is missing"):
        policy.observation({**shown, "images": {"image": shown["images"]["image"]}})
    with pytest.raises(InputError, match=r"state: expected \(8,\), got \(7,\)"):
        policy.observation({**shown, "state": shown["state"][:7]})


def test_a_chunk_must_be_long_enough() -> None:
    given = whole("n1.7")
    normalizer = replace(given.normalizer, action_horizon=4)
    policy = saccade.Policy(
        given.head,
        normalizer,
        backbone=given.backbone,
        processor=given.processor,
        requirements=given.requirements,
    )
    with pytest.raises(InputError, match="executes 8 actions of a chunk, the checkpoint has 4"):
        LiberoPolicy(policy, checkpoint("n1.7"), "isaac-n17")
    assert LiberoPolicy(policy, libero_runs.checkpoint("n1.7"), "lerobot").execute_steps == 4
