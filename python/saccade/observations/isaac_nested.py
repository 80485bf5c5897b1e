"""Isaac-GR00T's nested form (N1.6 and N1.7): ``{"video": ..., "state": ..., "language": ...}``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saccade._internal.arrays import Float32Array
from saccade.observations import isaac
from saccade.observations.checks import check_batch, default_instructions
from saccade.observations.parsed import Reading, StateReading
from saccade.observations.requirements import Requirements

MODALITIES = ("video", "state", "language")


class IsaacNested:
    """``video {name: (B, T, H, W, 3)}``, ``state {name: (B, T, D)}``, ``language {key: [[text]]}``.

    The answer is ``{name: (B, T, D)}``.
    """

    name = "isaac nested"

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether one of the three modalities is a key."""
        return any(name in observation for name in MODALITIES)

    def read(self, observation: Mapping[str, Any], state: StateReading, needs: Requirements) -> Reading:
        """See :class:`saccade.observations.Dialect`."""
        frames = isaac.read_frames("video.", _part(observation, "video", needs), state.is_batched, needs)
        texts = _language(observation, state, needs)
        check_batch({"state": len(state), "video": len(frames), "language": len(texts)}, needs)
        # Isaac-GR00T's nested form always wraps the instruction.
        return Reading(self, needs, state.is_batched, False, state.state, frames, texts, is_plain=False)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> StateReading:
        """See :class:`saccade.observations.Dialect`."""
        state, is_batched = isaac.read_state("state.", _part(observation, "state", needs), needs)
        return StateReading(self, needs, is_batched, False, state)

    def answer(self, parts: Mapping[str, Float32Array], reading: StateReading) -> dict[str, Float32Array]:
        """See :class:`saccade.observations.Dialect`."""
        return isaac.answer(parts, "", reading.is_batched)

    def previous_chunk(self, answer: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.observations.Dialect`."""
        return isaac.joined(answer, "", keys, "previous_chunk")


def _part(observation: Mapping[str, Any], name: str, needs: Requirements) -> Mapping[str, Any]:
    part = observation.get(name)
    if not isinstance(part, Mapping):
        got = "nothing" if part is None else type(part).__name__
        raise needs.input_error(name, "a mapping of names", got)
    if not all(isinstance(key, str) for key in part):
        raise needs.input_error(name, "strings as keys", repr(list(part)))
    return part


def _language(
    observation: Mapping[str, Any], state: StateReading, needs: Requirements
) -> tuple[str | None, ...]:
    """The instructions: those of the first configured key, or of the only key if none is configured.

    Every configured key must be there, as in N1.7, unless there are no words at all.
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
        texts[f"language.{key}"], _ = isaac.read_texts(f"language.{key}", rows, needs)
    check_batch({"state": len(state), **{name: len(found) for name, found in texts.items()}}, needs)
    return texts[f"language.{keys[0]}"]
