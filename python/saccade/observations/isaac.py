"""Isaac-GR00T's two formats: nested (N1.6 and N1.7), and flat (N1.5, simulators of later versions)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array, UInt8Array, float32
from saccade.errors import InputError, ShapeError
from saccade.observations.checks import (
    as_text,
    check_batch,
    check_frames,
    check_horizons,
    check_state,
    default_instructions,
    find_cameras,
    shape_of,
    views,
)
from saccade.observations.parsed import ParsedObservation, ParsedState
from saccade.observations.requirements import Requirements

#: Keys of the nested format.
MODALITIES = ("video", "state", "language")

#: Prefixes of the flat format's keys.
ANNOTATION = "annotation"
PREFIXES = ("video.", "state.", f"{ANNOTATION}.")

#: The name of an instruction in some checkpoints, and the one that simulators send, which then counts.
TASK, COARSE = "task", "annotation.human.coarse_action"


class _Isaac(ABC):
    """What the two formats share."""

    name: str
    action_prefix: str
    language: str

    def read(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> ParsedObservation:
        """See :class:`saccade.observations.ObservationFormat`."""
        frames = read_frames("video.", self._modality(observation, "video", needs), state.is_batched, needs)
        texts, is_plain = self._instructions(observation, state, needs)
        check_batch({"state": len(state), "video": len(frames), self.language: len(texts)}, needs)
        return ParsedObservation(**vars(state), frames=frames, instructions=texts, is_plain=is_plain)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> ParsedState:
        """See :class:`saccade.observations.ObservationFormat`."""
        state, is_batched = read_state("state.", self._modality(observation, "state", needs), needs)
        return ParsedState(self, needs, is_batched, False, state)

    def write_actions(
        self, actions: Mapping[str, Float32Array], parsed: ParsedState
    ) -> dict[str, Float32Array]:
        """See :class:`saccade.observations.ObservationFormat`."""
        return {
            f"{self.action_prefix}{key}": part if parsed.is_batched else part[0]
            for key, part in actions.items()
        }

    def read_actions(self, actions: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.observations.ObservationFormat`. An array is returned unchanged."""
        if not isinstance(actions, Mapping):
            return actions
        names = [self.action_prefix + key for key in keys]
        if any(name not in actions for name in names):
            raise InputError(f"previous_chunk: expected actions {', '.join(names)}, got {', '.join(actions)}")
        parts = {name: float32("previous_chunk", actions[name]) for name in names}
        shapes = {part.shape[:-1] if part.ndim else None for part in parts.values()}
        if len(shapes) != 1 or None in shapes:
            listed = ", ".join(f"{name} {part.shape}" for name, part in parts.items())
            raise ShapeError(
                f"previous_chunk: expected actions of one number of rows and steps, got {listed}"
            )
        return np.concatenate(list(parts.values()), axis=-1)

    @abstractmethod
    def matches(self, observation: Mapping[str, Any]) -> bool:
        """See :class:`saccade.observations.ObservationFormat`."""

    @abstractmethod
    def _modality(self, observation: Mapping[str, Any], name: str, needs: Requirements) -> Mapping[str, Any]:
        """Frames or states by key."""

    @abstractmethod
    def _instructions(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> tuple[tuple[str | None, ...], bool]:
        """The instructions, and whether N1.5's prompt contains them as they are."""


class IsaacNested(_Isaac):
    """``video {name: (B, T, H, W, 3)}``, ``state {name: (B, T, D)}``, ``language {key: [[text]]}``.

    Actions are ``{name: (B, T, D)}``.
    """

    name, action_prefix, language = "isaac nested", "", "language"

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether one of the three modalities is a key."""
        return any(name in observation for name in MODALITIES)

    def _modality(self, observation: Mapping[str, Any], name: str, needs: Requirements) -> Mapping[str, Any]:
        return _part(observation, name, needs)

    def _instructions(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> tuple[tuple[str | None, ...], bool]:
        return _nested_language(observation, state, needs), False  # the instruction is always wrapped


class IsaacFlat(_Isaac):
    """``video.<name> (B, T, H, W, 3)``, ``state.<name> (B, T, D)``, and ``annotation.<...>`` or ``task``.

    Actions are ``{"action.<name>": (B, T, D)}``.
    """

    name, action_prefix, language = "isaac flat", "action.", "instructions"

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether a key has one of the prefixes."""
        return any(key.startswith(PREFIXES) for key in observation)

    def _modality(self, observation: Mapping[str, Any], name: str, needs: Requirements) -> Mapping[str, Any]:
        prefix = f"{name}."
        return {
            key.removeprefix(prefix): value for key, value in observation.items() if key.startswith(prefix)
        }

    def _instructions(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> tuple[tuple[str | None, ...], bool]:
        return _flat_language(observation, state, needs)


def _part(observation: Mapping[str, Any], name: str, needs: Requirements) -> Mapping[str, Any]:
    part = observation.get(name)
    if not isinstance(part, Mapping):
        got = "nothing" if part is None else type(part).__name__
        raise needs.input_error(name, "a mapping of names", got)
    if not all(isinstance(key, str) for key in part):
        raise needs.input_error(name, "strings as keys", repr(list(part)))
    return part


def _nested_language(
    observation: Mapping[str, Any], state: ParsedState, needs: Requirements
) -> tuple[str | None, ...]:
    """The instructions: those of the first configured key, or of the only key if none is configured.

    Every configured key must be there, as in N1.7, unless there is no instruction at all.
    """
    given = {} if observation.get("language") is None else _part(observation, "language", needs)
    is_free = needs.any_annotation or not needs.language_keys
    if is_free and len(given) > 1:
        raise needs.input_error("language", "one instruction", ", ".join(given))
    keys = tuple(given) if is_free else needs.language_keys
    if not given:
        return default_instructions(f"language.{keys[0]}" if keys else "language", len(state), needs)
    missing = [key for key in keys if key not in given]
    if missing:
        names = ", ".join(f"language.{key}" for key in missing)
        raise needs.input_error(names, f"the key {missing[0]}", ", ".join(given))
    texts = {}
    for key in keys:
        rows = given[key] if state.is_batched else [given[key]]
        texts[f"language.{key}"], _ = read_texts(f"language.{key}", rows, needs)
    check_batch({"state": len(state), **{name: len(found) for name, found in texts.items()}}, needs)
    return texts[f"language.{keys[0]}"]


def _flat_language(
    observation: Mapping[str, Any], state: ParsedState, needs: Requirements
) -> tuple[tuple[str | None, ...], bool]:
    """The instructions, and whether they are plain; without one, the released default."""
    keys = _flat_language_keys(observation, needs)
    if not keys:
        name = needs.language_key if needs.language_key and not needs.any_annotation else "annotation.*"
        return default_instructions(name, len(state), needs), False
    texts = {key: _flat_texts(key, observation[key], state.is_batched, needs) for key in keys}
    check_batch({"state": len(state), **{key: len(found) for key, (found, _) in texts.items()}}, needs)
    return texts[keys[0]]


def _flat_language_keys(observation: Mapping[str, Any], needs: Requirements) -> list[str]:
    """The language keys, that of the instruction first; none if there is no instruction at all.

    N1.5 takes any key that contains "annotation", and fails if there are two. N1.7 wants every configured
    key.
    """
    given = [key for key in observation if ANNOTATION in key]
    if TASK in observation and not (given and needs.any_annotation):
        given.append(TASK)
    if needs.any_annotation or not needs.language_keys:
        if len(given) > 1:
            raise needs.input_error("annotation.*", "one instruction", ", ".join(given))
        return given
    found: list[str] = []
    missing: list[str] = []
    for key in needs.language_keys:
        name = COARSE if key == TASK and COARSE in observation else key
        (found if name in observation else missing).append(name)
    if missing and (found or given or needs.requires_language):
        raise needs.input_error(", ".join(missing), "an instruction", ", ".join(given) or "none")
    return found


def _flat_texts(name: str, given: Any, is_batched: bool, needs: Requirements) -> tuple[tuple[str, ...], bool]:
    """The instruction of each row of one key, and whether N1.5's prompt contains them as they are."""
    has_one_form = bool(needs.language_keys) and not needs.any_annotation
    rows = given
    if has_one_form:
        # N1.7 flattens arrays of any shape, and takes a string for one row.
        if isinstance(given, np.ndarray):
            rows = given.reshape(-1)
        elif isinstance(given, str):
            rows = [given]
    elif not is_batched:
        # N1.5 adds a batch axis to lists and to arrays that have an axis, and to nothing else.
        if isinstance(given, np.ndarray) and given.ndim == 0:
            rows = given.reshape(1)
        elif not isinstance(given, tuple):
            rows = [[given] if isinstance(given, str) else given]
    texts, is_plain = read_texts(name, _numbers_as_text(rows), needs)
    return texts, is_plain and not has_one_form


def _numbers_as_text(rows: Any) -> Any:
    """Rows with the numbers after the first as text: the releases look at the first row only."""
    found = listed(rows)
    if not isinstance(found, list):
        return rows
    return [
        str(row) if place and isinstance(row, (int, float, np.number)) else row
        for place, row in enumerate(found)
    ]


def read_frames(
    prefix: str, given: Mapping[str, Any], is_batched: bool, needs: Requirements
) -> tuple[dict[str, UInt8Array], ...]:
    """The views of each observation.

    Args:
        prefix: What the keys begin with, for messages.
        given: Frames by camera, ``(batch, time, height, width, 3)``, or without batch.
        is_batched: Whether there is a batch axis.
        needs: What the robot needs.
    """
    cameras = find_cameras(prefix, given, needs, sort=False)
    frames = {}
    for camera, found in cameras:
        checked = check_frames(prefix + found, given[found], (5,) if is_batched else (4,), camera, needs)
        frames[camera.name] = checked if is_batched else checked[None]
    horizons = {name: found.shape[1] for name, found in frames.items()}
    check_horizons(prefix, horizons, needs.video_horizon, needs)
    check_batch({f"{prefix}{name}": len(found) for name, found in frames.items()}, needs)
    return views([camera for camera, _ in cameras], frames)


def is_batched(prefix: str, state: Mapping[str, Any], needs: Requirements) -> bool:
    """Whether the state has a batch axis: ``(batch, time, width)``.

    Decided as in Isaac-GR00T, but from the parts that the robot needs. N1.5 considers others too, and then
    fails if one of them lacks the axis.
    """
    shapes = {key: shape_of(prefix + key, value, needs) for key, value in state.items()}
    axes = {len(shape) for shape in shapes.values()}
    if len(axes) != 1 or not axes <= {2, 3}:
        listed = ", ".join(f"{key} {shape}" for key, shape in shapes.items())
        raise needs.shape_error(
            f"{prefix}*", "(batch, time, width) everywhere, or (time, width) everywhere", listed or "none"
        )
    return axes == {3}


def read_state(prefix: str, given: Mapping[str, Any], needs: Requirements) -> tuple[Float32Array, bool]:
    """The state ``(batch, state_history, state_width)``, and whether it had a batch axis.

    Args:
        prefix: What the keys begin with, for messages.
        given: Parts of the state by key, ``(batch, time, width)``, or without batch. Parts that the robot
            does not need are ignored, as in Isaac-GR00T.
        needs: What the robot needs.
    """
    missing = [key for key, _ in needs.state if key not in given]
    if missing:
        keys = ", ".join(prefix + key for key in missing)
        raise needs.input_error(keys, f"{', '.join(missing)} too", ", ".join(given) or "none")
    chosen = {key: given[key] for key, _ in needs.state}
    batched = is_batched(prefix, chosen, needs)
    parts = {}
    for key, width in needs.state:
        part = check_state(prefix + key, chosen[key], 3 if batched else 2, [(key, width)], needs)
        parts[key] = part if batched else part[None]
        if parts[key].shape[1] != needs.state_history:
            raise needs.shape_error(
                f"{prefix}{key}", f"{needs.state_history} along the time axis", f"shape {part.shape}"
            )
    check_batch({f"{prefix}{key}": len(part) for key, part in parts.items()}, needs)
    return np.concatenate(list(parts.values()), axis=-1), batched


def read_texts(name: str, rows: Any, needs: Requirements) -> tuple[tuple[str, ...], bool]:
    """The instruction of each row, and whether all were given as plain strings.

    Args:
        name: The key, for messages.
        rows: A list, tuple or array with a string, or a list of one string, for each row.
        needs: What the robot needs.
    """
    given = listed(rows)
    if not isinstance(given, list):
        raise needs.input_error(name, "one instruction for each row of the batch", repr(rows))
    found, plain = [], []
    for row in given:
        text = listed(row)
        plain.append(not isinstance(text, list))
        if isinstance(text, list):
            if len(text) != 1:
                raise needs.input_error(name, "one instruction for each observation", repr(row))
            text = text[0]
        found.append(as_text(name, text, needs))
    if len(set(plain)) > 1:
        raise needs.input_error(name, "strings only, or lists of one string only", repr(rows))
    return tuple(found), all(plain)


def listed(value: Any) -> Any:
    """Lists, tuples and arrays as a list; anything else, and an array without axes, as what it is."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    return list(value) if isinstance(value, (list, tuple)) else value
