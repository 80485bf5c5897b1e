"""Reads from a checkpoint's files which cameras and language keys the observations of a robot have."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError
from saccade.observations.lerobot import IMAGE, IMAGES
from saccade.observations.requirements import Camera, Requirements
from saccade.robots import Robot
from saccade.robots.building import is_list_of, size_of
from saccade.robots.lerobot_pipeline import POSTPROCESSOR, PREPROCESSOR, action_steps, read_pipeline
from saccade.robots.libero import CAMERA_ALIASES
from saccade.robots.reading import processor_folder, processor_version


def read_requirements(folder: Path, robot: Robot) -> Requirements:
    """The requirements of a robot's observations: its state, and what a checkpoint says about the rest.

    Args:
        folder: The checkpoint's directory. A single file says nothing.
        robot: The robot, such as a :class:`saccade.Normalizer`.

    Raises:
        CheckpointError: A file is damaged.
    """
    return replace(
        _from_files(folder, robot),
        embodiment=robot.embodiment,
        state=tuple((group.key, group.size) for group in robot.state_groups),
        state_history=robot.state_history or 1,
    )


def _from_files(folder: Path, robot: Robot) -> Requirements:
    for name, reader in FILES.items():
        where = processor_folder(folder) if reader is _processor else folder
        if not (where / name).is_file():
            continue
        try:
            found = reader(folder, read_json(where / name), robot)
        except (AttributeError, KeyError, TypeError, IndexError, ValueError) as error:
            if isinstance(error, CheckpointError):
                raise
            raise CheckpointError(f"{where / name}: cameras of an unknown form ({error!r})") from error
        if found is not None:
            return found
    return Requirements()


def _lerobot(folder: Path, values: Mapping[str, Any], robot: Robot) -> Requirements | None:
    """lerobot: the policy's features, sorted by name; or N1.7's keys that are among them, in their order."""
    pipeline = robot.pipeline
    if pipeline is None or pipeline.where != str(folder / PREPROCESSOR):  # statistics of another checkpoint
        pipeline = read_pipeline(folder, values)
    if pipeline is None:
        return None
    pack = pipeline.pack.config
    features = pipeline.config.get("input_features") or {}
    names = [
        key.removeprefix(IMAGES) if key.startswith(IMAGES) else "image"
        for key, feature in sorted(features.items())
        if feature.get("type") == "VISUAL" and key.startswith(IMAGE)
    ]
    ordered = _ordered(_names(pack.get("video_modality_keys") or []), names)
    cameras = ordered or tuple(Camera(name) for name in names)
    return Requirements(
        cameras=cameras or None,
        # N1.7 without a horizon takes every frame that there is.
        video_horizon=size_of(pack.get("video_horizon")) or (None if pipeline.is_n17 else 1),
        language_keys=(pack.get("language_key") or "task",),
        takes_extra_cameras=not ordered,
        rename_map=tuple(pipeline.rename_map.items()),
        action_indices=_steps(
            folder / POSTPROCESSOR, "action", action_steps(pipeline.unpack.config.get("modality_config"))
        ),
    )


def _ordered(keys: list[str], names: list[str]) -> tuple[Camera, ...]:
    """The cameras that N1.7's ``video_modality_keys`` name; without any feature, all that they name."""
    if not names:
        return tuple(Camera(key, alias=CAMERA_ALIASES.get(key)) for key in keys)
    found = []
    for key in keys:
        alias = CAMERA_ALIASES.get(key)
        if key in names:
            found.append(Camera(key, alias=alias))
        elif alias in names:
            found.append(Camera(alias))
    return tuple(found)


def _processor(folder: Path, values: Mapping[str, Any], robot: Robot) -> Requirements | None:
    """Isaac-GR00T N1.6 and N1.7: modality configs by robot."""
    if "processor_kwargs" not in values:
        return None
    robots = values["processor_kwargs"].get("modality_configs") or {}
    about = robots.get(str(robot.embodiment))
    if about is None:
        return Requirements(requires_language=True)
    video, language = about.get("video") or {}, about.get("language") or {}
    cameras = _names(video.get("modality_keys") or [])
    keys = _names(language.get("modality_keys") or [])
    if len(keys) > 1 and processor_version(folder, values) == "n1.6":
        raise CheckpointError(
            f"{folder}: {robot.embodiment}: expected one language key, as the released N1.6 does, got "
            f"{', '.join(keys)}"
        )
    where = processor_folder(folder) / "processor_config.json"
    steps = {
        kind: _steps(where, f"{robot.embodiment}: {kind}", (about.get(kind) or {}).get("delta_indices", []))
        for kind in ("video", "state", "action")
    }
    return Requirements(
        cameras=tuple(Camera(name) for name in cameras) or None,
        video_horizon=len(steps["video"] or ()) or None,
        video_indices=steps["video"],
        state_indices=steps["state"],
        action_indices=steps["action"],
        language_keys=tuple(keys),
        requires_language=True,
    )


def _metadata(folder: Path, values: Mapping[str, Any], robot: Robot) -> Requirements:
    """Isaac-GR00T N1 and N1.5: cameras of the data config, or all, of the size that the data set has."""
    about, data_config = values.get(str(robot.embodiment)), robot.data_config
    if about is None:
        return Requirements(any_annotation=True)
    known = about["modalities"].get("video") or {}
    cameras = []
    for name in known if data_config is None else data_config.keys("video"):
        width, height = (size_of(size) for size in (known[name].get("resolution") or (None, None)))
        cameras.append(Camera(name, height, width) if height and width else Camera(name))
    if data_config is None:
        return Requirements(cameras=tuple(cameras) or None, any_annotation=True)
    return Requirements(
        cameras=tuple(cameras),
        video_horizon=len(data_config.observation_indices),
        language_keys=data_config.language_keys,
        any_annotation=True,
        video_indices=data_config.observation_indices,
        state_indices=data_config.observation_indices,
        observation_indices=data_config.observation_indices,
        action_indices=data_config.action_indices,
    )


def _steps(where: Path, modality: str, given: Any) -> tuple[int, ...] | None:
    """The ``delta_indices`` of a modality; None if there are none.

    Raises:
        CheckpointError: They are not a list of integers.
    """
    if not is_list_of(int, given):
        raise CheckpointError(
            f"{where}: {modality}: delta_indices: expected a list of integers, got {given!r:.60}"
        )
    return tuple(given) or None


def _names(given: Any) -> list[str]:
    if not is_list_of(str, given):
        raise ValueError(f"expected names, got {given!r}")
    return list(given)


#: Files of a checkpoint that name cameras, in the order in which they are tried: that of the statistics.
FILES: dict[str, Callable[[Path, Mapping[str, Any], Robot], Requirements | None]] = {
    "policy_preprocessor.json": _lerobot,
    "processor_config.json": _processor,
    "experiment_cfg/metadata.json": _metadata,
}
