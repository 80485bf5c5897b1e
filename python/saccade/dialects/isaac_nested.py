"""Isaac-GR00T's nested form (N1.6 and N1.7): ``{"video": ..., "state": ..., "language": ...}``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saccade._arrays import Float32Array
from saccade.dialects import isaac
from saccade.dialects.checks import check_batch
from saccade.dialects.reading import Reading, StateReading
from saccade.dialects.requirements import Requirements

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
        """See :class:`saccade.dialects.Dialect`."""
        frames = isaac.read_frames("video.", _part(observation, "video", needs), state.is_batched, needs)
        texts, _ = _language(_part(observation, "language", needs), state.is_batched, needs)
        check_batch({"state": len(state), "video": len(frames), "language": len(texts)}, needs)
        # Isaac-GR00T's nested form always wraps the instruction.
        return Reading(self, needs, state.is_batched, False, state.state, frames, texts, is_plain=False)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> StateReading:
        """See :class:`saccade.dialects.Dialect`."""
        state, is_batched = isaac.read_state("state.", _part(observation, "state", needs), needs)
        return StateReading(self, needs, is_batched, False, state)

    def answer(self, parts: Mapping[str, Float32Array], reading: StateReading) -> dict[str, Float32Array]:
        """See :class:`saccade.dialects.Dialect`."""
        return isaac.answer(parts, "", reading.is_batched)

    def previous_chunk(self, answer: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.dialects.Dialect`."""
        return isaac.joined(answer, "", keys, "previous_chunk")


def _part(observation: Mapping[str, Any], name: str, needs: Requirements) -> Mapping[str, Any]:
    part = observation.get(name)
    if not isinstance(part, Mapping):
        got = "nothing" if part is None else type(part).__name__
        raise needs.input_error(name, "a mapping of names", got)
    return part


def _language(
    given: Mapping[str, Any], is_batched: bool, needs: Requirements
) -> tuple[tuple[str, ...], bool]:
    key = needs.language_key
    if key not in given and len(given) == 1 and key is None:
        key = next(iter(given))
    if key is None or key not in given:
        expected = "one instruction" if key is None else f"the key {key}"
        raise needs.input_error("language", expected, ", ".join(given) or "none")
    return isaac.read_texts(f"language.{key}", given[key], is_batched, needs)
