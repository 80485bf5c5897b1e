"""A robot's units to the head's and back, with the statistics that a checkpoint brings."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from saccade._arrays import Array, ArrayLike, Float32Array, float32, integer, is_torch, like_features
from saccade.errors import InputError, ShapeError
from saccade.robot_statistics import Group, Options, Robot, checked_modes, key_names, read


class Normalizer(Robot):
    """Turns a robot's state into what the head takes, and what the head gives into the robot's actions.

    The head works on numbers around -1 to 1, zero-padded to widths that all robots share. How a robot's
    numbers get there is in the statistics beside the weights; :meth:`load` reads them, and does with them
    what the code does that trained the checkpoint.

    Its attributes are those of :class:`saccade.robot_statistics.Robot`.

    Example:
        Two joints and a gripper that never moved:

        >>> import numpy as np, saccade
        >>> statistics = {"min": [-1.0, 0.0, 0.5], "max": [1.0, 4.0, 0.5]}
        >>> normalizer = saccade.Normalizer.load({"state": statistics, "action": statistics}, state_dim=5)
        >>> normalizer.state(np.array([[0.5, 1.0, 0.5]]))
        array([[ 0.5, -0.5,  0. ,  0. ,  0. ]], dtype=float32)
        >>> normalizer.actions(np.array([[[0.5, -0.5, 0.25]]]))
        array([[[0.5, 1. , 0.5]]], dtype=float32)
    """

    @classmethod
    def load(
        cls,
        source: str | os.PathLike[str] | Mapping[str, Any],
        embodiment: str | int | None = None,
        *,
        state_dim: int | None = None,
        action_dim: int | None = None,
        state_keys: Sequence[str] | None = None,
        action_keys: Sequence[str] | None = None,
        modes: str | Mapping[str, str] | None = None,
    ) -> Normalizer:
        """Reads the statistics of a checkpoint.

        What is read, and what is then done, is looked for in this order:

        - lerobot: ``policy_preprocessor.json``, ``policy_postprocessor.json`` and the ``.safetensors`` that
          they name. Min-max; N1.7 also with the groups and relative actions of Isaac-GR00T.
        - Isaac-GR00T N1.6 and N1.7: ``processor_config.json``, ``statistics.json``, ``embodiment_id.json``.
        - Isaac-GR00T N1 and N1.5: ``experiment_cfg/metadata.json``. The checkpoint does not say which keys
          the data config had, in which order, and how it normalised them: the default is all, in the order of
          the file, min-max, and binary where a key is not continuous.
        - saccade: ``policy_cfg`` in ``config.json``.
        - A mapping, or a JSON file: any of these files' contents; or ``{"state": {"min": ..., "max": ...},
          "action": ...}``, with mean and standard deviation where there is no minimum.

        Args:
            source: A checkpoint's directory or id, one of these files, or a mapping.
            embodiment: Tag or id of the robot; needed where the statistics are of several.
            state_dim: Width of the head's state. Default: what the checkpoint says, else the robot's width.
            action_dim: Width of the head's actions, likewise.
            state_keys: The keys that the state is made of, in order. ``metadata.json`` only, as the next two.
            action_keys: Those of the action.
            modes: How to normalise: one of ``"min_max"``, ``"q99"``, ``"mean_std"``, ``"binary"``,
                ``"sin_cos"`` (states only) and ``"none"``, for all keys or by key (``"state.left_arm"``).
                A key that holds a rotation needs one: Isaac-GR00T's data configs may turn rotations into
                another representation, which is not done here.

        Raises:
            FileNotFoundError: ``source`` is not there.
            CheckpointError: there are no statistics, or they are broken; all that is wrong is listed.
            InputError: an option does not fit the statistics.
        """
        options = Options(
            embodiment,
            None if state_dim is None else integer("state_dim", state_dim),
            None if action_dim is None else integer("action_dim", action_dim),
            key_names("state_keys", state_keys),
            key_names("action_keys", action_keys),
            checked_modes(modes),
        )
        return cls(**vars(read(source, options)))

    @property
    def state_slices(self) -> dict[str, slice]:
        """Where each key lies in the robot's state."""
        return _slices(self.state_groups)

    @property
    def action_slices(self) -> dict[str, slice]:
        """Where each key lies in the robot's action."""
        return _slices(self.action_groups)

    @property
    def state_width(self) -> int:
        """Numbers of the robot's state."""
        return sum(group.size for group in self.state_groups)

    @property
    def action_width(self) -> int:
        """Numbers of the robot's action."""
        return sum(group.size for group in self.action_groups)

    def state(self, state: ArrayLike) -> Array:
        """A state for the head.

        Args:
            state: ``(..., state_width)`` in the robot's units, keys one after the other.

        Returns:
            ``(..., state_dim)`` float32, normalised and zero-padded; torch if ``state`` was.

        Raises:
            ShapeError, DtypeError, InputError: ``state`` does not fit; NaN or infinity.
        """
        values = self._robot("state", state, self.state_groups)
        if self.zero_state:
            normalised = np.zeros((*values.shape[:-1], self.state_dim), np.float32)
        else:
            # Isaac-GR00T and lerobot cut a state off that is wider than the head's.
            normalised = padded(_mapped(values, self.state_groups, Group.to_head), self.state_dim)
        return like_features(normalised, is_torch(state))

    def unstate(self, state: ArrayLike) -> Array:
        """The inverse of :meth:`state`: ``(..., state_dim)`` to ``(..., state_width)``.

        Constant dimensions come back as the constant, cut off values as where they were cut.

        Raises:
            ShapeError, DtypeError, InputError: ``state`` does not fit; NaN or infinity; a key is not
            invertible (``"sin_cos"``), or the head gets no state.
        """
        if self.zero_state:
            raise InputError("state: this head gets zeros, which tell nothing of the robot's state")
        values = self._head("state", state, self.state_groups)
        return like_features(_mapped(values, self.state_groups, Group.to_robot), is_torch(state))

    def actions(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """A chunk for the robot.

        Args:
            actions: ``(..., horizon, action_dim)`` as the head gives it; what is beyond the robot's own
                numbers, and beyond ``action_horizon``, is padding and cut off.
            state: Where actions are relative to the state: the robot's, in its units, that the chunk was
                sampled for; ``(state_width,)``, ``(batch, state_width)`` or ``(batch, history,
                state_width)``.

        Returns:
            ``(..., horizon, action_width)`` float32 in the robot's units; torch if ``actions`` was.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit; NaN or infinity; no ``state``.
        """
        values = self._head("actions", actions, self.action_groups)
        if self.action_horizon is not None and values.ndim > 1:
            values = values[..., : self.action_horizon, :]
        robot = _mapped(values, self.action_groups, Group.to_robot)
        return like_features(robot + self._reference(state, robot), is_torch(actions))

    def unactions(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """The inverse of :meth:`actions`, to train: zero-padded on the right, and cut off where the code that
        trained the head cuts off.

        Args:
            actions: ``(..., horizon, action_width)`` in the robot's units.
            state: As in :meth:`actions`; that of the observation which the result is for.

        Returns:
            ``(..., horizon, action_dim)`` float32; torch if ``actions`` was.

        Raises:
            ShapeError, DtypeError, InputError: an argument does not fit; NaN or infinity; no ``state``.
        """
        return self._to_head(actions, state, self.action_groups)

    def previous_chunk(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """What :meth:`saccade.ActionHead.sample` takes as ``previous_chunk``: as :meth:`unactions`, but
        nothing is cut off, so that actions which do not change stay what they were.

        Args, returns, raises: as :meth:`unactions`.
        """
        groups = tuple(replace(group, clips=False) for group in self.action_groups)
        return self._to_head(actions, state, groups)

    def _to_head(self, actions: ArrayLike, state: ArrayLike | None, groups: tuple[Group, ...]) -> Array:
        values = self._robot("actions", actions, groups)
        values = values - self._reference(state, values)
        normalised = padded(_mapped(values, groups, Group.to_head), self.action_dim)
        return like_features(normalised, is_torch(actions))

    def _reference(self, state: ArrayLike | None, actions: Float32Array) -> Float32Array:
        """What is added to the robot's actions: the state, where they are relative to it."""
        relative = [group for group in self.action_groups if group.reference is not None]
        if not relative:
            return np.zeros(self.action_width, np.float32)
        if state is None:
            keys = ", ".join(group.key for group in relative)
            raise InputError(f"state: expected the robot's state, which {keys} are relative to, got None")
        latest = self._robot("state", state, self.state_groups)
        if latest.ndim > 2:
            latest = latest[:, -1]  # of a history, the newest
        if latest.ndim >= actions.ndim or (latest.ndim == 2 and len(latest) != len(actions)):
            raise ShapeError(f"state: shape {latest.shape} does not fit actions of shape {actions.shape}")
        where = self.state_slices
        parts = [
            np.zeros((*latest.shape[:-1], group.size), np.float32)
            if group.reference is None
            else latest[..., where[group.reference]]
            for group in self.action_groups
        ]
        joined = np.concatenate(parts, axis=-1)
        steps = (1,) * (actions.ndim - joined.ndim)
        return joined.reshape(*joined.shape[:-1], *steps, self.action_width)

    def _robot(self, name: str, given: ArrayLike, groups: tuple[Group, ...]) -> Float32Array:
        """An array in the robot's units, checked."""
        values = _finite(name, given)
        width = sum(group.size for group in groups)
        if values.ndim < 1 or values.shape[-1] != width:
            parts = ", ".join(f"{group.key} {group.size}" for group in groups)
            robot = "" if self.embodiment is None else f" of {self.embodiment!r}"
            raise ShapeError(
                f"{name}: the Normalizer{robot} expected (..., {width}) in the robot's units ({parts}), "
                f"got {values.shape}"
            )
        return values

    def _head(self, name: str, given: ArrayLike, groups: tuple[Group, ...]) -> Float32Array:
        """An array as the head has it, checked; without its padding."""
        values = _finite(name, given)
        width = sum(group.width for group in groups)
        if values.ndim < 1 or values.shape[-1] < width:
            raise ShapeError(
                f"{name}: the Normalizer expected (..., at least {width}) as the head has it, "
                f"got {values.shape}"
            )
        return values[..., :width]

    def __repr__(self) -> str:
        def shown(groups: Iterable[Group]) -> str:
            return ", ".join(f"{group.key} {group.size} {group.mode}" for group in groups)

        return (
            f"<saccade.Normalizer embodiment={self.embodiment!r} embodiment_id={self.embodiment_id} "
            f"state=({shown(self.state_groups)}) to {self.state_dim} "
            f"action=({shown(self.action_groups)}) of {self.action_dim}>"
        )


def _mapped(
    values: Float32Array, groups: tuple[Group, ...], direction: Callable[[Group, Float32Array], Float32Array]
) -> Float32Array:
    """Every group's numbers by `Group.to_head` or `Group.to_robot`, one after the other."""
    parts, start = [], 0
    for group in groups:
        size = group.size if direction is Group.to_head else group.width
        parts.append(direction(group, values[..., start : start + size]))
        start += size
    return np.concatenate(parts, axis=-1)


def padded(values: Float32Array, width: int) -> Float32Array:
    """With zeros on the right, or cut off there."""
    given = values.shape[-1]
    if given >= width:
        return np.ascontiguousarray(values[..., :width])
    return np.concatenate([values, np.zeros((*values.shape[:-1], width - given), np.float32)], axis=-1)


def _slices(groups: tuple[Group, ...]) -> dict[str, slice]:
    ends = np.cumsum([group.size for group in groups]).tolist()
    return {group.key: slice(end - group.size, end) for group, end in zip(groups, ends, strict=True)}


def _finite(name: str, given: ArrayLike) -> Float32Array:
    values = float32(name, given)
    if not np.isfinite(values).all():
        raise InputError(f"{name}: expected finite numbers, got NaN or infinity")
    return values
