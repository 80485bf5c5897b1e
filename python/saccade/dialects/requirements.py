"""What a robot's observation must contain: cameras, state and language, for checks and for messages."""

from __future__ import annotations

from dataclasses import dataclass

from saccade.errors import DtypeError, InputError, ShapeError


@dataclass(frozen=True)
class Camera:
    """A camera of a robot.

    Attributes:
        name: Its name, without prefix.
        height, width: The size of its frames, or None if any size is accepted.
    """

    name: str
    height: int | None = None
    width: int | None = None

    def __str__(self) -> str:
        return self.name if self.height is None else f"{self.name} ({self.height} x {self.width})"


@dataclass(frozen=True)
class Requirements:
    """What an observation of one robot must contain.

    Attributes:
        embodiment: The robot's tag, or None.
        cameras: The cameras in the order of the prompt; None if the checkpoint does not name them. Any names
            are then accepted.
        state: Key and width of each part of the state, in order.
        state_history: Number of states in an observation.
        video_horizon: Number of frames of each camera in an observation; None if the checkpoint does not say.
        language_key: The key of the instruction, or None if the checkpoint does not name it.
    """

    embodiment: str | None
    cameras: tuple[Camera, ...] | None
    state: tuple[tuple[str, int], ...]
    state_history: int = 1
    video_horizon: int | None = None
    language_key: str | None = None

    @property
    def state_width(self) -> int:
        """Number of values of the state."""
        return sum(width for _, width in self.state)

    def __str__(self) -> str:
        robot = "this robot" if self.embodiment is None else f"embodiment {self.embodiment!r}"
        if self.cameras is None:
            cameras = "cameras of any names, as in training"
        else:
            cameras = "cameras " + ", ".join(map(str, self.cameras))
            if self.video_horizon not in (None, 1):
                cameras += f" with {self.video_horizon} frames each"
        state = ", ".join(f"{key} ({width})" for key, width in self.state)
        if self.state_history != 1:
            state += f" with {self.state_history} states each"
        language = "an instruction" if self.language_key is None else f"language key {self.language_key}"
        return f"{robot} needs {cameras}; state keys {state}; {language}"

    def shape_error(self, name: str, expected: str, got: object) -> ShapeError:
        """An error about a shape, which lists what the robot needs."""
        return ShapeError(f"{name}: expected {expected}, got {got}; {self}")

    def dtype_error(self, name: str, expected: str, got: object) -> DtypeError:
        """An error about a type, which lists what the robot needs."""
        return DtypeError(f"{name}: expected {expected}, got {got}; {self}")

    def input_error(self, name: str, expected: str, got: object) -> InputError:
        """An error about a value or a key, which lists what the robot needs."""
        return InputError(f"{name}: expected {expected}, got {got}; {self}")
