"""The table of forms, and how the form of an observation is told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from saccade.errors import InputError
from saccade.observations.isaac_flat import IsaacFlat
from saccade.observations.isaac_nested import IsaacNested
from saccade.observations.lerobot import Lerobot
from saccade.observations.parsed import Dialect, Reading, StateReading
from saccade.observations.requirements import Requirements

#: All forms, in the order in which they are tried.
DIALECTS: tuple[Dialect, ...] = (Lerobot(), IsaacFlat(), IsaacNested())


def read(observation: Mapping[str, Any], needs: Requirements, most_rows: int | None = None) -> Reading:
    """Reads an observation of any form.

    Args:
        observation: The observation.
        needs: What the robot needs.
        most_rows: An observation with more rows is refused before its frames are looked at.

    Raises:
        InputError, ShapeError, DtypeError: It has no known form, or does not fit. The message lists what the
            robot needs.
    """
    dialect = _dialect(observation, needs)
    state = dialect.read_state(observation, needs)
    if most_rows is not None and len(state) > most_rows:
        raise InputError(f"observation: expected at most {most_rows} rows, got {len(state)}")
    return dialect.read(observation, state, needs)


def read_state(observation: Mapping[str, Any], needs: Requirements) -> StateReading:
    """Reads the state of an observation of any form; raises as `read`."""
    return _dialect(observation, needs).read_state(observation, needs)


def _dialect(observation: Mapping[str, Any], needs: Requirements) -> Dialect:
    if not isinstance(observation, Mapping):
        raise needs.input_error("observation", "a mapping", type(observation).__name__)
    if not all(isinstance(key, str) for key in observation):
        raise needs.input_error("observation", "strings as keys", repr(list(observation)))
    for dialect in DIALECTS:
        if dialect.matches(observation):
            return dialect
    raise needs.input_error(
        "observation",
        "the keys of Isaac-GR00T (video, state, language, or video.*, state.*, annotation.*) or of lerobot "
        "(observation.images.*, observation.state, task)",
        ", ".join(observation) or "none",
    )
