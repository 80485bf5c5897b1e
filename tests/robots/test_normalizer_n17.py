"""A robot's units to the head's and back as Isaac-GR00T's N1.6 and N1.7 do it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import Normalizer
from tests.helpers.normalizer_cases import as_array, draw, load_processor, processor, row
from tests.helpers.paths import DATA
from tests.helpers.published import sidecars


@pytest.mark.parametrize("percentiles", [False, True])
@pytest.mark.parametrize("clip", [False, True])
def test_n17_clips_scales_and_cuts_the_chunk(percentiles: bool, clip: bool, tmp_path: Path) -> None:
    config, statistics = processor(use_percentiles=percentiles, clip_outliers=clip)
    normalizer = load_processor(tmp_path, config, statistics)
    low, high = (
        np.array(statistics["robot"]["state"]["arm"][name])
        for name in (("q01", "q99") if percentiles else ("min", "max"))
    )
    state, chunk = draw(3, 4), draw(3, 6, 8)
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = 2 * (state[:, :3] - low) / (high - low) - 1
    expected[:, 1] = 0  # the constant one
    found = as_array(normalizer.state(state))
    assert np.allclose(found[:, :3], expected.clip(-1, 1) if clip else expected, atol=1e-6)
    assert normalizer.embodiment_id == 5
    robot = as_array(normalizer.actions(chunk))
    assert robot.shape == (3, 4, 4)
    # Values from the head are clipped with either setting.
    back = (chunk[:, :4, :3].clip(-1, 1) + 1) / 2 * (high - low) + low
    assert np.allclose(robot[..., :3], back, atol=1e-6)


def test_n17_takes_nearly_equal_bounds_for_constant(tmp_path: Path) -> None:
    config, statistics = processor()
    arm = statistics["robot"]["state"]["arm"]
    arm["min"][0], arm["max"][0] = 1.0, 1.0 + 1e-9
    assert as_array(load_processor(tmp_path, config, statistics).state(draw(1, 4)))[0, 0] == 0


def test_n17_mean_and_deviation_and_sine_and_cosine_by_key(tmp_path: Path) -> None:
    config, statistics = processor(
        state={"mean_std_embedding_keys": ["gripper"], "sin_cos_embedding_keys": ["arm"]},
        action={"mean_std_embedding_keys": ["arm"]},
        apply_sincos_state_encoding=True,
    )
    normalizer = load_processor(tmp_path, config, statistics)
    arm, gripper = (statistics["robot"]["state"][key] for key in ("arm", "gripper"))
    state = draw(2, 4)
    found = as_array(normalizer.state(state))
    assert np.allclose(found[:, :6], np.concatenate([np.sin(state[:, :3]), np.cos(state[:, :3])], 1))
    assert np.allclose(found[:, 6], (state[:, 3] - gripper["mean"][0]) / gripper["std"][0], atol=1e-5)
    chunk = draw(1, 4, 8)
    expected = chunk[..., :3] * np.array(arm["std"]) + np.array(arm["mean"])
    expected[..., 1] = chunk[..., 1]  # no deviation: as it is
    assert np.allclose(as_array(normalizer.actions(chunk))[..., :3], expected, atol=1e-6)
    with pytest.raises(saccade.InputError, match="got 'sin_cos'"):
        normalizer.denormalize_state(found)


RELATIVE = {"rep": "RELATIVE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
ABSOLUTE = {**RELATIVE, "rep": "ABSOLUTE"}


def relative(folder: Path, *, by_step: bool) -> tuple[Normalizer, dict[str, Any]]:
    config, statistics = processor(action={"action_configs": [RELATIVE, ABSOLUTE]}, use_relative_action=True)
    rows = [row(3, 10 + step, constant=None) for step in range(4)]
    if by_step:
        own: dict[str, Any] = {name: [row[name] for row in rows] for name in ("min", "max", "mean", "std")}
    else:
        own = rows[0]
    statistics["robot"]["relative_action"] = {"arm": own}
    return load_processor(folder, config, statistics), statistics


@pytest.mark.parametrize("by_step", [False, True])
def test_relative_actions_are_added_to_the_state(by_step: bool, tmp_path: Path) -> None:
    normalizer, statistics = relative(tmp_path, by_step=by_step)
    own = statistics["robot"]["relative_action"]["arm"]
    low, high = np.array(own["min"]), np.array(own["max"])
    state, chunk = draw(2, 4), draw(2, 4, 8, scale=0.4)
    robot = as_array(normalizer.actions(chunk, state))
    expected = (chunk[..., :3] + 1) / 2 * (high - low) + low + state[:, None, :3]
    assert np.allclose(robot[..., :3], expected, atol=1e-5)
    alone = Normalizer.from_pretrained(tmp_path).actions(chunk, np.zeros((2, 4)))
    assert np.array_equal(robot[..., 3], as_array(alone)[..., 3])  # the gripper is not relative
    # Of a history the newest state counts; samples share it; without a batch it works too.
    history = np.stack([draw(2, 4, seed=9), state], axis=1)
    assert np.array_equal(as_array(normalizer.actions(chunk, history)), robot)
    samples = as_array(normalizer.actions(np.repeat(chunk[:, None], 3, axis=1), state))
    assert np.array_equal(samples, np.repeat(robot[:, None], 3, axis=1))
    assert np.array_equal(as_array(normalizer.actions(chunk[1], state[1])), robot[1])
    back = as_array(normalizer.normalize_actions(robot, state))
    assert np.allclose(back[..., [0, 1, 2]], chunk[..., [0, 1, 2]], atol=1e-5)
    with pytest.raises(saccade.InputError, match="the actions of arm are relative to it"):
        normalizer.actions(chunk)
    with pytest.raises(saccade.ShapeError, match="expected a shape that fits actions"):
        normalizer.actions(chunk, draw(3, 4))


def test_statistics_of_each_step_need_their_steps(tmp_path: Path) -> None:
    normalizer, _ = relative(tmp_path, by_step=True)
    with pytest.raises(saccade.ShapeError, match="arm has statistics of 4 steps"):
        normalizer.normalize_actions(draw(1, 5, 4), draw(1, 4))


def pose_robot(folder: Path, pose: str, size: int) -> Normalizer:
    """A robot of one pose and one gripper, whose bounds are far out, so that nothing is clipped."""
    config, statistics = processor(
        action={"action_configs": [{**RELATIVE, "type": "EEF", "format": pose}, ABSOLUTE]},
        use_relative_action=True,
        max_state_dim=12,
        max_action_dim=12,
    )
    wide = {"min": [-9.0] * size, "max": [9.0] * size, "mean": [0.0] * size, "std": [1.0] * size}
    one = {name: row[:1] for name, row in wide.items()}
    statistics["robot"] = {
        "state": {"arm": wide, "gripper": one},
        "action": {"arm": wide, "gripper": one},
        "relative_action": {"arm": wide},
    }
    return load_processor(folder, config, statistics)


@pytest.mark.parametrize(("pose", "size"), [("XYZ_ROT6D", 9), ("XYZ_ROTVEC", 6)])
def test_a_chunk_of_poses_goes_on_from_another_state(pose: str, size: int, tmp_path: Path) -> None:
    """The poses that the robot is executing stay where they are, whatever they are relative to."""
    normalizer = pose_robot(tmp_path, pose, size)
    first, second = draw(2, size + 1, seed=1), draw(2, size + 1, seed=2)
    robot = as_array(normalizer.actions(draw(2, 4, 12, scale=0.2), first))
    again = as_array(normalizer.actions(normalizer.previous_chunk(robot, second), second))
    assert np.allclose(again, robot, atol=2e-5)
    assert not np.allclose(normalizer.previous_chunk(robot, second), normalizer.previous_chunk(robot, first))


@pytest.mark.parametrize("ids", [{"robot": "7"}, {"robot": 7.0}, {"robot": [7]}, {"robot": -1}])
def test_an_id_that_is_none_is_refused(ids: dict[str, Any], tmp_path: Path) -> None:
    load_processor(tmp_path, *processor())
    (tmp_path / "embodiment_id.json").write_text(json.dumps(ids))
    with pytest.raises(saccade.CheckpointError, match=r"embodiment ids: expected integers .* robot \("):
        Normalizer.from_pretrained(tmp_path)


def test_statistics_by_step_are_for_actions(tmp_path: Path) -> None:
    config, statistics = processor()
    own = statistics["robot"]["state"]["arm"]
    statistics["robot"] = {**statistics["robot"], "state": {**statistics["robot"]["state"]}}
    statistics["robot"]["state"]["arm"] = {name: [row, row] for name, row in own.items()}
    with pytest.raises(saccade.CheckpointError, match="arm: expected one row of statistics, got 2"):
        load_processor(tmp_path, config, statistics)


def test_a_tag_of_a_fork_is_found_although_the_release_calls_another_so(tmp_path: Path) -> None:
    config, statistics = processor()
    config["processor_class"] = "Gr00tN1d7Processor"
    configs = config["processor_kwargs"]["modality_configs"]
    configs["libero_panda"] = configs.pop("robot")
    load_processor(tmp_path, config, {"libero_panda": statistics["robot"]})
    assert Normalizer.from_pretrained(tmp_path, "libero_panda").embodiment == "libero_panda"


def test_numbers_that_are_no_pose_are_refused_by_name(tmp_path: Path) -> None:
    normalizer = pose_robot(tmp_path, "XYZ_ROT6D", 9)
    chunk = np.zeros((1, 4, 12), np.float32)
    with pytest.raises(saccade.InputError, match=r"arm: expected poses, and state\.arm to be one"):
        normalizer.actions(chunk, np.ones((1, 10), np.float32))
    with pytest.raises(saccade.InputError, match=r"arm: expected poses, and state\.arm to be one"):
        normalizer.actions(draw(1, 4, 12), np.zeros((1, 10), np.float32))
    parallel = np.array([[0, 0, 0, 0.1, 0.2, 0.3, 0.2, 0.4, 0.6, 0]], np.float32)
    with pytest.raises(saccade.InputError, match=r"arm: expected poses, and state\.arm to be one"):
        normalizer.actions(draw(1, 4, 12), parallel)


def test_what_n17_can_say_and_is_not_supported(tmp_path: Path) -> None:
    with pytest.raises(saccade.CheckpointError, match="tactile"):
        load_processor(tmp_path, *processor(use_tactile=True))


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"surprise": 1}, r"processor_kwargs: surprise \(1\) is not known"),
        ({"state": {"pass_through_keys": ["arm"]}}, "state: pass_through_keys"),
        ({"state": {"exclude_state": True}}, "state: exclude_state"),
        ({"state": {"delta_indices": None}}, "state: expected delta_indices"),
        ({"action": {"action_configs": [ABSOLUTE]}}, "expected one of action_configs for each"),
        ({"action": {"action_configs": [{**ABSOLUTE, "normalization_type": "skip"}, ABSOLUTE]}},
         "action.arm: normalization_type"),
        ({"action": {"action_configs": [{**ABSOLUTE, "rep": "REL_XYZ_ROT6D"}, ABSOLUTE]}},
         "action.arm: rep: expected one of RELATIVE, DELTA, ABSOLUTE, got 'REL_XYZ_ROT6D'"),
        ({"use_percentiles": "yes"}, "use_percentiles: expected true or false"),
        ({"max_state_dim": None}, "max_state_dim: expected a positive integer"),
    ],
)  # fmt: skip
def test_what_is_not_known_is_refused_by_name(changes: dict[str, Any], problem: str, tmp_path: Path) -> None:
    with pytest.raises(saccade.CheckpointError, match=problem):
        load_processor(tmp_path, *processor(**changes))


def test_what_is_not_known_may_be_off(tmp_path: Path) -> None:
    off: dict[str, Any] = {"surprise": None, "twist": False, "names": [], "state": {"pass_through_keys": []}}
    load_processor(tmp_path, *processor(**off))


def test_processor_files_may_lie_in_processor(tmp_path: Path) -> None:
    config, statistics = processor()
    plain = load_processor(tmp_path / "plain", config, statistics)
    load_processor(tmp_path / "other" / "processor", config, statistics)
    found = Normalizer.from_pretrained(tmp_path / "other")
    assert np.array_equal(as_array(found.state(draw(2, 4))), as_array(plain.state(draw(2, 4))))
    assert found.embodiment_id == plain.embodiment_id == 5


def test_a_robot_is_named_as_its_release_names_it(tmp_path: Path) -> None:
    folder = DATA / "robots" / "n16_n17" / "04-n17-bimanual-rot6d"
    for name in ("XDOF", " xdof ", "xdof_relative_eef_relative_joint", 27):
        assert Normalizer.from_pretrained(folder, name).embodiment == "xdof_relative_eef_relative_joint"
    with pytest.raises(saccade.InputError, match=r"expected one of those in .*, got 'UNITREE_G1'"):
        Normalizer.from_pretrained(folder, "UNITREE_G1")


def test_a_head_trained_without_a_state_gets_zeros(tmp_path: Path) -> None:
    normalizer = load_processor(tmp_path, *processor(exclude_state=True))
    assert not as_array(normalizer.state(draw(2, 4))).any()
    with pytest.raises(saccade.InputError, match="gets zeros"):
        normalizer.denormalize_state(np.zeros((2, 9)))


@pytest.mark.parametrize("layout", ["n16", "n17"])
def test_published_layouts_of_n16_and_n17(layout: str, tmp_path: Path) -> None:
    sidecars(tmp_path, layout)
    normalizer = Normalizer.from_pretrained(tmp_path, "libero_sim")
    assert (normalizer.embodiment_id, normalizer.action_horizon, normalizer.state_width) == (2, 16, 7)
    assert as_array(normalizer.actions(draw(1, 40, 10))).shape == (1, 16, 6)
