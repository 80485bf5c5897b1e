"""Required cameras, state and language of a robot's observation, for checks and for messages."""

from __future__ import annotations

from dataclasses import dataclass

from saccade.errors import DtypeError, InputError, ShapeError


@dataclass(frozen=True)
class Camera:
    """A camera of a robot.

    Attributes:
        name: Its name, without prefix.
        height, width: The size of its frames where the release refuses other sizes; otherwise None.
        alias: Another name, accepted if an observation does not have ``name``.
    """

    name: str
    height: int | None = None
    width: int | None = None
    alias: str | None = None

    def __str__(self) -> str:
        name = self.name if self.alias is None else f"{self.name} or {self.alias}"
        return name if self.height is None else f"{name} ({self.height} x {self.width})"


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
        language_keys: The language keys that the checkpoint configures. The first is the instruction's. All
            must be in an observation of Isaac-GR00T's formats.
        requires_language: Whether a missing instruction is an error, as in Isaac-GR00T N1.6 and N1.7.
            Otherwise it is the released default.
        any_annotation: Whether the only key that contains "annotation" is the instruction, whatever it is
            called, as in Isaac-GR00T N1 and N1.5.
        takes_extra_cameras: Whether cameras beyond ``cameras`` are views too. All are then sorted by name, as
            in lerobot. Otherwise they are ignored.
        rename_map: Keys of lerobot's format and the names that they get before anything else is read.
        video_indices, state_indices: The steps of the frames and states of an observation, relative to now;
            None if the checkpoint does not say.
        observation_indices, action_indices: The steps of observations and actions, which a server reports to
            its clients.
    """

    embodiment: str | None = None
    cameras: tuple[Camera, ...] | None = None
    state: tuple[tuple[str, int], ...] = ()
    state_history: int = 1
    video_horizon: int | None = None
    language_keys: tuple[str, ...] = ()
    requires_language: bool = False
    any_annotation: bool = False
    takes_extra_cameras: bool = False
    rename_map: tuple[tuple[str, str], ...] = ()
    video_indices: tuple[int, ...] | None = None
    state_indices: tuple[int, ...] | None = None
    observation_indices: tuple[int, ...] | None = None
    action_indices: tuple[int, ...] | None = None

    @property
    def state_width(self) -> int:
        """Number of values of the state."""
        return sum(width for _, width in self.state)

    @property
    def language_key(self) -> str | None:
        """The key of the instruction, or None if the checkpoint does not name it."""
        return self.language_keys[0] if self.language_keys else None

    def __str__(self) -> str:
        robot = "this robot" if self.embodiment is None else f"embodiment {self.embodiment!r}"
        state = ", ".join(f"{key} ({width})" for key, width in self.state)
        if self.state_history != 1:
            state += f" with {self.state_history} states each"
        return f"{robot} needs {self._cameras()}; state keys {state}; {self._language()}"

    def _cameras(self) -> str:
        if self.cameras is None:
            found = "cameras of any names, as in training"
        else:
            found = "cameras " + ", ".join(map(str, self.cameras))
            if self.video_horizon not in (None, 1):
                found += f" with {self.video_horizon} frames each"
            if self.takes_extra_cameras:
                found += " (others are views too, all sorted by name)"
        if self.rename_map:
            found += ", after renaming " + ", ".join(f"{old} to {new}" for old, new in self.rename_map)
        return found

    def _language(self) -> str:
        if self.any_annotation:
            return "an instruction under one key that contains 'annotation'"
        if len(self.language_keys) > 1:
            return f"language keys {', '.join(self.language_keys)} (the first is the instruction)"
        return f"language key {self.language_keys[0]}" if self.language_keys else "an instruction"

    def shape_error(self, name: str, expected: str, got: object) -> ShapeError:
        """An error about a shape, which lists what the robot needs."""
        return ShapeError(f"{name}: expected {expected}, got {got}; {self}")

    def dtype_error(self, name: str, expected: str, got: object) -> DtypeError:
        """An error about a type, which lists what the robot needs."""
        return DtypeError(f"{name}: expected {expected}, got {got}; {self}")

    def input_error(self, name: str, expected: str, got: object) -> InputError:
        """An error about a value or a key, which lists what the robot needs."""
        return InputError(f"{name}: expected {expected}, got {got}; {self}")
