"""Scripted experts, and disturbances of demonstrations, from which a policy learns to recover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade_lab.sim.tasks import ACTION_DIM

if TYPE_CHECKING:
    from saccade_lab.sim.environment import TaskEnvironment


class Expert:
    """The scripted expert of one task, which knows the full state.

    Args:
        environment: The simulation that it acts in.
    """

    def __init__(self, environment: TaskEnvironment) -> None:
        self._environment = environment

    def action(self) -> Float32Array:
        """Its action in the current state, ``(4,)`` in [-1, 1]."""
        action = self._environment.scenario.expert_action(self._environment.privileged_state())
        clipped: Float32Array = np.clip(action[:ACTION_DIM], -1.0, 1.0).astype(np.float32)
        return clipped


@dataclass
class NoiseBursts:
    """Occasionally replaces the hand's motion by a constant random one for a few steps.

    The expert's own action stays the label. A burst moves the hand to places that the expert does not visit
    but a learned policy will.

    Attributes:
        rng: Source of randomness.
        start_probability: Probability that a burst starts, per step outside a burst.
        min_steps, max_steps: Length of a burst.
        remaining: Steps left of the current burst.
    """

    rng: np.random.Generator
    start_probability: float = 0.03
    min_steps: int = 4
    max_steps: int = 10
    remaining: int = 0

    def apply(self, action: Float32Array) -> tuple[Float32Array, bool]:
        """The action to execute, and whether it was replaced; the gripper always follows the expert."""
        if self.remaining == 0 and self.rng.random() < self.start_probability:
            self.remaining = int(self.rng.integers(self.min_steps, self.max_steps + 1))
            self._velocity = self.rng.uniform(-1.0, 1.0, size=3).astype(np.float32)
        if self.remaining == 0:
            return action, False
        self.remaining -= 1
        return np.concatenate((self._velocity, action[3:])), True
