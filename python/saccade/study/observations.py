"""Closed-loop episodes in which all that the head was given is written down, look by look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade.intervention import Intervention
from saccade.sim.environment import TaskEnvironment
from saccade.sim.policy import HeadEngine, Policy
from saccade.sim.rollout import Episode, run_episode

Float32Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Look:
    """One look of an episode: what the head was given, and what the simulator knew.

    Attributes:
        features: Backbone features, `(1, T_vl, width)`.
        state: Normalised proprioception, `(1, state_dim)`.
        noise: What the chunk started from, `(1, horizon, action_dim)`.
        object, goal: Positions `(3,)`, metres; the first and the last ball where a task has its own balls.
        hand: Its position `(3,)`, metres.
        gripper: How far it is open `(1,)`, 0 to 1.
    """

    features: Float32Array
    state: Float32Array
    noise: Float32Array
    object: Float32Array
    goal: Float32Array
    hand: Float32Array
    gripper: Float32Array


class Recorder:
    """A head engine that writes down what it is given and lets another one answer.

    Args:
        engine: answers.
        environment: is asked for positions at every look.
    """

    def __init__(self, engine: HeadEngine, environment: TaskEnvironment) -> None:
        self.looks: list[Look] = []
        self._engine = engine
        self._environment = environment
        self._features = np.empty((1, 0, 0), np.float32)

    def encode(self, features: Float32Array) -> Any:
        """See `HeadEngine`."""
        self._features = features.copy()
        return self._engine.encode(features)

    def sample(
        self,
        context: Any,
        state: Float32Array,
        noise: Float32Array,
        intervention: Intervention | Sequence[Intervention] | None = None,
    ) -> Float32Array:
        """See `HeadEngine`."""
        targets = self._environment.privileged_targets()
        proprio = self._environment.last_observation["proprio"]
        known = {"object": targets[:3], "goal": targets[3:6], "hand": proprio[:3], "gripper": proprio[3:4]}
        self.looks.append(Look(self._features, state.copy(), noise.copy(), **known))
        return self._engine.sample(context, state, noise, intervention)

    def describe(self) -> dict[str, Any]:
        """See `HeadEngine`."""
        return self._engine.describe()


def record_looks(environment: TaskEnvironment, policy: Policy, seed: int) -> tuple[Episode, list[Look]]:
    """Runs one episode; the policy does what it does without being watched."""
    recorder = Recorder(policy.engine, environment)
    watched = Policy(policy.config, policy.backbone, recorder, policy.checkpoint)
    return run_episode(environment, watched, seed), recorder.looks
