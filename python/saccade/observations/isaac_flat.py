"""Isaac-GR00T's flat form (N1.5, simulators of later versions): ``video.ego_view``, ``state.left_arm``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.observations import isaac
from saccade.observations.checks import check_batch, default_instructions
from saccade.observations.parsed import Reading, StateReading
from saccade.observations.requirements import Requirements

ANNOTATION = "annotation"
PREFIXES = ("video.", "state.", f"{ANNOTATION}.")

#: The name of an instruction in some checkpoints, and the one that simulators send, which then counts.
TASK, COARSE = "task", "annotation.human.coarse_action"


class IsaacFlat:
    """``video.<name> (B, T, H, W, 3)``, ``state.<name> (B, T, D)``, and ``annotation.<...>`` or ``task``.

    The answer is ``{"action.<name>": (B, T, D)}``.
    """

    name = "isaac flat"

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether a key has one of the prefixes."""
        return any(key.startswith(PREFIXES) for key in observation)

    def read(self, observation: Mapping[str, Any], state: StateReading, needs: Requirements) -> Reading:
        """See :class:`saccade.observations.Dialect`."""
        frames = isaac.read_frames("video.", _below(observation, "video."), state.is_batched, needs)
        texts, is_plain = _language(observation, state, needs)
        check_batch({"state": len(state), "video": len(frames), "instructions": len(texts)}, needs)
        return Reading(self, needs, state.is_batched, False, state.state, frames, texts, is_plain)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> StateReading:
        """See :class:`saccade.observations.Dialect`."""
        state, is_batched = isaac.read_state("state.", _below(observation, "state."), needs)
        return StateReading(self, needs, is_batched, False, state)

    def answer(self, parts: Mapping[str, Float32Array], reading: StateReading) -> dict[str, Float32Array]:
        """See :class:`saccade.observations.Dialect`."""
        return isaac.answer(parts, "action.", reading.is_batched)

    def previous_chunk(self, answer: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.observations.Dialect`."""
        return isaac.joined(answer, "action.", keys, "previous_chunk")


def _below(observation: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {key.removeprefix(prefix): value for key, value in observation.items() if key.startswith(prefix)}


def _language(
    observation: Mapping[str, Any], state: StateReading, needs: Requirements
) -> tuple[tuple[str | None, ...], bool]:
    """The instructions, and whether they are plain; without one, the released default."""
    keys = _language_keys(observation, needs)
    if not keys:
        name = needs.language_key if needs.language_key and not needs.any_annotation else "annotation.*"
        return default_instructions(name, len(state), needs), False
    texts = {key: _texts(key, observation[key], state.is_batched, needs) for key in keys}
    check_batch({"state": len(state), **{key: len(found) for key, (found, _) in texts.items()}}, needs)
    return texts[keys[0]]


def _language_keys(observation: Mapping[str, Any], needs: Requirements) -> list[str]:
    """The keys of words, that of the instruction first; none if there are no words at all.

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


def _texts(name: str, given: Any, is_batched: bool, needs: Requirements) -> tuple[tuple[str, ...], bool]:
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
    texts, is_plain = isaac.read_texts(name, _numbers_as_text(rows), needs)
    return texts, is_plain and not has_one_form


def _numbers_as_text(rows: Any) -> Any:
    """Rows with the numbers after the first as text: the releases look at the first row only."""
    found = isaac.listed(rows)
    if not isinstance(found, list):
        return rows
    return [
        str(row) if place and isinstance(row, (int, float, np.number)) else row
        for place, row in enumerate(found)
    ]
