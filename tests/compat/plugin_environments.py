"""The plugin's environments, and `lerobot-eval`. `make test-compat` runs this after plugin.py.

`lerobot-eval` runs as users start it, and its episodes are compared with those of `saccade.Policy.act`.
"""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import plugin_cases
import pytest
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import preprocess_observation
from lerobot.policies.factory import make_policy, make_policy_config
from plugin_cases import HORIZON, WIDTH, joined, random_policy

import lerobot_policy_saccade
import saccade
from lerobot_policy_saccade import SaccadeEnv
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy
from saccade_lab.sim.environment import TaskEnvironment

# Fixtures.
checkpoint, policy = plugin_cases.checkpoint, plugin_cases.policy


def test_the_environment_is_that_of_the_task() -> None:
    config = EnvConfig.get_choice_class("saccade")(task="push", image_size=16)
    assert config.gym_kwargs == {"render_mode": "rgb_array", "image_size": 16}
    assert config.features["pixels/top"].shape == (16, 16, 3)
    assert lerobot_policy_saccade.SaccadeEnv(task="reach").gym_id == "saccade/reach-lerobot-v0"
    with pytest.raises(saccade.InputError, match="no-such-task"):
        SaccadeEnv(task="no-such-task")


def test_an_environment_of_lerobot(tmp_path: Path) -> None:
    config = EnvConfig.get_choice_class("metaworld")(task="reach-v3")
    vector = make_env(config, n_envs=1)["reach-v3"][0]
    try:
        observation, _ = vector.reset(seed=[0])
        size = observation["pixels"].shape[1]
        # An environment with one camera does not name it.
        folder = random_policy(tmp_path / "checkpoint", ["image"], size)
        policy = make_policy(make_policy_config("saccade", checkpoint=str(folder)), env_cfg=config)
        batch = preprocess_observation(observation) | {"task": list(vector.call("task_description"))}
        vector.step(policy.select_action(batch).numpy())
    finally:
        vector.close()


def evaluate(out: Path, *arguments: str) -> dict[str, Any]:
    """What `lerobot-eval` writes."""
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_eval", f"--output_dir={out}", *arguments]
    done = subprocess.run(
        command, cwd=out.parent, env=os.environ | {"HF_HUB_OFFLINE": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return json.loads((out / "eval_info.json").read_text())


def episode(policy: saccade.Policy, task: str, seed: int, first: int) -> float:
    """The sum of rewards of an episode in this process. The chunks have the seeds from `first` on."""
    environment = TaskEnvironment(task)
    observation, _ = environment.reset(seed=seed)
    total, steps, done = 0.0, 0, False
    chunk = np.zeros((HORIZON, WIDTH))
    while not done:
        if steps % HORIZON == 0:
            state = observation["proprio"][None]
            seen = {
                "video": {name: image[None] for name, image in observation["images"].items()},
                "state": {"hand": state[:, :3], "gripper": state[:, 3:]},
                "language": {"annotation.human.task_description": observation["instruction"]},
            }
            chunk = joined(policy.act(seen, seed=first + steps // HORIZON))
        observation, reward, terminated, truncated, _ = environment.step(chunk[steps % HORIZON])
        total, steps, done = total + reward, steps + 1, terminated or truncated
    environment.close()
    return total


def test_lerobot_eval_runs_a_checkpoint(checkpoint: Path, policy: SaccadePolicy, tmp_path: Path) -> None:
    info = evaluate(
        tmp_path / "out",
        "--policy.type=saccade",
        f"--policy.checkpoint={checkpoint}",
        "--policy.num_threads=1",
        "--policy.seed=7",
        "--env.type=saccade",
        "--env.task=reach",
        "--eval.batch_size=1",
        "--eval.n_episodes=1",
        "--seed=12",
    )
    (total,) = info["per_task"][0]["metrics"]["sum_rewards"]
    assert total == pytest.approx(episode(policy.policy, "reach", seed=12, first=7), rel=1e-12)
    assert list((tmp_path / "out").rglob("*.mp4"))


def test_lerobot_eval_runs_a_saved_policy_in_several_environments(
    policy: SaccadePolicy, tmp_path: Path
) -> None:
    policy.save_pretrained(tmp_path / "saved")
    info = evaluate(
        tmp_path / "out",
        f"--policy.path={tmp_path / 'saved'}",
        "--policy.n_action_steps=16",
        "--env.type=saccade",
        "--env.task=push",
        "--eval.batch_size=2",  # in processes of their own since lerobot 0.6
        "--eval.n_episodes=2",
        "--seed=3",
    )
    metrics = info["per_task"][0]["metrics"]
    assert len(metrics["sum_rewards"]) == len(metrics["successes"]) == 2
    # The noise of the first row is that of a batch of one.
    assert metrics["sum_rewards"][0] == pytest.approx(
        episode(policy.policy, "push", seed=3, first=7), rel=1e-12
    )
