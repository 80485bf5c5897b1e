"""The simulated tasks for other programs: gymnasium's checker, lerobot's names, and the plugin's package."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import saccade_lab.sim.lerobot
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.lerobot import LeRobotObservation
from saccade_lab.sim.tasks import TASKS

ROOT = Path(__file__).resolve().parents[3]
SMALL = 16


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_has_nothing_to_say(task: str) -> None:
    env = gymnasium.make(f"saccade/{task}-v0", image_size=SMALL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_nor_of_videos_and_of_lerobots_names() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make("saccade/reach-v0", image_size=SMALL, render_mode="rgb_array").unwrapped)
        # It would rather have an environment without a wrapper.
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version")
        check_env(gymnasium.make("saccade/reach-lerobot-v0", image_size=SMALL), skip_render_check=True)


def test_the_state_stays_in_its_bounds() -> None:
    env = TaskEnvironment("reach", image_size=SMALL)
    env.reset(seed=0)
    for direction in (1.0, -1.0):
        for _ in range(40):
            env.advance(np.full(4, direction))
        assert env.observe() in env.observation_space
    env.close()


def same_but_for_names(observation: dict[str, Any], expected: dict[str, Any]) -> None:
    assert set(observation) == {"pixels", "agent_pos"}
    assert set(observation["pixels"]) == set(expected["images"])
    for name, picture in expected["images"].items():
        np.testing.assert_array_equal(observation["pixels"][name], picture)
    np.testing.assert_array_equal(observation["agent_pos"], expected["proprio"])


def test_a_wrapper_offers_lerobots_names() -> None:
    env = gymnasium.make("saccade/push-lerobot-v0", image_size=SMALL, render_mode="rgb_array")
    assert isinstance(env, LeRobotObservation)  # lerobot 0.5 looks at the outermost wrapper only
    plain = TaskEnvironment("push", image_size=SMALL)
    observation, info = env.reset(seed=5)
    expected, plain_info = plain.reset(seed=5)
    same_but_for_names(observation, expected)
    assert info == {**plain_info, "is_success": False}
    observation, *outcome, info = env.step(np.ones(4, np.float32))
    expected, *plain_outcome, plain_info = plain.step(np.ones(4))
    assert observation in env.observation_space
    same_but_for_names(observation, expected)
    assert outcome == plain_outcome
    assert info == {**plain_info, "is_success": False}
    told = [env.get_wrapper_attr(name) for name in ("task", "task_description", "_max_episode_steps")]
    assert told == ["push", plain.instruction, TASKS["push"].max_steps]
    rendered = env.render()
    assert isinstance(rendered, np.ndarray)
    assert rendered.dtype == np.uint8
    env.close()
    plain.close()


def test_batches_of_environments_say_which_succeeded() -> None:
    env = gymnasium.vector.SyncVectorEnv(
        [lambda: saccade_lab.sim.lerobot.make("reach", image_size=SMALL)] * 2,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    observation, info = env.reset(seed=[3, 4])
    assert observation["pixels"]["left"].shape == (2, SMALL, SMALL, 3)
    assert info["is_success"].tolist() == [False, False]
    assert all(isinstance(text, str) for text in env.call("task_description"))
    env.close()


def test_the_plugin_has_the_version_of_saccade_and_the_name_by_which_lerobot_looks() -> None:
    version = re.compile(r'^version = "(.+)"', re.MULTILINE)
    package = (ROOT / "plugins" / "lerobot" / "pyproject.toml").read_text()
    assert version.findall(package) == version.findall((ROOT / "Cargo.toml").read_text())
    assert '\nname = "lerobot_policy_saccade"\n' in package
