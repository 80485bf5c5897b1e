"""Groups of numbers that are normalised alike, and a robot as groups of its state and its action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._arrays import Float32Array
from saccade.errors import InputError, ShapeError

#: The ways to normalise a group.
MODES = ("min_max", "q99", "mean_std", "binary", "sin_cos", "none")

Statistics: TypeAlias = "npt.NDArray[np.floating[Any]]"


@dataclass(frozen=True, eq=False)
class Group:
    """Adjacent numbers of a state or an action that are normalised alike: a modality key of Isaac-GR00T.

    Attributes:
        key: Its name, such as ``"left_arm"``.
        size: Number of values that the robot has for it.
        mode: One of ``"min_max"``, ``"q99"``, ``"mean_std"``, ``"binary"``, ``"sin_cos"`` and ``"none"``.
        first: Minimum, 1 % quantile or mean, ``(size,)``, or ``(horizon, size)`` if each step of a chunk has
            its own. None if the mode needs no statistics.
        second: Maximum, 99 % quantile or standard deviation, shaped as ``first``.
        moving: True where the statistics define a scale. The other dimensions are constant.
        keeps_constant: Whether constant dimensions go to the head unchanged. Otherwise the head gets 0.
        clips: Whether values for the head are clipped to -1 and 1.
        clips_back: Whether values from the head are clipped to -1 and 1 first.
        reference: For actions, the key of the state that they are relative to, or None.
    """

    key: str
    size: int
    mode: str
    first: Statistics | None = None
    second: Statistics | None = None
    moving: npt.NDArray[np.bool_] | None = None
    keeps_constant: bool = False
    clips: bool = False
    clips_back: bool = False
    reference: str | None = None

    @property
    def width(self) -> int:
        """Number of values that the head has for it. Sine and cosine are two."""
        return 2 * self.size if self.mode == "sin_cos" else self.size

    def to_head(self, values: Float32Array) -> Float32Array:
        """Converts ``(..., size)`` in the robot's units to normalised ``(..., width)``."""
        if self.mode == "none":
            return values
        if self.mode == "binary":
            return (values > 0.5).astype(np.float32)
        if self.mode == "sin_cos":
            return np.concatenate([np.sin(values), np.cos(values)], axis=-1)
        first, second, moving = self._statistics_for(values)
        span = np.where(moving, second if self.mode == "mean_std" else second - first, 1.0)
        # In the order of the released code, so that float32 gives the same bits.
        scaled = ((values - first) / span.astype(first.dtype)).astype(np.float32)
        if self.mode != "mean_std":
            scaled = 2 * scaled - 1
        normalised = np.where(moving, scaled, values if self.keeps_constant else np.float32(0))
        return np.clip(normalised, -1.0, 1.0) if self.clips else normalised

    def to_robot(self, values: Float32Array) -> Float32Array:
        """The inverse of :meth:`to_head`. Clipped values stay clipped.

        Raises:
            InputError: The mode is ``"sin_cos"``, which is not invertible.
        """
        if self.mode == "none":
            return values
        if self.mode == "binary":
            return (values > 0.5).astype(np.float32)
        if self.mode == "sin_cos":
            raise InputError(
                f"{self.key}: expected a group that is invertible, got mode 'sin_cos', which loses full turns"
            )
        first, second, moving = self._statistics_for(values)
        if self.mode == "mean_std":
            robot = values * second + first
            return np.where(moving, robot, values if self.clips_back else robot).astype(np.float32)
        if self.clips_back:
            values = np.clip(values, -1.0, 1.0)
        return ((values + 1) / 2 * (second - first) + first).astype(np.float32)

    def _statistics_for(self, values: Float32Array) -> tuple[Statistics, Statistics, npt.NDArray[np.bool_]]:
        """The statistics, with one row for each step of the chunk if each step has its own."""
        assert self.first is not None
        assert self.second is not None
        assert self.moving is not None
        if self.first.ndim == 1:
            return self.first, self.second, self.moving
        steps = values.shape[-2] if values.ndim > 1 else 0
        if not 1 <= steps <= len(self.first):
            raise ShapeError(
                f"actions: {self.key} has statistics of {len(self.first)} steps, expected a chunk of at most "
                f"as many, got {values.shape}"
            )
        return self.first[:steps], self.second[:steps], self.moving[:steps]


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot as a checkpoint describes it.

    Attributes:
        embodiment: Tag of the robot, such as ``"new_embodiment"``; None if the statistics have no name.
        embodiment_id: Its embodiment in the head; None if the checkpoint does not contain it.
        state_groups: The groups of the state, in the order of its numbers.
        action_groups: The groups of the action.
        state_dim: Width of the state that the head takes.
        action_dim: Width of the action that the head denoises.
        action_horizon: Number of steps of a chunk that were trained for this robot; None for all.
        zero_state: Whether the head was trained without a state. It then gets zeros.
    """

    embodiment: str | None
    embodiment_id: int | None
    state_groups: tuple[Group, ...]
    action_groups: tuple[Group, ...]
    state_dim: int
    action_dim: int
    action_horizon: int | None = None
    zero_state: bool = False
