"""Isaac-GR00T's flat form (N1.5, simulators of later versions): ``video.ego_view``, ``state.left_arm``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saccade._arrays import Float32Array
from saccade.dialects import isaac
from saccade.dialects.checks import check_batch
from saccade.dialects.reading import Reading, StateReading
from saccade.dialects.requirements import Requirements

PREFIXES = ("video.", "state.", "annotation.")

#: What a checkpoint may call the instruction that some simulators send under another name.
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
        """See :class:`saccade.dialects.Dialect`."""
        frames = isaac.read_frames("video.", _below(observation, "video."), state.is_batched, needs)
        texts, is_plain = _language(observation, state, needs)
        check_batch({"state": len(state), "video": len(frames), "instructions": len(texts)}, needs)
        return Reading(self, needs, state.is_batched, False, state.state, frames, texts, is_plain)

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> StateReading:
        """See :class:`saccade.dialects.Dialect`."""
        state, is_batched = isaac.read_state("state.", _below(observation, "state."), needs)
        return StateReading(self, needs, is_batched, False, state)

    def answer(self, parts: Mapping[str, Float32Array], reading: StateReading) -> dict[str, Float32Array]:
        """See :class:`saccade.dialects.Dialect`."""
        return isaac.answer(parts, "action.", reading.is_batched)

    def previous_chunk(self, answer: Any, keys: tuple[str, ...]) -> Any:
        """See :class:`saccade.dialects.Dialect`."""
        return isaac.joined(answer, "action.", keys, "previous_chunk")


def _below(observation: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {key.removeprefix(prefix): value for key, value in observation.items() if key.startswith(prefix)}


def _language(
    observation: Mapping[str, Any], state: StateReading, needs: Requirements
) -> tuple[tuple[str | None, ...], bool]:
    """The instructions, and whether they are plain; without one, N1.5's default."""
    known = needs.language_key
    if known is None:
        keys = [key for key in observation if key.startswith("annotation.") or key == TASK]
    else:
        keys = [key for key in (known, COARSE if known == TASK else known) if key in observation][:1]
    if len(keys) > 1:
        raise needs.input_error("annotation.*", "one instruction", ", ".join(keys))
    if keys:
        return isaac.read_texts(keys[0], observation[keys[0]], state.is_batched, needs)
    if known is not None:
        raise needs.input_error(known, "an instruction", "none")
    return (None,) * len(state), False
