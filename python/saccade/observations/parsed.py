"""An observation after it was read: the same for every form in which it can be given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.observations.requirements import Requirements


@dataclass(frozen=True, eq=False)
class StateReading:
    """The state of one or several observations, and the form of the answer.

    Attributes:
        dialect: The form.
        needs: What the observation was checked against.
        is_batched: Whether the observation had a batch axis.
        use_torch: Whether the answer consists of torch tensors.
        state: ``(batch, state_history, state_width)`` float32 in the robot's units.
    """

    dialect: Dialect
    needs: Requirements
    is_batched: bool
    use_torch: bool
    state: Float32Array

    def __len__(self) -> int:
        return len(self.state)


@dataclass(frozen=True, eq=False)
class Reading(StateReading):
    """One or several observations, checked. It shares the memory of the caller's arrays where it can.

    Attributes:
        frames: For each observation the frames ``(height, width, 3)`` by the name of the view, in the order
            of the prompt. With several frames a camera, the views are ``name[0]``, ``name[1]``, ..., oldest
            first, and ordered by time before camera.
        instructions: The instruction of each observation; None for the released default.
        is_plain: Whether N1.5's prompt contains the instruction as it is, and not as ``['...']``. Isaac-GR00T
            renders a batch with one string a row in this way.
    """

    frames: tuple[dict[str, UInt8Array], ...]
    instructions: tuple[str | None, ...]
    is_plain: bool


class Dialect(Protocol):
    """A form of observations and answers."""

    name: str

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether the keys are those of this form."""

    def read(self, observation: Mapping[str, Any], state: StateReading, needs: Requirements) -> Reading:
        """Reads and checks frames and instructions.

        Args:
            observation: The observation.
            state: What `read_state` read of it.
            needs: What the robot needs.

        Raises:
            InputError, ShapeError, DtypeError: Something is missing or does not fit. The message lists what
                the robot needs.
        """

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> StateReading:
        """Reads and checks the state; frames and instruction may be missing. Raises as `read`."""

    def answer(self, parts: Mapping[str, Float32Array], reading: StateReading) -> Any:
        """The actions in this form.

        Args:
            parts: The actions by key, in the order of the robot's action, ``(batch, ..., horizon, width)``.
            reading: What the actions are for.
        """

    def previous_chunk(self, answer: Any, keys: tuple[str, ...]) -> Any:
        """The inverse of `answer`: one array ``(..., horizon, action_width)``.

        Raises:
            InputError: An action is missing.
        """
