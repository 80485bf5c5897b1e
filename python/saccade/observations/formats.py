"""The observation formats, and how the format of an observation is detected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saccade.errors import InputError
from saccade.observations.isaac import IsaacFlat, IsaacNested
from saccade.observations.lerobot import Lerobot
from saccade.observations.parsed import ObservationFormat, ParsedObservation, ParsedState
from saccade.observations.requirements import Requirements

#: All formats, in the order in which they are tried.
FORMATS: tuple[ObservationFormat, ...] = (Lerobot(), IsaacFlat(), IsaacNested())


def read(
    observation: Mapping[str, Any], needs: Requirements, most_rows: int | None = None
) -> ParsedObservation:
    """Parses and checks an observation of any format.

    Args:
        observation: The observation.
        needs: What the robot needs.
        most_rows: An observation with more rows is refused before its frames are looked at.

    Raises:
        InputError, ShapeError, DtypeError: It has no known format, or does not fit. The message lists what
            the robot needs.
    """
    found = _format_of(observation, needs)
    state = found.read_state(observation, needs)
    if most_rows is not None and len(state) > most_rows:
        raise InputError(f"observation: expected at most {most_rows} rows, got {len(state)}")
    return found.read(observation, state, needs)


def read_state(observation: Mapping[str, Any], needs: Requirements) -> ParsedState:
    """Parses and checks the state of an observation of any format; raises as :func:`read`."""
    return _format_of(observation, needs).read_state(observation, needs)


def _format_of(observation: Mapping[str, Any], needs: Requirements) -> ObservationFormat:
    if not isinstance(observation, Mapping):
        raise needs.input_error("observation", "a mapping", type(observation).__name__)
    if not all(isinstance(key, str) for key in observation):
        raise needs.input_error("observation", "strings as keys", repr(list(observation)))
    for known in FORMATS:
        if known.matches(observation):
            return known
    raise needs.input_error(
        "observation",
        "the keys of Isaac-GR00T (video, state, language, or video.*, state.*, annotation.*) or of lerobot "
        "(observation.images.*, observation.state, task)",
        ", ".join(observation) or "none",
    )
