"""Statistics of lerobot's groot policies: how its processors normalise states and decode actions.

lerobot always uses min-max. Bounds are a constant only if they are equal in float32. Isaac-GR00T's rules for
the same statistics (``isclose``, means, sines) do not apply here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.small_files import read_json
from saccade.robots.building import Builder, Options, bounded_size, size_of, value_at, width_of
from saccade.robots.embodiments import LEROBOT_N15_IDS, N17_IDS
from saccade.robots.groups import Group
from saccade.robots.isaac_processor import (
    Modality,
    action_statistics,
    check_reference,
    checked_ids,
    modality,
    refuse_unknown_fields,
)
from saccade.robots.lerobot_pipeline import (
    DECODE,
    PACK_N15,
    PACK_N17,
    PREPROCESSOR,
    Pipeline,
    action_steps,
    read_pipeline,
)
from saccade.robots.libero import TAG as LIBERO_TAG
from saccade.robots.robot import Robot, finished
from saccade.robots.rotations import POSES

STATE, ACTION = "observation.state", "action"

#: LIBERO's gripper is the last number of an action with at least this many.
LIBERO_WIDTH = 7


def lerobot_robot(folder: Path, preprocessor: Mapping[str, Any], options: Options) -> Robot | None:
    """The robot of a checkpoint's directory; None if ``preprocessor`` has no step of GR00T."""
    pipeline = read_pipeline(folder, preprocessor)
    if pipeline is None:
        return None
    options.refuse_data_config(pipeline.where)
    taking, giving = pipeline.pack.config, pipeline.unpack.config
    tag = str(taking.get("embodiment_tag", "new_embodiment"))
    # 0 for an unknown tag, as in lerobot.
    embodiment_id = _ids(pipeline.where, pipeline.pack.name, taking).get(tag, 0)
    options.check_only(tag, embodiment_id, "n1.7" if pipeline.is_n17 else "n1.5", pipeline.where)
    builder = Builder(pipeline.where, np.float32)
    for step in (pipeline.pack, pipeline.unpack):
        refuse_unknown_fields(builder, f"{step.name}: modality_config", step.config.get("modality_config"))
    native = pipeline.unpack.name == DECODE
    state = _state_groups(builder, pipeline)
    action = _native_groups(builder, pipeline, state) if native else _flat_groups(builder, pipeline)
    width = sum(group.size for group in action)
    # lerobot replaces what N1.5's step says by the width in config.json.
    said = bounded_size("env_action_dim", giving.get("env_action_dim")) if pipeline.is_n17 else None
    cut = min(said or width, pipeline.feature("output_features", ACTION) or width)
    if cut < width:
        action, width = _cut(builder, action, cut), cut
    gripper = _libero(builder, pipeline, action, native)
    offsets = pipeline.offsets(width)
    state_width = sum(group.size for group in state)
    if offsets is not None and state_width < width:
        builder.problems.append(
            f"the state of {state_width} numbers is added to actions of {width}, expected at least as many"
        )
    builder.check()
    rows, trained = pipeline.rows
    return finished(
        pipeline.where,
        options,
        tag,
        embodiment_id,
        state,
        action,
        (size_of(taking.get("max_state_dim")), size_of(taking.get("max_action_dim"))),
        cuts_state=not pipeline.is_n17,
        action_horizon=rows,
        trained_horizon=trained,
        offsets=offsets,
        gripper=gripper,
        pipeline=pipeline,
    )


def pipeline_ids(folder: Path) -> Mapping[str, int] | None:
    """Ids by tag of a directory that lerobot saved; None without a step of its preprocessor that takes them.

    Raises:
        CheckpointError: The file is damaged.
    """
    path = folder / PREPROCESSOR
    steps = read_json(path).get("steps") if path.is_file() else None
    for step in steps if isinstance(steps, list) else ():
        name, config = value_at(step, "registry_name"), value_at(step, "config")
        if name in (PACK_N15, PACK_N17):
            return _ids(str(path), name, config if isinstance(config, Mapping) else {})
    return None


def _ids(where: str, name: str, config: Mapping[str, Any]) -> Mapping[str, int]:
    """Ids by tag of the step of this name: its own, or lerobot's where it has none."""
    given = config.get("embodiment_mapping")
    if given is not None:
        return checked_ids(where, given)
    return N17_IDS if name == PACK_N17 else LEROBOT_N15_IDS


def _state_groups(builder: Builder, pipeline: Pipeline) -> tuple[Group, ...]:
    """The state: one group, or with a raw checkpoint's statistics one for each of its keys."""
    config, found = pipeline.pack.config, pipeline.pack.statistics.get(STATE)
    size = pipeline.feature("input_features", STATE) or _length(found)
    if size is None:
        builder.problems.append("state: of unknown size, since config.json has no observation.state")
        return ()
    parts = _parts(pipeline, size)
    if found is None or (pipeline.is_n17 and not config.get("normalize_min_max", True)):
        return tuple(Group(key, width, "none") for key, width in parts)
    low, high = (_fitted(builder, STATE, found, name, size, fill) for name, fill in (("min", 0), ("max", 1)))
    clips = bool(pipeline.is_n17 and config.get("clip_outliers", True))
    ends = np.cumsum([width for _, width in parts])[:-1]
    rows = zip(parts, np.split(low, ends), np.split(high, ends), strict=True)
    return tuple(builder.scaled(key, "min_max", *bounds, clips=clips) for (key, _), *bounds in rows)


def _parts(pipeline: Pipeline, size: int) -> list[tuple[str, int]]:
    """Keys of the state and their widths, if a raw checkpoint's statistics say so."""
    raw, about = pipeline.pack.config.get("raw_stats"), pipeline.pack.config.get("modality_config")
    keys = about.get("state", {}).get("modality_keys") if isinstance(about, Mapping) else None
    if not isinstance(keys, list):
        return [("state", size)]
    widths = [width_of(value_at(raw, "state", key)) for key in keys]
    known = [width for width in widths if width is not None]
    if len(known) < len(widths) or sum(known) != size:
        return [("state", size)]
    return list(zip(map(str, keys), known, strict=True))


def _flat_groups(builder: Builder, pipeline: Pipeline) -> tuple[Group, ...]:
    """The action as one group."""
    config, statistics = pipeline.unpack.config, pipeline.unpack.statistics
    found = statistics.get(ACTION)
    given = bounded_size("env_action_dim", config.get("env_action_dim")) if pipeline.is_n17 else None
    sizes = [size for size in (pipeline.feature("output_features", ACTION), given) if size is not None]
    size = min(sizes, default=_length(found))
    if size is None:
        builder.problems.append("action: of unknown size, since config.json has no action")
        return ()
    if not statistics or (pipeline.is_n17 and not config.get("normalize_min_max", True)):
        return (Group("action", size, "none"),)
    if found is None:  # statistics of other features only
        low, high = np.zeros(size, np.float32), np.ones(size, np.float32)
    else:
        low, high = (_fitted(builder, ACTION, found, name, size, 0) for name in ("min", "max"))
    clips_back = bool(pipeline.is_n17 and config.get("clip_normalized_action"))
    return (builder.scaled("action", "min_max", low, high, clips=pipeline.is_n17, clips_back=clips_back),)


def _length(statistics: Mapping[str, Any] | None) -> int | None:
    """Length of the longer bound."""
    bounds = [row for name, row in (statistics or {}).items() if name in ("min", "max")]
    return max(map(np.size, bounds), default=None)


def _native_groups(builder: Builder, pipeline: Pipeline, state: tuple[Group, ...]) -> tuple[Group, ...]:
    """The groups of a raw checkpoint's statistics."""
    config = pipeline.unpack.config
    raw, about = config.get("raw_stats"), config.get("modality_config")
    if not isinstance(raw, Mapping) or not isinstance(about, Mapping):
        builder.problems.append(f"{DECODE}: no raw_stats and modality_config")
        return builder.check()
    action = modality(
        builder, _strict(builder, about), "action", relative=bool(config.get("use_relative_action"))
    )
    sizes = {group.key: group.size for group in state}
    uses_quantiles, rows = bool(config.get("use_percentiles")), pipeline.rows[0]
    groups = [_native_group(builder, key, raw, action, uses_quantiles, rows) for key in action.keys]
    for group in groups:
        if group is not None:
            check_reference(builder, group, sizes)
            if group.reference is not None and group.reference.pose == "XYZ_ROTVEC":
                builder.problems.append(f"action.{group.key}: lerobot has no relative poses XYZ_ROTVEC")
    return builder.check(groups)


def _strict(builder: Builder, about: Mapping[str, Any]) -> dict[str, Any]:
    """The modality config, with what lerobot alone takes written as Isaac-GR00T takes it.

    These are actions without an action config, which are absolute; formats by value (``"xyz+rot6d"``); any
    format of numbers that are no pose; and no ``delta_indices``.
    """
    action = about.get("action")
    if not isinstance(action, Mapping):
        return dict(about)
    keys, configs = action.get("modality_keys"), action.get("action_configs", [])
    if not isinstance(configs, list):
        builder.problems.append(
            f"{DECODE}: action_configs: expected a list, got {configs!r:.60}: lerobot then returns the "
            "head's actions, not the robot's units"
        )
        configs = []
    found = []
    absolute = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT"}
    for config in configs:
        if isinstance(config, Mapping):
            config = {**config, **{name: config.get(name) or absolute[name] for name in absolute}}
            form = str(config["format"]).upper().replace("+", "_")
            if form in POSES:
                is_pose = str(config["type"]).upper() == "EEF"
                config = {**config, "format": form if is_pose else "DEFAULT"}
        found.append(config)
    missing = len(keys) - len(found) if isinstance(keys, list) else 0
    found += [absolute] * missing
    return {
        **about,
        "action": {**action, "action_configs": found, "delta_indices": action_steps(about) or [0]},
    }


def _native_group(
    builder: Builder, key: str, raw: Mapping[str, Any], about: Modality, uses_quantiles: bool, rows: int
) -> Group | None:
    reference = about.references.get(key)
    found = action_statistics(raw, key, reference, uses_quantiles)
    group = builder.group(
        key, found, "min_max", by_step=True, clips=True, clips_back=True, reference=reference
    )
    if group is None or group.first is None:
        return group
    width = width_of(value_at(raw, "action", key))
    if group.size != width:
        builder.problems.append(f"action.{key}: {width} numbers, but statistics of {group.size}")
    if group.first.ndim == 2 and len(group.first) < rows:
        builder.problems.append(
            f"action.{key}: expected statistics of at least {rows} steps, got {len(group.first)}"
        )
    return group


def _cut(builder: Builder, groups: tuple[Group, ...], width: int) -> tuple[Group, ...]:
    """The groups of the first ``width`` numbers of an action."""
    found, left = [], width
    for group in groups:
        size = min(group.size, left)
        left -= size
        if size == group.size:
            found.append(group)
        elif size > 0 and group.reference is not None and group.reference.pose is not None:
            builder.problems.append(
                f"action.{group.key}: cut to {size} of {group.size} numbers (env_action_dim)"
            )
        elif size > 0:
            found.append(replace(group.indexed((..., slice(size))), size=size))
    return tuple(found)


def _libero(builder: Builder, pipeline: Pipeline, action: tuple[Group, ...], native: bool) -> int | None:
    """The number that LIBERO's rule applies to. ``config.json`` decides, whatever the steps say."""
    if not pipeline.is_n17:
        return None
    config = pipeline.config
    wanted = config.get("action_decode_transform", "auto")
    if wanted == "auto":
        wanted = "libero" if config.get("embodiment_tag", "new_embodiment") == LIBERO_TAG else None
    if wanted in (None, "", "none"):
        return None
    if wanted != "libero":
        builder.problems.append(
            f"config.json: action_decode_transform: expected auto, none or libero, got {wanted!r:.60}"
        )
        return None
    width = sum(group.size for group in action)
    if not native:
        return width - 1 if width >= LIBERO_WIDTH else None
    for place, group in enumerate(action):
        if group.key == "gripper" and group.size == 1:
            return sum(one.size for one in action[:place])
    builder.problems.append("libero: expected a group gripper of one number among the actions")
    return None


def _fitted(
    builder: Builder, key: str, statistics: Mapping[str, Any], name: str, size: int, fill: float
) -> npt.NDArray[np.float32]:
    """A bound as a row of ``size`` float32, cut or filled up as lerobot does."""
    given = statistics.get(name)
    default = 0.0 if name == "min" else 1.0
    row = np.full(size, default, np.float32) if given is None else np.ravel(np.asarray(given, np.float32))
    fitted = np.full(size, fill, np.float32)
    fitted[: min(size, len(row))] = row[:size]
    if not np.isfinite(fitted).all():
        builder.problems.append(f"{key}: expected {name} to be a row of finite numbers")
        return np.full(size, default, np.float32)
    return fitted
