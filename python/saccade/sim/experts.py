"""Scripted experts, and how demonstrations are disturbed so that a learner sees how to recover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saccade.sim.tasks import ACTION_DIM

if TYPE_CHECKING:
    from saccade.sim.environment import TaskEnvironment

Float32Array = npt.NDArray[np.float32]


class Expert:
    """The scripted expert of one task, told everything.

    Args:
        environment: the simulation it drives.
    """

    def __init__(self, environment: TaskEnvironment) -> None:
        self._environment = environment

    def action(self) -> Float32Array:
        """What it does now, `(4,)` in [-1, 1]."""
        action = self._environment.scenario.expert_action(self._environment.privileged_state())
        clipped: Float32Array = np.clip(action[:ACTION_DIM], -1.0, 1.0).astype(np.float32)
        return clipped


@dataclass
class NoiseBursts:
    """Now and then replaces the hand's motion by a constant random one for a few steps.

    The expert's own action stays the label. A burst carries the hand to places that the expert never visits
    on its own but a learner will.

    Attributes:
        rng: Source of all randomness.
        start_probability: Of a burst to start at a step outside one.
        min_steps, max_steps: Its length.
        remaining: Steps left of the present burst.
    """

    rng: np.random.Generator
    start_probability: float = 0.03
    min_steps: int = 4
    max_steps: int = 10
    remaining: int = 0

    def apply(self, action: Float32Array) -> tuple[Float32Array, bool]:
        """The action to execute, and whether it was replaced; the gripper is left to the expert."""
        if self.remaining == 0 and self.rng.random() < self.start_probability:
            self.remaining = int(self.rng.integers(self.min_steps, self.max_steps + 1))
            self._velocity = self.rng.uniform(-1.0, 1.0, size=3).astype(np.float32)
        if self.remaining == 0:
            return action, False
        self.remaining -= 1
        return np.concatenate((self._velocity, action[3:])), True
