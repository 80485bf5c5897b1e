"""A robot for lerobot's programs, whose observations are random, for the tests of the plugin."""

# lerobot has no types.
# mypy: disable-error-code="misc, no-untyped-call"

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from plugin_cases import VIEWS, WIDTH

from saccade_lab.sim.cameras import DEFAULT_IMAGE_SIZE

JOINTS = tuple(f"joint_{number}.pos" for number in range(WIDTH))
TASK = "push the red ball"


@RobotConfig.register_subclass("trial_robot")
@dataclass
class TrialRobotConfig(RobotConfig):
    """The options of the robot.

    Attributes:
        after: What is called with every action that the robot gets, and their number.
    """

    id: str | None = "trial"
    after: Callable[[dict[str, float], int], None] = field(default=lambda action, count: None)


class TrialRobot(Robot):
    """A robot of four joints and three cameras."""

    config_class = TrialRobotConfig
    name = "trial_robot"

    def __init__(self, config: TrialRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.actions: list[dict[str, float]] = []
        self.observations = 0
        self._connected = False

    @functools.cached_property
    def observation_features(self) -> dict[str, Any]:
        size = (DEFAULT_IMAGE_SIZE, DEFAULT_IMAGE_SIZE, 3)
        return {**dict.fromkeys(JOINTS, float), **dict.fromkeys(VIEWS, size)}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def is_connected(self) -> bool:
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    def disconnect(self) -> None:
        self._connected = False

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass

    def get_observation(self) -> dict[str, Any]:
        self.observations += 1
        return observation(self.observations)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.actions.append(action)
        self.config.after(action, len(self.actions))
        return action


def observation(seed: int) -> dict[str, Any]:
    """What the robot measures."""
    rng = np.random.default_rng(seed)
    size = (DEFAULT_IMAGE_SIZE, DEFAULT_IMAGE_SIZE, 3)
    joints = {name: float(rng.uniform(0, 0.5)) for name in JOINTS}
    return {**joints, **{name: rng.integers(0, 256, size, np.uint8) for name in VIEWS}}
