"""The simulated tasks: seeds, pictures, experts, and a machine without OpenGL."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest

import saccade_lab.sim  # noqa: F401  (registers the environments)
from saccade import InputError, ShapeError
from saccade_lab.sim import graphics
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.experts import Expert, NoiseBursts
from saccade_lab.sim.rendering import average_down
from saccade_lab.sim.tasks import (
    DEMONSTRATION_SEEDS,
    EVALUATION_SEEDS,
    TASKS,
    VALIDATION_SEEDS,
    check_evaluation_seeds,
)


@contextlib.contextmanager
def make(task: str, **options: Any) -> Iterator[TaskEnvironment]:
    with contextlib.closing(TaskEnvironment(task, **options)) as environment:
        yield environment


def green_centre(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    """Row and column of the green ball's middle."""
    red, green, blue = picture.astype(int).transpose(2, 0, 1)
    found = np.argwhere((green > 120) & (red < 100) & (blue < 100))
    assert len(found) >= 4
    return np.asarray(found.mean(axis=0))


@pytest.mark.parametrize("task", TASKS)
def test_twenty_seeds_give_twenty_layouts(task: str) -> None:
    with make(task) as environment:
        layouts = set()
        for seed in range(20):
            environment.restart(seed)
            layouts.add(tuple(environment.privileged_targets().round(6)))
    assert len(layouts) == 20


@pytest.mark.parametrize("task", ["push", "window-open"])
def test_a_seed_gives_the_same_pixels_whatever_went_before(task: str) -> None:
    with make(task) as used, make(task) as fresh:
        used.reset(seed=3)
        for _ in range(5):
            used.advance(np.ones(4))
        first, _ = used.reset(seed=4)
        second, _ = fresh.reset(seed=4)
    assert first["instruction"] == second["instruction"]
    np.testing.assert_array_equal(first["proprio"], second["proprio"])
    for camera in DEFAULT_CAMERAS:
        np.testing.assert_array_equal(first["images"][camera.name], second["images"][camera.name])


def test_the_goal_marker_is_where_the_goal_is_and_pictures_are_upright() -> None:
    with make("reach") as environment:
        seen = []
        for seed in range(12):
            environment.restart(seed)
            goal = environment.privileged_targets()[3:]
            images = environment.observe()["images"]
            seen.append((goal, green_centre(images["left"]), green_centre(images["top"])))
    height = np.array([goal[2] for goal, _, _ in seen])
    across = np.array([goal[0] for goal, _, _ in seen])
    # Higher is further up, in a picture that looks from the side; x points right, in the one from above.
    assert np.corrcoef(height, [left[0] for _, left, _ in seen])[0, 1] < -0.9
    assert np.corrcoef(across, [top[1] for _, _, top in seen])[0, 1] > 0.9


def test_no_marker_gives_the_goal_away() -> None:
    with make("drawer-open") as environment:
        for picture in environment.reset(seed=0)[0]["images"].values():
            red, green, blue = picture.astype(int).transpose(2, 0, 1)
            assert not ((green > 200) & (red < 60) & (blue < 60)).any()


def test_gymnasium_knows_every_task() -> None:
    for task in TASKS:
        with contextlib.closing(gymnasium.make(f"saccade/{task}-v0")) as environment:
            assert isinstance(environment.unwrapped, TaskEnvironment)
            assert environment.unwrapped.task.name == task


@pytest.mark.parametrize("task", ["push", "window-open"])
def test_gymnasium_steps_and_renders(task: str) -> None:
    with contextlib.closing(gymnasium.make(f"saccade/{task}-v0", render_mode="rgb_array")) as environment:
        observation, info = environment.reset(seed=0)
        assert environment.observation_space.contains(observation)
        assert observation["instruction"] in TASKS[task].instructions
        assert info["success"] is False
        observation, _, terminated, truncated, info = environment.step(environment.action_space.sample())
        assert environment.observation_space.contains(observation)
        assert (terminated, truncated, info["success"]) == (False, False, False)
        picture = environment.render()
        assert isinstance(picture, np.ndarray)
        assert picture.shape == (360, 360, 3)


def test_an_episode_ends_after_its_last_step() -> None:
    with make("reach", image_size=16) as environment:
        environment.reset(seed=0)
        ends = [environment.advance(np.zeros(4)) for _ in range(environment.task.max_steps - 1)]
        assert not any(end.success for end in ends)
        _, _, terminated, truncated, _ = environment.step(np.zeros(4))
        assert (terminated, truncated) == (False, True)


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_succeeds_also_when_disturbed(task: str) -> None:
    with make(task, image_size=16) as environment:
        environment.restart(DEMONSTRATION_SEEDS[0])
        expert = Expert(environment)
        bursts = NoiseBursts(np.random.default_rng(0), start_probability=0.02)
        for _ in range(400):
            action, _ = bursts.apply(expert.action())
            if environment.advance(action).success:
                return
    pytest.fail("no success within 400 steps")


def test_bursts_replace_the_motion_and_leave_the_gripper() -> None:
    bursts = NoiseBursts(np.random.default_rng(1), start_probability=1.0, min_steps=3, max_steps=3)
    action = np.array([0.1, 0.2, 0.3, 0.4], dtype=np.float32)
    outcomes = [bursts.apply(action) for _ in range(3)]
    assert all(replaced for _, replaced in outcomes)
    np.testing.assert_array_equal(outcomes[0][0], outcomes[2][0])
    assert outcomes[0][0][3] == action[3]
    assert not np.array_equal(outcomes[0][0][:3], action[:3])
    bursts.start_probability = 0.0
    executed, replaced = bursts.apply(action)
    assert executed is action
    assert not replaced


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match="unknown name 'fly', expected one of reach, push"):
        TaskEnvironment("fly")
    with pytest.raises(InputError, match="image_size: given 4"):
        TaskEnvironment("reach", image_size=4)
    with pytest.raises(InputError, match="cameras"):
        TaskEnvironment("reach", cameras=())
    with pytest.raises(InputError, match="render_mode: given 'human'"):
        TaskEnvironment("reach", render_mode="human")
    with make("reach") as environment:
        environment.restart(0)
        with pytest.raises(ShapeError, match=r"given shape \(3,\), expected \(4,\)"):
            environment.advance(np.zeros(3))
        with pytest.raises(InputError, match="finite"):
            environment.advance([0.0, 0.0, np.nan, 0.0])


def test_seeds_for_training_and_judging_are_apart() -> None:
    ranges = (EVALUATION_SEEDS, DEMONSTRATION_SEEDS, VALIDATION_SEEDS)
    for first, second in itertools.pairwise(ranges):
        assert first.stop <= second.start
    assert check_evaluation_seeds(5, 3) == range(5, 8)
    for first_seed, count in ((DEMONSTRATION_SEEDS[0] - 1, 2), (-1, 1), (VALIDATION_SEEDS[0], 1)):
        with pytest.raises(InputError, match="evaluation seeds"):
            check_evaluation_seeds(first_seed, count)
    with pytest.raises(InputError, match="episodes: given 0"):
        check_evaluation_seeds(0, 0)


def test_average_down_rounds_to_nearest() -> None:
    picture = np.array([[[1], [2]], [[2], [1]]], dtype=np.uint8)
    assert average_down(picture, 2).tolist() == [[[2]]]  # 1.5
    assert average_down(picture, 1).tolist() == picture.tolist()


@pytest.mark.parametrize(
    ("probe", "reason"),
    [
        ("raise RuntimeError('no driver')", "RuntimeError: no driver"),
        ("import os; os.abort()", "status -6"),
        ("pass", "status 0"),
    ],
)
def test_missing_opengl_names_the_packages(probe: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphics, "PROBE", probe)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(graphics.GraphicsError) as caught:
        graphics.check()
    message = str(caught.value)
    assert reason in message
    assert "libegl1 libegl-mesa0 libgl1-mesa-dri" in message
    assert "libosmesa6" in message


def test_opengl_is_found_here() -> None:
    graphics.check()
