"""Groups of numbers of a state or an action that are normalised alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError, ShapeError
from saccade.robots import rotations

Statistics: TypeAlias = "npt.NDArray[np.floating[Any]]"


@dataclass(frozen=True)
class Conversion:
    """A rotation that robot and head have in different representations, keys of ``rotations.SIZES``."""

    robot: str
    head: str


@dataclass(frozen=True)
class Reference:
    """What relative actions are relative to: a key of the state."""

    key: str
    pose: str | None = None  # a key of ``rotations.POSES``; None for numbers that the state is added to


@dataclass(frozen=True, eq=False)
class Group:
    """Adjacent numbers of a state or an action that are normalised alike: a modality key of Isaac-GR00T.

    Attributes:
        key: Its name, such as ``"left_arm"``.
        size: Number of values that the robot has for it.
        mode: One of ``"min_max"``, ``"q99"``, ``"mean_std"``, ``"scale"``, ``"binary"``, ``"sin_cos"`` and
            ``"none"``.
        first: Minimum, 1 % quantile or mean; ``(width,)``, or ``(horizon, width)`` if each step of a chunk
            has its own. Zero for ``"scale"``. None if the mode needs no statistics.
        second: Maximum, 99 % quantile, standard deviation or scale, shaped as ``first``.
        moving: True where the statistics define a scale. The other dimensions are constant.
        keeps_constant: Whether constant dimensions go to the head unchanged. Otherwise the head gets 0.
        returns_constant: Whether constant dimensions of ``"mean_std"`` come back unchanged. Otherwise they
            come back as the mean.
        clips: Whether values for the head are clipped to -1 and 1.
        clips_back: Whether values from the head are clipped to -1 and 1 first.
        conversion: How a rotation is converted before it is normalised, or None.
        reference: For actions, what they are relative to, or None.
    """

    key: str
    size: int
    mode: str
    first: Statistics | None = None
    second: Statistics | None = None
    moving: npt.NDArray[np.bool_] | None = None
    keeps_constant: bool = False
    returns_constant: bool = False
    clips: bool = False
    clips_back: bool = False
    conversion: Conversion | None = None
    reference: Reference | None = None

    @property
    def width(self) -> int:
        """Number of values that the head has for it. Sine and cosine are two."""
        if self.conversion is not None:
            return rotations.SIZES[self.conversion.head]
        return 2 * self.size if self.mode == "sin_cos" else self.size

    def indexed(self, index: Any) -> Group:
        """The group with a part of its statistics, if it has any."""
        names = ("first", "second", "moving") if self.first is not None else ()
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    def to_head(self, values: Float32Array) -> Float32Array:
        """Converts ``(..., size)`` in the robot's units to normalised ``(..., width)``.

        Raises:
            InputError: Numbers that should be a rotation are none.
        """
        if self.conversion is not None:
            values = self._turned(values, self.conversion.robot, self.conversion.head)
        if self.mode == "none":
            return values
        if self.mode == "binary":
            return (values > 0.5).astype(np.float32)
        if self.mode == "sin_cos":
            return np.concatenate([np.sin(values), np.cos(values)], axis=-1)
        first, second, moving = self._statistics_for(values)
        has_bounds = self.mode in ("min_max", "q99")
        span = np.where(moving, second - first if has_bounds else second, 1.0)
        # In the order of the released code, so that float32 gives the same bits.
        scaled = ((values - first) / span.astype(first.dtype)).astype(np.float32)
        if has_bounds:
            scaled = 2 * scaled - 1
        normalised = np.where(moving, scaled, values if self.keeps_constant else np.float32(0))
        return np.clip(normalised, -1.0, 1.0) if self.clips else normalised

    def to_robot(self, values: Float32Array) -> Float32Array:
        """The inverse of :meth:`to_head`. Clipped values stay clipped.

        Raises:
            InputError: The mode is ``"sin_cos"`` or ``"scale"``, which the released code does not invert; or
                numbers that should be a rotation are none.
        """
        values = self._unscaled(values)
        if self.conversion is None:
            return values
        return self._turned(values, self.conversion.head, self.conversion.robot)

    def _unscaled(self, values: Float32Array) -> Float32Array:
        if self.mode == "none":
            return values
        if self.mode == "binary":
            return (values > 0.5).astype(np.float32)
        if self.mode in ("sin_cos", "scale"):
            raise InputError(
                f"{self.key}: expected a mode that is converted back, got {self.mode!r}, for which the "
                "released code has no inverse"
            )
        first, second, moving = self._statistics_for(values)
        if self.mode == "mean_std":
            robot = values * second + first
            return np.where(moving, robot, values if self.returns_constant else robot).astype(np.float32)
        if self.clips_back:
            values = np.clip(values, -1.0, 1.0)
        return ((values + 1) / 2 * (second - first) + first).astype(np.float32)

    def _turned(self, values: Float32Array, source: str, target: str) -> Float32Array:
        """A rotation in another representation."""
        found = rotations.converted(values, source, target).astype(np.float32)
        if not np.isfinite(found).all():
            raise InputError(f"{self.key}: expected rotations ({source}), got numbers that are none")
        return found

    def absolute(self, reference: Float32Array, values: Float32Array) -> Float32Array:
        """Relative actions ``(..., size)`` in the robot's units as absolute; the state broadcasts to them."""
        assert self.reference is not None
        if self.reference.pose is None:
            return reference + values
        return self._posed(rotations.composed(reference, values, self.reference.pose))

    def relative(self, reference: Float32Array, values: Float32Array) -> Float32Array:
        """The inverse of :meth:`absolute`."""
        assert self.reference is not None
        if self.reference.pose is None:
            return values - reference
        return self._posed(rotations.relative_to(reference, values, self.reference.pose))

    def _posed(self, poses: npt.NDArray[np.float64]) -> Float32Array:
        if not np.isfinite(poses).all():
            assert self.reference is not None
            raise InputError(
                f"{self.key}: expected poses, and state.{self.reference.key} to be one, got numbers whose "
                "rotation is none"
            )
        return poses.astype(np.float32)

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
