"""Statistics of lerobot: ``policy_preprocessor.json``, ``policy_postprocessor.json`` and files they name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from saccade.errors import CheckpointError
from saccade.robots.building import Builder, Dims, Options, finished, size_of
from saccade.robots.files import read_json, read_small_tensors
from saccade.robots.groups import Group, Robot
from saccade.robots.isaac_processor import processor_robot

#: Registered names of the steps that normalise, and of those that turn actions into the robot's units.
PACK_STEPS = ("groot_pack_inputs", "groot_n1_7_pack_inputs")
UNPACK_STEPS = ("groot_action_unpack_unnormalize", "groot_n1_7_action_decode")


def lerobot_robot(folder: Path, preprocessor: Mapping[str, Any], options: Options) -> Robot | None:
    """The robot of a checkpoint's directory; None if ``preprocessor`` has no step of GR00T.

    Raises:
        FileNotFoundError, CheckpointError, InputError: As :meth:`saccade.Normalizer.load`.
    """
    where = str(folder / "policy_preprocessor.json")
    pack = _step(preprocessor, PACK_STEPS)
    if pack is None:
        return None
    options.refuse_keys(where)
    after = folder / "policy_postprocessor.json"
    unpack = _step(read_json(after) if after.is_file() else {}, UNPACK_STEPS)
    if unpack is None:
        raise CheckpointError(f"{after}: no step of GR00T that turns actions into the robot's units")
    taking, giving = _config(pack), _config(unpack)
    ids = {tag: number for tag, number in taking.get("embodiment_mapping", {}).items() if type(number) is int}
    tag = str(taking.get("embodiment_tag", "new_embodiment"))
    embodiment_id = ids.get(tag, 0)  # as lerobot does with an unknown tag
    options.check_only(tag, embodiment_id, where)
    dims = (size_of(taking.get("max_state_dim")), size_of(taking.get("max_action_dim")))
    for name in ("libero_gripper_action", "action_decode_transform"):
        if giving.get(name):
            raise CheckpointError(
                f"{after}: {name} ({giving[name]}) is not supported: it changes the gripper"
            )
    if taking.get("raw_stats") and taking.get("modality_config"):
        kwargs = _processor_kwargs(tag, taking, giving, dims)
        return processor_robot(where, kwargs, {tag: taking["raw_stats"]}, ids, options)
    builder = Builder(where, np.float32)
    is_n17 = str(pack["registry_name"]).startswith("groot_n1_7")
    clips = is_n17 and taking.get("clip_outliers", True)
    state, action = builder.check(_groups(builder, folder, pack, unpack, bool(clips)))
    return finished(where, options, tag, embodiment_id, (state,), (action,), dims)


def _processor_kwargs(
    tag: str, taking: Mapping[str, Any], giving: Mapping[str, Any], dims: Dims
) -> dict[str, Any]:
    """The steps of N1.7 as the arguments of Isaac-GR00T's processor."""
    return {
        **{name: taking.get(name) for name in ("use_percentiles", "clip_outliers")},
        "use_relative_action": giving.get("use_relative_action", False),
        "modality_configs": {tag: taking["modality_config"]},
        "max_state_dim": dims[0],
        "max_action_dim": dims[1],
    }


def _groups(
    builder: Builder, folder: Path, pack: Mapping[str, Any], unpack: Mapping[str, Any], clips: bool
) -> list[Group | None]:
    """A group for the whole state, and one for the whole action."""
    taking, giving = _config(pack), _config(unpack)
    statistics = [_statistics(folder, step) for step in (pack, unpack)]
    features = read_json(folder / "config.json") if (folder / "config.json").is_file() else {}
    sizes = (
        _feature(features.get("input_features"), "observation.state"),
        size_of(giving.get("env_action_dim")) or _feature(features.get("output_features"), "action"),
    )
    groups: list[Group | None] = []
    for found, config, key, size in zip(
        statistics, (taking, giving), ("observation.state", "action"), sizes, strict=True
    ):
        name = key.rpartition(".")[2]
        group: Group | None = None
        if config.get("normalize_min_max", True) and key in found:
            clips_back = bool(config.get("clip_normalized_action"))
            group = builder.group(name, found[key], "min_max", clips=clips, clips_back=clips_back)
            if group is not None and size is not None and group.size != size:
                builder.problems.append(f"{name}: {size} numbers, but statistics of {group.size}")
        elif size is None:
            builder.problems.append(f"{name}: not normalised, and of unknown size")
        else:
            group = Group(name, size, "none")
        groups.append(group)
    return groups


def _step(values: Mapping[str, Any], names: tuple[str, ...]) -> Mapping[str, Any] | None:
    """The step of a pipeline whose registered name begins with one of ``names``."""
    steps = values.get("steps")
    for step in steps if isinstance(steps, list) else []:
        if isinstance(step, Mapping) and str(step.get("registry_name", "")).startswith(names):
            return step
    return None


def _config(step: Mapping[str, Any]) -> Mapping[str, Any]:
    config = step.get("config")
    return config if isinstance(config, Mapping) else {}


def _feature(features: Any, key: str) -> int | None:
    """Width of a feature in ``config.json``."""
    shape = features.get(key, {}).get("shape") if isinstance(features, Mapping) else None
    return size_of(shape[-1]) if isinstance(shape, list) and shape else None


def _statistics(folder: Path, step: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Statistics by key in the file that a step names."""
    name = step.get("state_file")
    if name is None:
        return {}
    if not isinstance(name, str) or not name or Path(name).name != name:
        raise CheckpointError(
            f"{folder}: state_file: expected the name of a file in this folder, got {name!r}"
        )
    found: dict[str, dict[str, Any]] = {}
    for full, values in read_small_tensors(folder / name).items():
        key, _, statistic = full.rpartition(".")
        found.setdefault(key, {})[statistic] = values
    return found
