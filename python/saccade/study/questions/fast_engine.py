"""A policy of the simulator whose head runs in one of the modes."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from saccade._arrays import Float32Array
from saccade.context import Context
from saccade.errors import InputError
from saccade.observation import Observation
from saccade.sim.policy import EMBODIMENT_ID, Interventions, Policy
from saccade.study.questions.fast_modes import Calibration, Mode, encode, sample
from saccade.study.simulator import head_of, policy_of


class ModeEngine:
    """A policy's head in one of the modes, on one thread; a `saccade.sim.policy.HeadEngine`.

    Args:
        checkpoint: Directory of the policy.
        mode: How a chunk is computed.
        calibration: What the mode depends on.
    """

    def __init__(self, checkpoint: str, mode: Mode, calibration: Calibration) -> None:
        self._head = head_of(checkpoint, mode.precision)
        self._mode = mode
        self._calibration = calibration

    def encode(self, features: Float32Array) -> Context:
        """See `HeadEngine`."""
        return encode(
            self._head, self._mode, self._calibration, given(features, np.empty((1, 0), np.float32))
        )

    def sample(
        self, context: Context, state: Float32Array, noise: Float32Array, intervention: Interventions = None
    ) -> Float32Array:
        """See `HeadEngine`; takes no intervention."""
        if intervention is not None:
            raise InputError("intervention: given one, expected None with a faster mode")
        observation = given(np.empty((1, 0, 0), np.float32), state, noise)
        return sample(self._head, self._mode, self._calibration, context, observation)

    def describe(self) -> dict[str, Any]:
        """See `HeadEngine`."""
        return {"name": "rust", "mode": self._mode.name, "isa": self._head.isa, "num_threads": 1}


def given(features: Float32Array, state: Float32Array, noise: Float32Array | None = None) -> Observation:
    """An observation of the simulated robot."""
    return Observation(features, state, np.array([EMBODIMENT_ID]), noise)


@functools.lru_cache(maxsize=64)
def policy_in(checkpoint: str, mode: Mode, calibration: Calibration) -> Policy:
    """The policy with its head in a mode. Policies of up to 64 modes are cached; they share the weights."""
    policy = policy_of(checkpoint)
    engine = ModeEngine(checkpoint, mode, calibration)
    return Policy(policy.config, policy.backbone, engine, policy.checkpoint)
