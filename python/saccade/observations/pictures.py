"""Observations from image files, instructions and states in a directory. Needs Pillow."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np

from saccade._internal.arrays import LARGEST, UInt8Array
from saccade._internal.small_files import read_json_value
from saccade.errors import InputError, SaccadeError
from saccade.observations.formats import read
from saccade.observations.requirements import Requirements
from saccade.robots import Normalizer

#: Endings of the files that are taken for pictures. Others are left alone.
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".ppm")

#: Kinds of pictures with eight bits a colour, as Pillow names them. Transparency is dropped.
MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "HSV", "LAB")

STATE = "state.json"


class ObservingPolicy(Protocol):
    """What is needed of a :class:`saccade.Policy`: its robot's requirements and statistics."""

    requirements: Requirements
    normalizer: Normalizer

    def example_observation(self) -> dict[str, Any]:
        """As :meth:`saccade.Policy.example_observation`."""


@dataclass(frozen=True, eq=False)
class PictureObservation:
    """One observation from a folder with a picture for each camera.

    Attributes:
        name: The folder of its pictures, relative to the directory: ``"0001"`` or ``"pour/0001"``; for a
            directory that is itself such a folder, the directory's own name.
        episode: The folder that contains this folder, ``"pour"``, or None. Observations of one episode are
            alike.
        observation: In Isaac-GR00T's nested format, with a batch of one; see
            :meth:`saccade.Policy.example_observation`.
    """

    name: str
    episode: str | None
    observation: dict[str, Any]

    @property
    def instruction(self) -> str:
        """The instruction."""
        return instruction_of(self.observation)


def read_frames(
    directory: Path, policy: ObservingPolicy, *, instruction: str | None = None, state: Path | None = None
) -> list[PictureObservation]:
    """The observations of a directory, in the order of their names (2 before 10).

    A folder with one picture for each camera, named after it, is an observation: ``front.png``,
    ``wrist.jpg``. It may also contain ``state.json``, see :func:`read_state`. The directory is

    - one observation: ``DIR/front.png``;
    - or a folder for each observation: ``DIR/0001/front.png``, ``DIR/0002/front.png``;
    - or one for each episode, with a folder for each observation: ``DIR/pour/0001/front.png``.

    Hidden files and files that are no pictures are ignored. If the checkpoint does not name its cameras, all
    pictures of a folder are views, in the order of their names. If an observation contains several frames of
    a camera, each of them is the picture.

    Args:
        directory: The directory.
        policy: The policy that is to accept the observations.
        instruction: The instruction. Default: that of :meth:`saccade.Policy.example_observation`.
        state: File with the state of folders that have no ``state.json``. Default: the middle of the robot's
            range.

    Returns:
        At least one observation.

    Raises:
        FileNotFoundError, NotADirectoryError: There is no such directory or file.
        InputError, ShapeError, DtypeError: There are no pictures, one of a camera is missing, cannot be read
            or does not fit, or a state does not fit. The message names the folder.

    Example:
        >>> import saccade
        >>> from saccade.observations.pictures import read_frames
        >>> def chunks(checkpoint: str, directory: Path) -> dict:
        ...     policy = saccade.Policy.from_pretrained(checkpoint)
        ...     found = read_frames(directory, policy, instruction="open the drawer")
        ...     return {one.name: policy.act(one.observation, seed=0) for one in found}
    """
    if not directory.is_dir():
        kind = NotADirectoryError if directory.exists() else FileNotFoundError
        raise kind(f"{directory}: no such directory; expected one with a picture for each camera")
    otherwise = None if state is None else read_state(state)
    found = []
    for folder in observation_folders(directory, policy):
        own = folder / STATE
        try:
            given = observation(
                policy,
                pictures_in(folder, policy),
                instruction,
                read_state(own) if own.is_file() else otherwise,
            )
            read(given, policy.requirements)
        except SaccadeError as error:
            if str(error).startswith((f"{folder}{os.sep}", f"{folder}:")):
                raise
            raise type(error)(f"{folder}: {error}") from None
        parts = folder.relative_to(directory).parts
        found.append(
            PictureObservation(
                name="/".join(parts) or folder.resolve().name,
                episode=parts[0] if len(parts) == 2 else None,
                observation=given,
            )
        )
    return found


def observation_folders(folder: Path, policy: ObservingPolicy, levels: int = 2) -> list[Path]:
    """The folders in a folder, or itself, that are observations; ``levels`` of folders are looked into."""
    pictures, inside = contents_of(folder)
    if pictures and inside:
        raise InputError(
            f"{folder}: expected pictures or folders of pictures, got pictures and the folder "
            f"{inside[0].name}"
        )
    if pictures:
        return [folder]
    if not inside or not levels:
        raise InputError(
            f"{folder}: expected pictures named after the cameras ({example_names(policy)}), or a folder "
            "of them for each observation, got no pictures"
        )
    return [found for one in inside for found in observation_folders(one, policy, levels - 1)]


def pictures_in(folder: Path, policy: ObservingPolicy) -> dict[str, Path]:
    """The picture of each camera in a folder, in the order of the prompt."""
    given, _ = contents_of(folder)
    by_name: dict[str, Path] = {}
    for path in given:
        if path.stem in by_name:
            raise InputError(
                f"{folder}: expected one picture of {path.stem}, got {by_name[path.stem].name} and "
                f"{path.name}"
            )
        by_name[path.stem] = path
    cameras = policy.requirements.cameras
    names = list(by_name) if cameras is None else [camera.name for camera in cameras]
    if set(by_name) != set(names):
        listed = ", ".join(path.name for path in given)
        raise InputError(
            f"{folder}: expected one picture for each camera ({example_names(policy)}), got {listed}"
        )
    return {name: by_name[name] for name in names}


def example_names(policy: ObservingPolicy) -> str:
    """Possible names of the pictures of an observation, for messages."""
    cameras = policy.requirements.cameras
    names = ["front"] if cameras is None else [camera.name for camera in cameras]
    return ", ".join(f"{name}.png" for name in names)


def contents_of(folder: Path) -> tuple[list[Path], list[Path]]:
    """The pictures and the folders in a folder, by name. Hidden and other files are left out."""
    shown = [path for path in sorted(folder.iterdir(), key=by_number) if not path.name.startswith(".")]
    pictures = [path for path in shown if path.suffix.lower() in SUFFIXES and path.is_file()]
    return pictures, [path for path in shown if path.is_dir()]


def by_number(path: Path) -> list[tuple[int, str]]:
    """A key that sorts numbers in names by their size: step9 before step10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(int(part), "") if index % 2 else (0, part) for index, part in enumerate(parts)]


def observation(
    policy: ObservingPolicy, pictures: Mapping[str, Path], instruction: str | None, state: Any
) -> dict[str, Any]:
    """An observation as :meth:`saccade.Policy.example_observation` returns it, with what is given in it.

    These are files by camera, whose name may be empty if there is one camera, the instruction, and what
    :func:`read_state` returned.
    """
    given = policy.example_observation()
    if pictures:
        cameras = policy.requirements.cameras
        only = cameras[0].name if cameras is not None and len(cameras) == 1 else next(iter(given["video"]))
        horizon = policy.requirements.video_horizon or 1
        given["video"] = {
            name or only: np.repeat(read_picture(path)[None, None], horizon, axis=1)
            for name, path in pictures.items()
        }
    if isinstance(state, list):
        width = policy.requirements.state_width
        if len(state) != width:
            keys = ", ".join(f"{key} ({size})" for key, size in policy.requirements.state)
            raise InputError(f"state: expected {width} numbers ({keys}), got {len(state)}")
        state = {key: state[where] for key, where in policy.normalizer.state_slices.items()}
    if state is not None:
        history = policy.requirements.state_history
        given["state"] = {
            key: np.tile(np.asarray(values, np.float32), (1, history, 1)) for key, values in state.items()
        }
    if instruction is not None:
        given["language"] = {key: [[instruction]] for key in given["language"]}
    return given


def instruction_of(given: Mapping[str, Any]) -> str:
    """The instruction of an observation that :func:`observation` returned."""
    return str(next(iter(given["language"].values()))[0][0])


def read_state(path: Path) -> Any:
    """The state in a JSON file: numbers by key, ``{"arm": [0, 0.1], "hand": [1]}``, or one list of all.

    Raises:
        FileNotFoundError: The file does not exist.
        InputError: It contains something else, or cannot be read.
    """
    values = read_json_value(path, InputError)
    rows = list(values.values()) if isinstance(values, dict) else [values]
    if not rows or not all(_is_numbers(row) for row in rows):
        raise InputError(f"{path}: expected lists of numbers by key, or one list of numbers")
    return values


def _is_numbers(row: Any) -> bool:
    """Whether a value of JSON is a list of numbers that float32 can hold."""
    return isinstance(row, list) and all(type(one) in (int, float) and abs(one) <= LARGEST for one in row)


def read_picture(path: Path) -> UInt8Array:
    """The picture in a file, ``(height, width, 3)``, turned as a camera's orientation tag says."""
    from PIL import Image, ImageOps

    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with Image.open(path) as picture:
            if picture.mode not in MODES:
                raise InputError(f"{path}: expected a picture with 8 bits a colour, got mode {picture.mode}")
            turned = ImageOps.exif_transpose(picture)
            return cast("UInt8Array", np.asarray(turned.convert("RGB")))
    except InputError:
        raise
    # Pillow raises SyntaxError and others for files that are damaged in their own ways.
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: cannot be read as a picture: {error}") from None
