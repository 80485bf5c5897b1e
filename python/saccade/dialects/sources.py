"""Reads from a checkpoint's files which cameras a robot has, and under which key its instruction comes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from saccade.dialects.lerobot import IMAGE, IMAGES, TASK
from saccade.dialects.requirements import Camera
from saccade.errors import CheckpointError
from saccade.robots import read_json
from saccade.robots.building import size_of


@dataclass(frozen=True)
class CameraSources:
    """What a checkpoint says about the observations of one robot.

    Attributes:
        cameras: The cameras in the order of the prompt; None if it does not name them.
        video_horizon: Number of frames of each camera, or None.
        language_key: The key of the instruction, or None.
    """

    cameras: tuple[Camera, ...] | None = None
    video_horizon: int | None = None
    language_key: str | None = None


def camera_sources(folder: Path, embodiment: str | None) -> CameraSources:
    """What the files of a checkpoint say about a robot's observations.

    Args:
        folder: The checkpoint's directory. A single file says nothing.
        embodiment: Tag of the robot.

    Raises:
        CheckpointError: A file is damaged.
    """
    for name, reader in FILES.items():
        if not (folder / name).is_file():
            continue
        try:
            found = reader(folder, read_json(folder / name), embodiment)
        except (AttributeError, KeyError, TypeError, IndexError, ValueError) as error:
            if isinstance(error, CheckpointError):
                raise
            raise CheckpointError(f"{folder / name}: cameras of an unknown form ({error!r})") from error
        if found is not None:
            return found
    return CameraSources()


def _lerobot(folder: Path, values: Mapping[str, Any], embodiment: str | None) -> CameraSources | None:
    """lerobot: the policy's features, sorted by name; or the groups of N1.7, in their order."""
    steps = [step.get("config") or {} for step in values.get("steps", []) if isinstance(step, Mapping)]
    pack = next((step for step in steps if "language_key" in step), None)
    if pack is None:
        return None
    config = read_json(folder / "config.json") if (folder / "config.json").is_file() else {}
    cameras = {}
    for key, feature in sorted((config.get("input_features") or {}).items()):
        if feature.get("type") == "VISUAL" and key.startswith(IMAGE):
            name = key.removeprefix(IMAGES) if key.startswith(IMAGES) else "image"
            sizes = [size_of(size) for size in (feature.get("shape") or [])]
            known = sizes[1:] if len(sizes) == 3 and None not in sizes else [None, None]
            cameras[name] = Camera(name, *known)
    ordered = pack.get("video_modality_keys")
    if ordered and (not cameras or set(ordered) == set(cameras)):
        cameras = {name: cameras.get(name, Camera(name)) for name in _names(ordered)}
    return CameraSources(
        tuple(cameras.values()) or None,
        size_of(pack.get("video_horizon")) or 1,
        pack.get("language_key") or TASK,
    )


def _processor(folder: Path, values: Mapping[str, Any], embodiment: str | None) -> CameraSources | None:
    """Isaac-GR00T N1.6 and N1.7: modality configs by robot."""
    if "processor_kwargs" not in values:
        return None
    robots = values["processor_kwargs"].get("modality_configs") or {}
    robot = robots.get(str(embodiment))
    if robot is None:
        return CameraSources()
    video, language = robot.get("video") or {}, robot.get("language") or {}
    names = _names(video.get("modality_keys") or [])
    keys = _names(language.get("modality_keys") or [])
    return CameraSources(
        tuple(Camera(name) for name in names) or None,
        len(video.get("delta_indices") or []) or None,
        keys[0] if len(keys) == 1 else None,
    )


def _metadata(folder: Path, values: Mapping[str, Any], embodiment: str | None) -> CameraSources:
    """Isaac-GR00T N1 and N1.5: the cameras of the data set, with the size of their frames."""
    robot = values.get(str(embodiment))
    if robot is None:
        return CameraSources()
    cameras = []
    for name, about in (robot["modalities"].get("video") or {}).items():
        width, height = (size_of(size) for size in (about.get("resolution") or (None, None)))
        cameras.append(Camera(name, height, width) if height and width else Camera(name))
    return CameraSources(tuple(cameras) or None)


def _names(given: Any) -> list[str]:
    if not isinstance(given, list) or not all(isinstance(name, str) for name in given):
        raise ValueError(f"expected names, got {given!r}")
    return given


#: Files of a checkpoint that name cameras, in the order in which they are tried: that of the statistics.
FILES: dict[str, Callable[[Path, Mapping[str, Any], str | None], CameraSources | None]] = {
    "policy_preprocessor.json": _lerobot,
    "processor_config.json": _processor,
    "experiment_cfg/metadata.json": _metadata,
}
