"""A policy of the simulator whose head runs in one of the modes."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from saccade._internal.arrays import ArrayLike, Float32Array
from saccade.errors import InputError
from saccade.head.context import Context
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.settings import EMBODIMENT_ID
from saccade_lab.study.questions.fast_modes import Calibration, Mode, encode, sample
from saccade_lab.study.simulator import head_of, policy_of
from saccade_lab.study.wrapped_head import WrappedHead


class ModeHead(WrappedHead):
    """A policy's head in one of the modes, on one thread; a ``saccade.policy.interfaces.Head``.

    Args:
        checkpoint: Directory of the policy.
        mode: How a chunk is computed.
        calibration: What the mode depends on.
    """

    def __init__(self, checkpoint: str, mode: Mode, calibration: Calibration) -> None:
        self._head = head_of(checkpoint, mode.precision)
        super().__init__(self._head)
        self._mode = mode
        self._calibration = calibration

    def encode(self, backbone_features: ArrayLike, *, drop_vl: Any = None, **masks: Any) -> Context:
        """See ``Head``. The other masks change nothing in N1.5, and are not read."""
        if drop_vl is not None:
            raise InputError("drop_vl: given a mask, expected None: a mode runs one observation at a time")
        features = np.asarray(backbone_features)
        return encode(
            self._head, self._mode, self._calibration, given(features, np.empty((1, 0), np.float32))
        )

    def sample(self, context: Context, state: ArrayLike, embodiment_id: Any, **options: Any) -> Float32Array:
        """See ``Head``; takes noise and no intervention."""
        if options.get("intervention") is not None:
            raise InputError("intervention: given one, expected None with a faster mode")
        observation = given(np.empty((1, 0, 0), np.float32), np.asarray(state), options["noise"])
        return sample(self._head, self._mode, self._calibration, context, observation)


def given(features: Float32Array, state: Float32Array, noise: Float32Array | None = None) -> HeadInputs:
    """An observation of the simulated robot."""
    return HeadInputs(features, state, np.array([EMBODIMENT_ID]), noise)


@functools.lru_cache(maxsize=64)
def policy_in(checkpoint: str, mode: Mode, calibration: Calibration) -> Policy:
    """The policy with its head in a mode. Policies of up to 64 modes are cached; they share the weights."""
    policy = policy_of(checkpoint)
    return policy.with_head(ModeHead(checkpoint, mode, calibration))
