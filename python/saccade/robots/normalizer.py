"""Converts between a robot's units and the normalised values of the head."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from saccade._arrays import Array, ArrayLike, Float32Array, float32, integer, is_torch, like_features
from saccade.errors import InputError, ShapeError
from saccade.robots.building import Options
from saccade.robots.groups import Group, Robot
from saccade.robots.reading import read


class Normalizer(Robot):
    """Converts a robot's state to the input of the head, and the output of the head to the robot's actions.

    The head works on values of about -1 to 1, zero-padded to widths that all robots share. The statistics for
    the conversion are stored with the weights. :meth:`load` reads them and applies them as the code that
    trained the checkpoint does.

    The attributes are those of :class:`saccade.robots.Robot`.

    Example:
        Two joints and a gripper that never moved in the data:

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

        These layouts are tried in this order:

        - lerobot: ``policy_preprocessor.json``, ``policy_postprocessor.json`` and the ``.safetensors`` files
          that they name. Min-max; for N1.7 also with the groups and relative actions of Isaac-GR00T.
        - Isaac-GR00T N1.6 and N1.7: ``processor_config.json``, ``statistics.json``, ``embodiment_id.json``.
        - Isaac-GR00T N1 and N1.5: ``experiment_cfg/metadata.json``. The checkpoint does not contain the keys
          of the data config, their order and their modes. The default is all keys in the order of the file,
          min-max for continuous keys and binary for others.
        - A mapping or a JSON file: the contents of any of these files, or ``{"state": {"min": ..., "max":
          ...}, "action": ...}``, or the same with ``"mean"`` and ``"std"``.

        Args:
            source: The directory or id of a checkpoint, one of these files, or a mapping.
            embodiment: Tag or id of the robot. Required if the statistics are of several robots.
            state_dim: Width of the head's state. Default: as in the checkpoint, else the width of the robot's
                state.
            action_dim: Width of the head's actions. Default: likewise.
            state_keys: The keys of the state in their order. For ``metadata.json`` only, as the next two.
            action_keys: The keys of the action in their order.
            modes: How to normalise: one of ``"min_max"``, ``"q99"``, ``"mean_std"``, ``"binary"``,
                ``"sin_cos"`` (states only) and ``"none"``, for all keys or by key (``"state.left_arm"``).
                Required for a key that is a rotation, because the data configs of Isaac-GR00T may convert
                rotations to another representation, which is not supported here.

        Raises:
            FileNotFoundError: ``source`` does not exist.
            CheckpointError: There are no statistics, or they are damaged. The message lists every problem.
            InputError: An option does not fit the statistics.
        """
        options = Options(
            embodiment,
            None if state_dim is None else integer("state_dim", state_dim),
            None if action_dim is None else integer("action_dim", action_dim),
            _key_names("state_keys", state_keys),
            _key_names("action_keys", action_keys),
            _checked_modes(modes),
        )
        return cls(**vars(read(source, options)))

    @property
    def state_slices(self) -> dict[str, slice]:
        """Slice of the robot's state by key."""
        return _slices(self.state_groups)

    @property
    def action_slices(self) -> dict[str, slice]:
        """Slice of the robot's action by key."""
        return _slices(self.action_groups)

    @property
    def state_width(self) -> int:
        """Number of values of the robot's state."""
        return sum(group.size for group in self.state_groups)

    @property
    def action_width(self) -> int:
        """Number of values of the robot's action."""
        return sum(group.size for group in self.action_groups)

    def state(self, state: ArrayLike) -> Array:
        """Converts the robot's state to the input of the head.

        Args:
            state: ``(..., state_width)`` in the robot's units, with the keys in order.

        Returns:
            ``(..., state_dim)`` float32, normalised and zero-padded; a torch tensor if ``state`` was one.

        Raises:
            ShapeError, DtypeError, InputError: ``state`` does not fit or is not finite.
        """
        values = self._robot("state", state, self.state_groups)
        if self.zero_state:
            normalised = np.zeros((*values.shape[:-1], self.state_dim), np.float32)
        else:
            # Isaac-GR00T and lerobot cut off a state that is wider than the head's.
            normalised = padded(_mapped(values, self.state_groups, Group.to_head), self.state_dim)
        return like_features(normalised, is_torch(state))

    def unstate(self, state: ArrayLike) -> Array:
        """The inverse of :meth:`state`: ``(..., state_dim)`` to ``(..., state_width)``.

        Constant dimensions are returned as the constant, and clipped values stay clipped.

        Raises:
            ShapeError, DtypeError, InputError: ``state`` does not fit or is not finite, a key is not
                invertible (``"sin_cos"``), or the head gets zeros in place of a state.
        """
        if self.zero_state:
            raise InputError(
                "state: cannot be converted back, because this head gets zeros in place of a state"
            )
        values = self._head("state", state, self.state_groups)
        return like_features(_mapped(values, self.state_groups, Group.to_robot), is_torch(state))

    @property
    def head_action_width(self) -> int:
        """Number of values of the head's action that the robot uses. They come first; the rest is padding."""
        return sum(group.width for group in self.action_groups)

    def actions(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """Converts a chunk of the head to the robot's actions.

        Args:
            actions: ``(..., horizon, action_dim)`` as the head returns it. Padding is cut off: dimensions
                beyond the robot's action, and steps beyond ``action_horizon``.
            state: The state that the chunk was sampled for, in the robot's units: ``(state_width,)``,
                ``(batch, state_width)`` or ``(batch, history, state_width)``. Required if actions are
                relative to the state.

        Returns:
            ``(..., horizon, action_width)`` float32 in the robot's units; a torch tensor if ``actions`` was
            one.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit or is not finite, or ``state`` is
                missing.
        """
        values = self._head("actions", actions, self.action_groups)
        if self.action_horizon is not None and values.ndim > 1:
            values = values[..., : self.action_horizon, :]
        robot = _mapped(values, self.action_groups, Group.to_robot)
        return like_features(robot + self._reference(state, robot), is_torch(actions))

    def unactions(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """The inverse of :meth:`actions`, for training.

        The result is zero-padded on the right, and clipped as in the code that trained the head.

        Args:
            actions: ``(..., horizon, action_width)`` in the robot's units.
            state: The state of the observation that the result is for, as in :meth:`actions`.

        Returns:
            ``(..., horizon, action_dim)`` float32; a torch tensor if ``actions`` was one.

        Raises:
            ShapeError, DtypeError, InputError: An argument does not fit or is not finite, or ``state`` is
                missing.
        """
        return self._to_head(actions, state, self.action_groups)

    def previous_chunk(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """Converts a chunk to the ``previous_chunk`` of :meth:`saccade.ActionHead.sample`.

        This is :meth:`unactions` without clipping, so that frozen actions keep their values.
        """
        groups = tuple(replace(group, clips=False) for group in self.action_groups)
        return self._to_head(actions, state, groups)

    def _to_head(self, actions: ArrayLike, state: ArrayLike | None, groups: tuple[Group, ...]) -> Array:
        values = self._robot("actions", actions, groups)
        values = values - self._reference(state, values)
        normalised = padded(_mapped(values, groups, Group.to_head), self.action_dim)
        return like_features(normalised, is_torch(actions))

    def _reference(self, state: ArrayLike | None, actions: Float32Array) -> Float32Array:
        """What is added to the robot's actions: the state for relative groups, else zero."""
        relative = [group for group in self.action_groups if group.reference is not None]
        if not relative:
            return np.zeros(self.action_width, np.float32)
        if state is None:
            keys = ", ".join(group.key for group in relative)
            raise InputError(
                f"state: expected the robot's state, because the actions of {keys} are relative to it, got "
                "None"
            )
        latest = self._robot("state", state, self.state_groups)
        if latest.ndim > 2:
            latest = latest[:, -1]  # the newest of a history
        if latest.ndim >= actions.ndim or (latest.ndim == 2 and len(latest) != len(actions)):
            raise ShapeError(
                f"state: expected a shape that fits actions of shape {actions.shape}, got {latest.shape}"
            )
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
        """An array in the robot's units, after checking its width."""
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
        """An array of the head without its padding, after checking its width."""
        values = _finite(name, given)
        width = sum(group.width for group in groups)
        if values.ndim < 1 or values.shape[-1] < width:
            raise ShapeError(
                f"{name}: the Normalizer expected (..., at least {width}) as the head returns it, "
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
    """Applies `Group.to_head` or `Group.to_robot` to every group, and concatenates the results."""
    parts, start = [], 0
    for group in groups:
        size = group.size if direction is Group.to_head else group.width
        parts.append(direction(group, values[..., start : start + size]))
        start += size
    return np.concatenate(parts, axis=-1)


def padded(values: Float32Array, width: int) -> Float32Array:
    """Pads the last axis with zeros on the right, or cuts it off there."""
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


def _checked_modes(modes: str | Mapping[str, str] | None) -> str | Mapping[str, str] | None:
    if modes is not None and not isinstance(modes, (str, Mapping)):
        raise InputError(f"modes: expected a name, or names by key, got {type(modes).__name__}")
    return modes


def _key_names(name: str, given: Sequence[str] | None) -> tuple[str, ...] | None:
    if given is None:
        return None
    keys = () if isinstance(given, str) else tuple(given)
    if not keys or len(set(keys)) != len(keys) or not all(isinstance(key, str) for key in keys):
        raise InputError(f"{name}: expected distinct names, at least one, got {given!r}")
    return keys
