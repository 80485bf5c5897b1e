"""What policies take as observations: one or several, with or without a batch axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.observations import Reading, StateReading

#: One observation in a form of `saccade.observations`, with or without a batch axis.
Observation = Mapping[str, Any]
#: Or several of them. The server gives what it has read of them by `saccade.observations`.
Observations = Observation | Reading | Sequence[Observation | Reading]


def is_observation(value: Any) -> bool:
    """Whether a value is an observation or a sequence of them, and not an array."""
    if isinstance(value, (list, tuple)):
        return bool(value) and isinstance(value[0], Mapping | Reading)
    return isinstance(value, Mapping | Reading)


def listed(observation: Observations) -> list[Observation | Reading]:
    """Observations as a list.

    Raises:
        InputError: There is none.
    """
    if isinstance(observation, Mapping | Reading):
        return [observation]
    found = list(observation) if isinstance(observation, (list, tuple)) else []
    if not found:
        raise InputError(
            f"observation: expected a mapping, or several of them, got {type(observation).__name__}"
        )
    return found


def batched(array: Float32Array, axes: int, reading: StateReading) -> Float32Array:
    """An array with a batch axis, which it may lack if the observation does."""
    return array[None] if not reading.is_batched and array.ndim == axes - 1 else array
