"""Statistics of Isaac-GR00T N1 and N1.5: ``experiment_cfg/metadata.json``, read by a data config.

The rules are those of the released transforms: a rotation is converted first and then normalised, bounds of a
converted rotation are fixed, and keys that the data config does not use are not looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from saccade._internal.warning import warn
from saccade.errors import CheckpointError, InputError
from saccade.robots.building import Builder, Options, value_at
from saccade.robots.data_configs import RELEASED, DataConfig
from saccade.robots.embodiments import N15_IDS, choose
from saccade.robots.groups import Conversion, Group
from saccade.robots.robot import Dims, Robot, finished
from saccade.robots.rotations import BOUNDS, SIZES

#: Robots whose published files have keys that no data config uses together.
NEEDS_DATA_CONFIG = ("gr1",)

#: What an entry of a robot contains, and the entry of a key.
ENTRY = ("statistics", "modalities", "embodiment_tag")
KEY_ENTRY = ("absolute", "rotation_type", "shape", "continuous")


@dataclass(frozen=True)
class Entry:
    """One robot of ``metadata.json``: statistics and modalities by ``"state"`` or ``"action"``, and key."""

    where: str
    tag: str
    statistics: Mapping[str, Mapping[str, Any]]
    modalities: Mapping[str, Mapping[str, Any]]

    def keys(self, kind: str) -> list[str]:
        """The keys of the state or the action, in the order of the file."""
        return list(self.modalities.get(kind) or {})


def metadata_robot(values: Mapping[str, Any], options: Options, where: str, dims: Dims) -> Robot:
    """The robot of a mapping of tags to ``statistics`` and ``modalities``."""
    needs = {tag: _needs(entry) for tag, entry in values.items()}
    tag = choose(options.embodiment, list(values), N15_IDS, "n1.5", where, needs)
    entry = _entry(values, tag, where)
    given = options.data_config
    state, action = _groups(entry, given or _whole_file(entry))
    embodiment_id = N15_IDS.get(str(values[tag].get("embodiment_tag", tag)))
    if given is None:
        return finished(where, options, tag, embodiment_id, state, action, dims, hint=_fitting_hint(entry))
    return finished(
        where,
        options,
        tag,
        embodiment_id,
        state,
        action,
        dims,
        action_horizon=len(given.action_indices),
        denoised_horizon=len(given.action_indices),
        state_history=len(given.observation_indices),
        data_config=given,
    )


def _needs(entry: Any) -> str:
    """Keys that the file has of a robot, for a message."""
    found = [(kind, value_at(entry, "modalities", kind)) for kind in ("video", "state", "action")]
    return "; ".join(f"{kind} {', '.join(keys)}" for kind, keys in found if isinstance(keys, Mapping))


def _groups(entry: Entry, config: DataConfig) -> tuple[tuple[Group, ...], tuple[Group, ...]]:
    """The groups of state and action that a data config makes of a robot."""
    builder = Builder(entry.where, np.float32)
    states, actions = (
        [_group(builder, entry, kind, key, config) for key in config.keys(kind)]
        for kind in ("state", "action")
    )
    cameras = entry.modalities.get("video") or {}
    lacking = [key for key in config.keys("video") if key not in cameras]
    if lacking:
        builder.problems.append(f"video: no {', '.join(lacking)}; there are {', '.join(cameras) or 'none'}")
    return builder.check(states), builder.check(actions)


def _fitting_hint(entry: Entry) -> str:
    """For messages: the released data configs whose keys the file has."""
    names = []
    for name, config in RELEASED.items():
        with suppress(CheckpointError):
            _groups(entry, config)
            names.append(name)
    if not names:
        return (
            "; no released data config fits this file: pass data_config= with the JSON of the one it was "
            "trained with"
        )
    return f"; pass data_config= with the one it was trained with. These fit the file: {', '.join(names)}"


def _entry(values: Mapping[str, Any], tag: str, where: str) -> Entry:
    entry = values[tag]
    builder = Builder(f"{where}: {tag}", np.float32)
    for kind in ("state", "action"):
        for part in ("statistics", "modalities"):
            if not isinstance(entry[part].get(kind), Mapping):
                builder.problems.append(f"no {part} of the {kind}")
    builder.refuse_unknown("the robot", entry, ENTRY)
    builder.check()
    return Entry(builder.where, tag, entry["statistics"], entry["modalities"])


def _whole_file(entry: Entry) -> DataConfig:
    """All keys in the order of the file, for a checkpoint without a data config, where that may do."""
    reasons = [f"{entry.tag!r} has more keys than a policy uses"] if entry.tag in NEEDS_DATA_CONFIG else []
    keys = {kind: entry.keys(kind) for kind in ("video", "state", "action")}
    about = {
        f"{kind}.{key}": entry.modalities[kind][key] for kind in ("state", "action") for key in keys[kind]
    }
    turned = [name for name, one in about.items() if value_at(one, "rotation_type") is not None]
    if turned:
        are = "is a rotation" if len(turned) == 1 else "are rotations"
        reasons.append(f"{', '.join(turned)} {are}, which a data config may convert")
    if reasons:
        raise InputError(
            f"data_config: expected one for {entry.where}, got None: {'; '.join(reasons)}"
            f"{_fitting_hint(entry)}"
        )
    warn(
        f"{entry.where}: no data config is given, so all keys are used, in the order of the file, with their "
        "minimum and maximum (discrete ones: binary). A checkpoint of GR00T N1 or N1.5 does not say which "
        "data config it was trained with: pass data_config= to be certain"
    )
    video, state, action = (tuple(f"{kind}.{key}" for key in found) for kind, found in keys.items())
    modes = {name: "min_max" if one.get("continuous", True) else "binary" for name, one in about.items()}
    return DataConfig(video, state, action, (), (0,), (0,), modes, modes, {})


def _group(builder: Builder, entry: Entry, kind: str, key: str, config: DataConfig) -> Group | None:
    """The group of one key; None if there is a problem, which is recorded."""
    full = f"{kind}.{key}"
    about = entry.modalities[kind].get(key)
    if not isinstance(about, Mapping):
        builder.problems.append(f"{full}: not in the file, which has {', '.join(entry.keys(kind)) or 'none'}")
        return None
    builder.refuse_unknown(full, about, KEY_ENTRY)
    shape = about.get("shape")
    if not isinstance(shape, list) or len(shape) != 1 or type(shape[0]) is not int or shape[0] < 1:
        builder.problems.append(f"{full}: expected a shape of one positive number, got {shape!r:.60}")
        return None
    size: int = shape[0]
    mode = (config.state_modes if kind == "state" else config.action_modes).get(full, "none")
    conversion = None
    if full in config.target_rotations:
        conversion, problem = _conversion(about, config.target_rotations[full], mode, size, kind)
        if problem is not None:
            builder.problems.append(f"{full}: {problem}")
            return None
    if not about.get("continuous", True) and mode not in ("binary", "none") and conversion is None:
        builder.problems.append(f"{full}: discrete, so expected mode binary or none, got {mode}")
        return None
    if mode in ("binary", "sin_cos", "none"):
        return Group(key, size, mode, conversion=conversion)
    if conversion is not None:
        if not isinstance(entry.statistics[kind].get(key), Mapping):
            builder.problems.append(f"{full}: no statistics")  # which the released code looks for, unread
            return None
        bound = np.full(SIZES[conversion.head], BOUNDS[conversion.head], np.float32)
        return builder.scaled(key, mode, -bound, bound, size=size, conversion=conversion)
    # N1.5 clips values that it scales by quantiles.
    group = builder.group(key, entry.statistics[kind].get(key), mode, clips=mode == "q99")
    if group is not None and group.size != size:
        builder.problems.append(f"{full}: {size} numbers, but statistics of {group.size}")
    return group


def _conversion(
    about: Mapping[str, Any], target: str, mode: str, size: int, kind: str
) -> tuple[Conversion | None, str | None]:
    """How a rotation is converted, None if it need not be; and what is wrong, or None."""
    source = about.get("rotation_type")
    if source is None:
        return None, f"to be converted to {target}, but the file does not say which rotation it is"
    if not isinstance(source, str) or source not in SIZES:
        return None, f"expected a rotation_type among {', '.join(SIZES)}, got {source!r:.60}"
    if size != SIZES[source]:
        return None, f"expected {SIZES[source]} numbers for {source}, got {size}"
    if source == target:
        return None, None
    if source.startswith("euler") and target.startswith("euler"):
        return None, f"{source} cannot be converted to another order of Euler angles, {target}"
    if mode != "none" and (mode != "min_max" or not about.get("absolute", True)):
        return None, (
            f"a rotation that is converted takes min_max if it is absolute, or no mode; got {mode} and "
            f"absolute {about.get('absolute', True)}"
        )
    # A state may also become six numbers or twice as many; an action has as many as the robot.
    allowed = (size,) if kind == "action" else (size, 2 * size, 6)
    if SIZES[target] not in allowed:
        return None, f"{source} of {size} numbers cannot become {target} of {SIZES[target]}"
    return Conversion(source, target), None
