"""Step 1 of :meth:`saccade.Policy.act`: parse and check one observation or several."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.observations import ParsedObservation, ParsedState, Requirements, read, read_state

#: One observation in a format of :mod:`saccade.observations`, with or without a batch axis.
Observation: TypeAlias = Mapping[str, Any]
#: One or several observations. Each may have been parsed already by :func:`saccade.observations.read`.
Observations: TypeAlias = Observation | ParsedObservation | Sequence[Observation | ParsedObservation]

Parsed = TypeVar("Parsed", bound=ParsedState, covariant=True)
Kind = TypeVar("Kind", bound=ParsedState)


@dataclass(frozen=True, eq=False)
class Batch(Generic[Parsed]):
    """Parsed observations that are computed together. Each may have several rows."""

    parsed: Sequence[Parsed]
    is_single: bool  # whether one observation was given, and not a sequence

    def __iter__(self) -> Iterator[Parsed]:
        return iter(self.parsed)

    def __len__(self) -> int:
        return len(self.parsed)

    @cached_property
    def state(self) -> Float32Array:
        """The states of all rows, ``(rows, state_history, state_width)`` in the robot's units."""
        states = [one.state for one in self.parsed]
        return states[0] if len(states) == 1 else np.concatenate(states)


def is_observation(value: Any) -> bool:
    """Whether a value is an observation or a sequence of them, and not an array."""
    if isinstance(value, (list, tuple)):
        return bool(value) and isinstance(value[0], Mapping | ParsedObservation)
    return isinstance(value, Mapping | ParsedObservation)


def read_observations(observations: Observations, needs: Requirements) -> Batch[ParsedObservation]:
    """Parses and checks observations. Those that were parsed before must be of this policy."""
    return _batch(observations, needs, read)


def read_states(observations: Observations, needs: Requirements) -> Batch[ParsedState]:
    """Parses and checks only the states of observations."""
    return _batch(observations, needs, read_state)


def _batch(
    observations: Observations, needs: Requirements, reader: Callable[[Observation, Requirements], Kind]
) -> Batch[Kind | ParsedObservation]:
    is_single = isinstance(observations, Mapping | ParsedObservation)
    listed: list[Any] = [observations] if is_single else []
    if isinstance(observations, (list, tuple)):
        listed = list(observations)
    if not listed:
        raise InputError(
            f"observation: expected a mapping, or several of them, got {type(observations).__name__}"
        )
    found: list[Kind | ParsedObservation] = []
    for one in listed:
        if isinstance(one, ParsedObservation) and one.needs != needs:
            raise InputError(
                f"observation: expected what was read for this policy, got what was read for "
                f"another: {one.needs}, but {needs}"
            )
        found.append(one if isinstance(one, ParsedObservation) else reader(one, needs))
    return Batch(found, is_single)
