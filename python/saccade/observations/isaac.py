"""Isaac-GR00T's two formats: nested (N1.6 and N1.7), and flat (N1.5, simulators of later versions)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array, float32
from saccade.errors import InputError, ShapeError
from saccade.observations.checks import (
    as_list,
    as_text,
    check_batch,
    check_frames,
    check_state,
    default_instructions,
    find_cameras,
    shape_of,
    views,
)
from saccade.observations.parsed import ObservationFormat, ParsedObservation, ParsedState
from saccade.observations.requirements import Requirements

#: Keys of the nested format.
MODALITIES = ("video", "state", "language")

#: Prefixes of the flat format's keys.
ANNOTATION = "annotation"
PREFIXES = ("video.", "state.", f"{ANNOTATION}.")

#: The name of an instruction in some checkpoints, and the one that simulators send, which then counts.
TASK, COARSE = "task", "annotation.human.coarse_action"


class _Isaac(ObservationFormat):
    """What the two formats share."""

    action_prefix: str
    language: str

    def read(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> ParsedObservation:
        given, frames = self._modality(observation, "video", needs), {}
        for camera, found in find_cameras("video.", given, needs, sort=False):
            checked = check_frames(
                f"video.{found}", given[found], (5 if state.is_batched else 4,), camera, needs
            )
            frames[camera.name] = checked if state.is_batched else checked[None]
        seen = views("video.", frames, needs.video_horizon, needs)
        texts, is_plain = self._instructions(observation, state, needs)
        check_batch({"state": len(state), "video": len(seen), self.language: len(texts)}, needs)
        return ParsedObservation(**vars(state), frames=seen, instructions=texts, is_plain=is_plain)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> ParsedState:
        given = self._modality(observation, "state", needs)
        missing = [key for key, _ in needs.state if key not in given]
        if missing:
            keys = ", ".join(f"state.{key}" for key in missing)
            raise needs.input_error(keys, f"{', '.join(missing)} too", ", ".join(given) or "none")
        # Decided as in Isaac-GR00T, but from the parts that the robot needs. N1.5 considers others too, and
        # then fails if one of them lacks the axis.
        shapes = {key: shape_of(f"state.{key}", given[key], needs) for key, _ in needs.state}
        axes = {len(shape) for shape in shapes.values()}
        if axes not in ({2}, {3}):
            listed = ", ".join(f"{key} {shape}" for key, shape in shapes.items())
            raise needs.shape_error(
                "state.*", "(batch, time, width) everywhere, or (time, width) everywhere", listed or "none"
            )
        is_batched = axes == {3}
        parts = {}
        for key, width in needs.state:
            part = check_state(f"state.{key}", given[key], 3 if is_batched else 2, [(key, width)], needs)
            parts[f"state.{key}"] = part if is_batched else part[None]
            if part.shape[-2] != needs.state_history:
                raise needs.shape_error(
                    f"state.{key}", f"{needs.state_history} along the time axis", f"shape {part.shape}"
                )
        check_batch({name: len(part) for name, part in parts.items()}, needs)
        return ParsedState(self, needs, is_batched, False, np.concatenate(list(parts.values()), axis=-1))

    def write_actions(
        self, actions: Mapping[str, Float32Array], parsed: ParsedState
    ) -> dict[str, Float32Array]:
        return {
            f"{self.action_prefix}{key}": part if parsed.is_batched else part[0]
            for key, part in actions.items()
        }

    def read_actions(self, actions: Any, keys: tuple[str, ...]) -> Any:
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
        part = observation.get(name)
        if not isinstance(part, Mapping):
            got = "nothing" if part is None else type(part).__name__
            raise needs.input_error(name, "a mapping of names", got)
        if not all(isinstance(key, str) for key in part):
            raise needs.input_error(name, "strings as keys", repr(list(part)))
        return part

    def _instructions(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> tuple[tuple[str | None, ...], bool]:
        """Those of the first configured key, or of the only key if none is configured.

        Every configured key must be there, as in N1.7, unless there is no instruction at all.
        """
        has_any = observation.get("language") is not None
        given = self._modality(observation, "language", needs) if has_any else {}
        is_free = needs.any_annotation or not needs.language_keys
        if is_free and len(given) > 1:
            raise needs.input_error("language", "one instruction", ", ".join(given))
        keys = tuple(given) if is_free else needs.language_keys
        names = [f"language.{key}" for key in keys] or ["language"]
        if not given:
            return default_instructions(names[0], len(state), needs), False
        missing = [key for key in keys if key not in given]
        if missing:
            listed = ", ".join(f"language.{key}" for key in missing)
            raise needs.input_error(listed, f"the key {missing[0]}", ", ".join(given))
        texts = {}
        for name, key in zip(names, keys, strict=True):
            texts[name], _ = _texts(name, given[key] if state.is_batched else [given[key]], needs)
        check_batch({"state": len(state), **{name: len(found) for name, found in texts.items()}}, needs)
        return texts[names[0]], False  # the instruction is always wrapped


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
        keys = _language_keys(observation, needs)
        if not keys:
            name = needs.language_key if needs.language_key and not needs.any_annotation else "annotation.*"
            return default_instructions(name, len(state), needs), False
        texts = {key: _flat_texts(key, observation[key], state.is_batched, needs) for key in keys}
        check_batch({"state": len(state), **{key: len(found) for key, (found, _) in texts.items()}}, needs)
        return texts[keys[0]]


def _language_keys(observation: Mapping[str, Any], needs: Requirements) -> list[str]:
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
    found = as_list(rows)
    if isinstance(found, list):  # the releases look at the first row only, and take numbers after it
        is_number = [isinstance(row, (int, float, np.number)) for row in found]
        rows = [str(row) if place and is_number[place] else row for place, row in enumerate(found)]
    texts, is_plain = _texts(name, rows, needs)
    return texts, is_plain and not has_one_form


def _texts(name: str, rows: Any, needs: Requirements) -> tuple[tuple[str, ...], bool]:
    """The instruction of each row, and whether all were given as strings, not as lists of one string."""
    given = as_list(rows)
    if not isinstance(given, list):
        raise needs.input_error(name, "one instruction for each row of the batch", repr(rows))
    found, plain = [], []
    for row in given:
        text = as_list(row)
        plain.append(not isinstance(text, list))
        if isinstance(text, list):
            if len(text) != 1:
                raise needs.input_error(name, "one instruction for each observation", repr(row))
            text = text[0]
        found.append(as_text(name, text, needs))
    if len(set(plain)) > 1:
        raise needs.input_error(name, "strings only, or lists of one string only", repr(rows))
    return tuple(found), all(plain)
