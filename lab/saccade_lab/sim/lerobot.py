"""The tasks as lerobot expects environments: ``pixels``, ``agent_pos``, and the instruction as an attribute.

Importing this module registers ``saccade/<task>-lerobot-v0`` for each task:

    >>> import gymnasium, saccade_lab.sim.lerobot
    >>> env = gymnasium.make("saccade/push-lerobot-v0")
    >>> observation, info = env.reset(seed=3)
    >>> observation["pixels"]["top"].dtype, observation["agent_pos"].shape, info["is_success"]
    (dtype('uint8'), (4,), False)
    >>> env.get_wrapper_attr("task_description") == env.unwrapped.instruction
    True
    >>> env.close()
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from saccade_lab.sim.environment import SimulatedObservation, TaskEnvironment
from saccade_lab.sim.tasks import TASKS

Actions = npt.NDArray[np.float32]


class LeRobotObservation(gymnasium.Wrapper[dict[str, Any], Actions, SimulatedObservation, Actions]):
    """An environment of ``saccade_lab.sim`` with lerobot's names.

    Observations are ``{"pixels": {camera: (H, W, 3) uint8}, "agent_pos": (4,) float32}``; infos also contain
    ``is_success``. lerobot reads the instruction from the environment, not from the observation. It looks for
    it in the outermost wrapper, so no other may follow.

    Args:
        env: A :class:`saccade_lab.sim.environment.TaskEnvironment`, or a wrapper of one.

    Example:
        >>> env = LeRobotObservation(TaskEnvironment("reach"))
        >>> observation, info = env.reset(seed=0)
        >>> sorted(observation), sorted(observation["pixels"]), env.task
        (['agent_pos', 'pixels'], ['left', 'right', 'top'], 'reach')
        >>> env.close()
    """

    def __init__(self, env: gymnasium.Env[SimulatedObservation, Actions]) -> None:
        super().__init__(env)
        inner = env.observation_space
        assert isinstance(inner, spaces.Dict)
        self.observation_space = spaces.Dict({"pixels": inner["images"], "agent_pos": inner["proprio"]})

    @property
    def _task(self) -> TaskEnvironment:
        task = self.unwrapped
        assert isinstance(task, TaskEnvironment)
        return task

    @property
    def task(self) -> str:
        """The name of the task."""
        return self._task.task.name

    @property
    def task_description(self) -> str:
        """The instruction of this episode."""
        return self._task.instruction

    @property
    def _max_episode_steps(self) -> int:
        """Length of the longest episode, under the name that lerobot reads."""
        return self._task.task.max_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """As the environment, with lerobot's names."""
        observation, info = self.env.reset(seed=seed, options=options)
        return renamed(observation), {**info, "is_success": bool(info["success"])}

    def step(self, action: Actions) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """As the environment, with lerobot's names."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        info = {**info, "is_success": bool(info["success"])}
        return renamed(observation), float(reward), terminated, truncated, info


def renamed(observation: SimulatedObservation) -> dict[str, Any]:
    """An observation without the instruction, with lerobot's names."""
    return {"pixels": observation["images"], "agent_pos": observation["proprio"]}


def make(task: str, **options: Any) -> LeRobotObservation:
    """A task with lerobot's names.

    Args:
        task, options: As in :class:`saccade_lab.sim.environment.TaskEnvironment`.
    """
    return LeRobotObservation(TaskEnvironment(task, **options))


def register_environments() -> None:
    """Registers ``saccade/<task>-lerobot-v0``, without other wrappers."""
    for name in TASKS:
        gymnasium.register(
            f"saccade/{name}-lerobot-v0",
            entry_point="saccade_lab.sim.lerobot:make",
            order_enforce=False,
            disable_env_checker=True,
            kwargs={"task": name},
        )


register_environments()
