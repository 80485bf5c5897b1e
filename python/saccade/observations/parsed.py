"""Interface of an observation format, and an observation after parsing: the same for every format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from saccade._internal.arrays import Float32Array, UInt8Array
from saccade.observations.requirements import Requirements


@dataclass(frozen=True, eq=False)
class ParsedState:
    """The state of one or several observations, and how to return actions for them.

    Attributes:
        format: The format of the observation.
        needs: The requirements that the observation was checked against.
        is_batched: Whether the observation had a batch axis.
        use_torch: Whether actions are returned as torch tensors.
        state: ``(batch, state_history, state_width)`` float32 in the robot's units.
    """

    format: ObservationFormat
    needs: Requirements
    is_batched: bool
    use_torch: bool
    state: Float32Array

    def __len__(self) -> int:
        return len(self.state)


@dataclass(frozen=True, eq=False)
class ParsedObservation(ParsedState):
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


class ObservationFormat(Protocol):
    """A layout of observations and of the actions that answer them."""

    name: str

    def matches(self, observation: Mapping[str, Any]) -> bool:
        """Whether the keys are those of this format."""

    def read(
        self, observation: Mapping[str, Any], state: ParsedState, needs: Requirements
    ) -> ParsedObservation:
        """Parses and checks frames and instructions.

        Args:
            observation: The observation.
            state: The result of :meth:`read_state`.
            needs: What the robot needs.

        Raises:
            InputError, ShapeError, DtypeError: Something is missing or does not fit. The message lists what
                the robot needs.
        """

    def read_state(self, observation: Mapping[str, Any], needs: Requirements) -> ParsedState:
        """Parses and checks the state; frames and instruction may be missing. Raises as :meth:`read`."""

    def write_actions(self, actions: Mapping[str, Float32Array], parsed: ParsedState) -> Any:
        """Actions in this format.

        Args:
            actions: The actions by key, in the order of the robot's action, ``(batch, ..., horizon, width)``
                float32 in the robot's units.
            parsed: The state that the actions are for.
        """

    def read_actions(self, actions: Any, keys: tuple[str, ...]) -> Any:
        """The inverse of :meth:`write_actions`: one array ``(..., horizon, action_width)``.

        Raises:
            InputError: An action is missing.
        """
