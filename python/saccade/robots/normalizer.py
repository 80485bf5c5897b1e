"""Converts between a robot's units and the normalised values of the head."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from saccade._internal.arrays import (
    Array,
    ArrayLike,
    Float32Array,
    exact_float32,
    float32,
    integer,
    is_torch,
    like_features,
)
from saccade.errors import InputError, ShapeError
from saccade.robots.building import Options
from saccade.robots.data_configs import DataConfigLike
from saccade.robots.data_configs import data_config as read_data_config
from saccade.robots.groups import Group
from saccade.robots.libero import gripper_command
from saccade.robots.reading import read
from saccade.robots.robot import Robot


class Normalizer(Robot):
    """Converts a robot's state to the input of the head, and the output of the head to the robot's actions.

    The head works on values of about -1 to 1, zero-padded to widths that all robots share. The statistics for
    the conversion are stored with the weights. :meth:`from_pretrained` reads them, and they are applied as in
    the code that trained the checkpoint.

    The attributes are those of :class:`saccade.robots.Robot`.

    Example:
        Two joints and a gripper that never moved in the data:

        >>> import numpy as np, saccade
        >>> statistics = {"min": [-1.0, 0.0, 0.5], "max": [1.0, 4.0, 0.5]}
        >>> both = {"state": statistics, "action": statistics}
        >>> normalizer = saccade.Normalizer.from_pretrained(both, state_dim=5)
        >>> normalizer.state(np.array([[0.5, 1.0, 0.5]]))
        array([[ 0.5, -0.5,  0. ,  0. ,  0. ]], dtype=float32)
        >>> normalizer.actions(np.array([[[0.5, -0.5, 0.25]]]))
        array([[[0.5, 1. , 0.5]]], dtype=float32)
    """

    @classmethod
    def from_pretrained(
        cls,
        id_or_path: str | os.PathLike[str] | Mapping[str, Any],
        embodiment: str | int | None = None,
        *,
        revision: str | None = None,
        data_config: DataConfigLike | None = None,
        state_dim: int | None = None,
        action_dim: int | None = None,
    ) -> Normalizer:
        """Reads the statistics of a checkpoint.

        These layouts are tried in this order:

        - lerobot: ``policy_preprocessor.json``, ``policy_postprocessor.json`` and the ``.safetensors`` files
          that they name. Every step is applied, or refused by its name.
        - Isaac-GR00T N1.6 and N1.7: ``processor_config.json``, ``statistics.json``, ``embodiment_id.json``,
          in the checkpoint's folder or in ``processor/``.
        - Isaac-GR00T N1 and N1.5: ``experiment_cfg/metadata.json``. The checkpoint does not contain the data
          config that it was trained with.
        - A mapping or a JSON file: the contents of ``metadata.json``, or ``{"state": {"min": ..., "max":
          ...}, "action": ...}``, or the same with ``"mean"`` and ``"std"``.

        Args:
            id_or_path: The directory or id of a checkpoint, one of these files, or a mapping.
            embodiment: Tag or id of the robot, or the name that the release has for the tag. Required if the
                statistics are of several robots.
            revision: A branch, tag or commit of the id. Default: ``main``.
            data_config: N1 and N1.5: the data config of the checkpoint, by the name that Isaac-GR00T gives
                it, as the path of a JSON file, or as a mapping; see ``docs/robots.md``. It says which keys
                are used, in which order, and how. Default: all keys in the order of the file, min-max
                (discrete ones: binary), with a warning. Required for ``gr1``, and where a key is a rotation.
            state_dim: Width of the head's state. Default: as in the checkpoint, else the width of the robot's
                state.
            action_dim: Width of the head's actions. Default: likewise.

        Raises:
            FileNotFoundError: ``id_or_path`` or the file of ``data_config`` does not exist.
            CheckpointError: There are no statistics, they are damaged, or something in the files is not known
                and could change the answer. The message lists every problem.
            InputError: An option does not fit the statistics.
        """
        options = Options(
            embodiment,
            None if state_dim is None else integer("state_dim", state_dim),
            None if action_dim is None else integer("action_dim", action_dim),
            None if data_config is None else read_data_config(data_config),
        )
        return cls(**vars(read(id_or_path, revision, options)))

    @property
    def state_slices(self) -> dict[str, slice]:
        """Slice of the robot's state by key."""
        return dict(self._slices[0])

    @property
    def action_slices(self) -> dict[str, slice]:
        """Slice of the robot's action by key."""
        return dict(self._slices[1])

    @cached_property
    def _slices(self) -> tuple[dict[str, slice], dict[str, slice]]:
        return _slices(self.state_groups), _slices(self.action_groups)

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

    def denormalize_state(self, state: ArrayLike) -> Array:
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
        return like_features(self._absolute(robot, state), is_torch(actions))

    def normalize_actions(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
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
        return self._to_head("actions", actions, state, self.action_groups)

    def previous_chunk(self, actions: ArrayLike, state: ArrayLike | None = None) -> Array:
        """Converts a chunk to the ``previous_chunk`` of :meth:`saccade.ActionHead.sample`.

        This is :meth:`normalize_actions` without clipping, so that frozen actions keep their values.
        """
        groups = tuple(replace(group, clips=False) for group in self.action_groups)
        return self._to_head("previous_chunk", actions, state, groups)

    def _to_head(
        self, name: str, actions: ArrayLike, state: ArrayLike | None, groups: tuple[Group, ...]
    ) -> Array:
        values = self._relative(self._robot(name, actions, groups), state)
        normalised = padded(_mapped(values, groups, Group.to_head), self.action_dim)
        return like_features(normalised, is_torch(actions))

    def _absolute(self, actions: Float32Array, state: ArrayLike | None) -> Float32Array:
        """Actions after the steps that follow the normalisation: references, LIBERO's gripper, offsets."""
        latest = self._latest(state, actions)
        if latest is not None:
            actions = self._by_reference(Group.absolute, actions, latest)
        if self.gripper is not None:
            actions = actions.copy()
            actions[..., self.gripper] = gripper_command(actions[..., self.gripper])
        return actions if latest is None else actions + self._offset(latest)

    def _relative(self, actions: Float32Array, state: ArrayLike | None) -> Float32Array:
        """The inverse of :meth:`_absolute`. A gripper that is open or closed gives 0 or 1."""
        latest = self._latest(state, actions)
        if latest is not None:
            actions = actions - self._offset(latest)
        if self.gripper is not None:
            actions = actions.copy()
            actions[..., self.gripper] = (1 - actions[..., self.gripper]) / 2
        return actions if latest is None else self._by_reference(Group.relative, actions, latest)

    def _by_reference(
        self,
        convert: Callable[[Group, Float32Array, Float32Array], Float32Array],
        actions: Float32Array,
        latest: Float32Array,
    ) -> Float32Array:
        """Applies ``Group.absolute`` or ``Group.relative`` to the groups that have a reference."""
        if all(group.reference is None for group in self.action_groups):
            return actions
        states, parts = self.state_slices, []
        for group, where in zip(self.action_groups, self.action_slices.values(), strict=True):
            part = actions[..., where]
            if group.reference is not None:
                reference = latest[..., states[group.reference.key]][..., : group.size]
                part = convert(group, reference, part)
            parts.append(part)
        return np.concatenate(parts, axis=-1)

    def _offset(self, latest: Float32Array) -> Float32Array:
        """What lerobot's generic step adds to the action."""
        if self.offsets is None:
            return np.zeros(self.action_width, np.float32)
        return np.where(self.offsets, latest[..., : self.action_width], np.float32(0))

    def _latest(self, state: ArrayLike | None, actions: Float32Array) -> Float32Array | None:
        """The newest state, with axes of length one for samples and steps; None if actions do not need it."""
        relative = [group.key for group in self.action_groups if group.reference is not None]
        if self.offsets is None and not relative:
            return None
        if state is None:
            keys = ", ".join(relative) or "this robot"
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
        steps = (1,) * (actions.ndim - latest.ndim)
        return latest.reshape(*latest.shape[:-1], *steps, self.state_width)

    def _robot(self, name: str, given: ArrayLike, groups: tuple[Group, ...]) -> Float32Array:
        """An array in the robot's units, after checking its width."""
        values = exact_float32(name, given)
        width = sum(group.size for group in groups)
        if values.ndim < 1 or values.shape[-1] != width:
            parts = ", ".join(f"{group.key} {group.size}" for group in groups)
            robot = "" if self.embodiment is None else f" of {self.embodiment!r}"
            raise ShapeError(
                f"{name}: the Normalizer{robot} expected (..., {width}) in the robot's units ({parts}), "
                f"got {values.shape}"
            )
        if not np.isfinite(values).all():
            wrong = [
                key for key, where in _slices(groups).items() if not np.isfinite(values[..., where]).all()
            ]
            raise InputError(f"{name}: expected finite numbers, got NaN or infinity in {', '.join(wrong)}")
        return values

    def _head(self, name: str, given: ArrayLike, groups: tuple[Group, ...]) -> Float32Array:
        """An array of the head without its padding, after checking its width."""
        values = float32(name, given)
        if not np.isfinite(values).all():
            raise InputError(f"{name}: expected finite numbers, got NaN or infinity")
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
    """Applies ``Group.to_head`` or ``Group.to_robot`` to every group, and concatenates the results."""
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
