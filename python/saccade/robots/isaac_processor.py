"""Statistics of Isaac-GR00T N1.6 and N1.7: ``processor_config.json`` and ``statistics.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from saccade.errors import CheckpointError
from saccade.robots.building import Builder, Options, is_list_of, value_at, width_of
from saccade.robots.embodiments import IDS, choose
from saccade.robots.groups import Group, Reference
from saccade.robots.lerobot_pipeline import KNOWN, action_steps
from saccade.robots.robot import Robot, finished
from saccade.robots.rotations import POSES

#: Versions by the class of the processor.
CLASSES = {"Gr00tN1d6Processor": "n1.6", "Gr00tN1d7Processor": "n1.7"}

#: Arguments of the processors, then those that only N1.7 has. ``saccade.Processor`` reads those of images and
#: text. ``use_mean_std`` is never read, and ``state_dropout_prob`` by training only.
OPTIONS: list[str] = KNOWN["isaac"]["processor"]
N17_OPTIONS: list[str] = KNOWN["isaac"]["processor_n1.7"]

#: Options that are on or off, with the released defaults.
SWITCHES: Mapping[str, bool] = KNOWN["isaac"]["switches"]

#: Fields of a modality config, and of one of its action configs with the values that are known.
MODALITY: list[str] = KNOWN["isaac"]["modality"]
ACTION = {
    "rep": ("RELATIVE", "DELTA", "ABSOLUTE"),
    "type": ("EEF", "NON_EEF"),
    "format": ("DEFAULT", *POSES),
}
#: ``rl_info`` may be among them; the released policy drops it.
MODALITIES = ("video", "state", "action", "language", "rl_info")

#: The released defaults of widths and of the longest chunk.
DEFAULT_DIM = 29
DEFAULT_HORIZON = {"n1.6": 40, "n1.7": 50}


@dataclass(frozen=True)
class Modality:
    """What a processor says of the state or of the action of one robot."""

    keys: tuple[str, ...]
    steps: int  # states of an observation, or actions of a chunk
    sin_cos: tuple[str, ...]
    mean_std: tuple[str, ...]
    references: Mapping[str, Reference]  # for actions, what a key is relative to


def processor_robot(
    where: str,
    version: str | None,
    kwargs: Mapping[str, Any],
    statistics: Mapping[str, Any],
    ids: Mapping[str, int],
    options: Options,
) -> Robot:
    """The robot of ``processor_kwargs``, ``statistics.json`` and the checked ids of ``embodiment_id.json``.

    The released table of the version, if that is known, adds ids of tags that the file lacks.
    """
    options.refuse_data_config(where)
    configs = kwargs.get("modality_configs")
    if not isinstance(configs, Mapping) or not configs:
        raise CheckpointError(f"{where}: no modality_configs")
    known = {**IDS.get(version or "", {}), **ids}
    tags = [tag for tag in configs if tag in statistics]
    if not tags:
        raise CheckpointError(
            f"{where}: statistics of {', '.join(statistics) or 'nothing'}, groups of {', '.join(configs)}"
        )
    needs = {tag: _needs(configs[tag]) for tag in tags}
    tag = choose(options.embodiment, tags, known, version, where, needs)
    builder = Builder(f"{where}: {tag}", np.float64, is_close=True)
    if kwargs.get("use_tactile"):
        builder.problems.append("use_tactile: tactile states are not supported")
    builder.refuse_unknown(
        "processor_kwargs", kwargs, OPTIONS if version == "n1.6" else (*OPTIONS, *N17_OPTIONS, "use_tactile")
    )
    switches = {name: _switch(builder, kwargs, name, default) for name, default in SWITCHES.items()}
    config, numbers = configs[tag], statistics[tag]
    for one, about in configs.items():  # the release refuses the file, whichever robot is used
        refuse_unknown_fields(
            builder, "modality_configs" if one == tag else f"modality_configs: {one}", about
        )
    state = modality(builder, config, "state", relative=False)
    action = modality(builder, config, "action", relative=switches["use_relative_action"])
    if version != "n1.6":
        _check_horizons(builder, kwargs, configs, version)
    builder.check()
    groups = [_state_group(builder, key, numbers, state, switches) for key in state.keys]
    sizes = {one.key: one.size for one in groups if one is not None}
    actions = [_action_group(builder, key, numbers, action, switches, sizes) for key in action.keys]
    builder.check()
    dims = {name: kwargs.get(name, DEFAULT_DIM) for name in ("max_state_dim", "max_action_dim")}
    for name, dim in dims.items():
        if type(dim) is not int or dim < 1:
            raise CheckpointError(f"{where}: {name}: expected a positive integer, got {dim!r:.60}")
    return finished(
        where,
        options,
        tag,
        known.get(tag),
        builder.check(groups),
        builder.check(actions),
        (dims["max_state_dim"], dims["max_action_dim"]),
        cuts_state=False,
        action_horizon=action.steps,
        state_history=state.steps,
        zero_state=switches["exclude_state"],
    )


def checked_ids(where: str, ids: Any) -> dict[str, int]:
    """Embodiment ids of a file by tag."""
    found = ids if isinstance(ids, Mapping) else {"the ids": ids}
    wrong = [
        f"{tag} ({number!r:.40})" for tag, number in found.items() if type(number) is not int or number < 0
    ]
    if wrong:
        raise CheckpointError(
            f"{where}: embodiment ids: expected integers of at least 0, got {', '.join(wrong)}"
        )
    return dict(found)


def _needs(config: Any) -> str:
    """Keys of a robot, for a message."""
    found = {kind: value_at(config, kind, "modality_keys") for kind in ("video", "state", "action")}
    return "; ".join(
        f"{kind} {', '.join(map(str, keys))}" for kind, keys in found.items() if isinstance(keys, list)
    )


def _switch(builder: Builder, kwargs: Mapping[str, Any], name: str, default: bool) -> bool:
    value = kwargs.get(name, default)
    if value is not None and not isinstance(value, bool):
        builder.problems.append(f"{name}: expected true or false, got {value!r:.60}")
    return bool(value)


def refuse_unknown_fields(builder: Builder, where: str, about: Any) -> None:
    """Records what is not known in the modality configs of a robot: modalities, and fields of each."""
    builder.refuse_unknown(where, about, MODALITIES)
    for kind in MODALITIES[:-1]:
        builder.refuse_unknown(f"{where}: {kind}", value_at(about, kind), MODALITY)
        keys, actions = (value_at(about, kind, name) for name in ("modality_keys", "action_configs"))
        if isinstance(keys, list) and isinstance(actions, list):
            for key, one in zip(keys, actions, strict=False):
                builder.refuse_unknown(f"{where}: {kind}.{key}", one, (*ACTION, "state_key"))


def modality(builder: Builder, config: Any, kind: str, relative: bool) -> Modality:
    """What ``modality_configs`` contain of the state or the action; problems are recorded.

    ``relative`` is whether ``RELATIVE`` actions are converted at all.
    """
    found = value_at(config, kind)
    keys = value_at(found, "modality_keys")
    if not is_list_of(str, keys) or not keys:
        raise CheckpointError(f"{builder.where}: {kind}: no modality_keys")
    if len(set(keys)) != len(keys):
        builder.problems.append(f"{kind}: expected distinct modality_keys, got {', '.join(keys)}")
    steps = found.get("delta_indices")
    if not is_list_of(int, steps) or not steps:
        builder.problems.append(f"{kind}: expected delta_indices, a list of integers, got {steps!r:.60}")
        steps = [0]
    chosen = []
    for name in ("sin_cos_embedding_keys", "mean_std_embedding_keys"):
        names = found.get(name) or []
        if not is_list_of(str, names):
            builder.problems.append(f"{kind}: {name}: expected a list of keys, got {names!r:.60}")
            names = []
        chosen.append(tuple(names))
    references = _references(builder, kind, keys, found.get("action_configs"), relative)
    return Modality(tuple(keys), len(steps), chosen[0], chosen[1], references)


def _references(
    builder: Builder, kind: str, keys: list[str], configs: Any, relative: bool
) -> dict[str, Reference]:
    """What each relative key is relative to. Type and format matter for keys that are converted only."""
    if configs is None:
        return {}
    if not isinstance(configs, list) or len(configs) != len(keys):
        builder.problems.append(f"{kind}: expected one of action_configs for each of modality_keys")
        return {}
    found = {}
    for key, config in zip(keys, configs, strict=True):
        where = f"{kind}.{key}"
        if not isinstance(config, Mapping):
            builder.problems.append(f"{where}: expected an action config, got {config!r:.60}")
            continue
        given = {name: config.get(name) for name in ACTION}
        names = {name: value.upper() if isinstance(value, str) else value for name, value in given.items()}
        wrong = [
            f"{where}: {name}: expected one of {', '.join(allowed)}, got {given[name]!r:.60}"
            for name, allowed in ACTION.items()
            if names[name] not in allowed
        ]
        builder.problems += wrong
        if wrong or names["rep"] != "RELATIVE" or not relative:
            continue
        state_key = config.get("state_key") or key
        is_pose = names["type"] == "EEF"
        form = names["format"]
        if is_pose and form == "DEFAULT":
            builder.problems.append(
                f"{where}: format DEFAULT of a relative EEF is a 4 x 4 matrix, which the released policy "
                "does not return either"
            )
        elif not is_pose and form in POSES:
            builder.problems.append(f"{where}: format {form} is for type EEF, got {names['type']}")
        elif not isinstance(state_key, str):
            builder.problems.append(f"{where}: state_key: expected text, got {state_key!r:.60}")
        else:
            found[key] = Reference(state_key, form if is_pose else None)
    return found


def check_reference(builder: Builder, group: Group, sizes: Mapping[str, int]) -> None:
    """Records what is wrong with what a group of the action is relative to, if to anything."""
    if group.reference is None:
        return
    pose, key = group.reference.pose, group.reference.key
    if pose is not None and group.size != POSES[pose][0]:
        builder.problems.append(
            f"action.{group.key}: expected {POSES[pose][0]} numbers of a pose {pose}, got {group.size}"
        )
    elif sizes.get(key) != group.size:
        builder.problems.append(
            f"action.{group.key}: {group.size} numbers relative to state.{key}, which has "
            f"{sizes.get(key, 'no')}"
        )


def _state_group(
    builder: Builder, key: str, numbers: Any, about: Modality, switches: Mapping[str, bool]
) -> Group | None:
    statistics = value_at(numbers, "state", key)
    encoded = switches["apply_sincos_state_encoding"] and key in about.sin_cos
    if encoded or switches["exclude_state"]:  # only the width is read
        size = width_of(statistics)
        if size is None:
            builder.problems.append(f"{key}: no statistics, of which the width is read")
            return None
        return Group(key, size, "sin_cos" if encoded else "none")
    if key in about.mean_std:
        return builder.group(key, statistics, "mean_std", returns_constant=True)
    return builder.group(
        key,
        _bounds(statistics, switches["use_percentiles"]),
        "min_max",
        clips=switches["clip_outliers"],
        clips_back=True,
    )


def _action_group(
    builder: Builder,
    key: str,
    numbers: Any,
    about: Modality,
    switches: Mapping[str, bool],
    sizes: Mapping[str, int],
) -> Group | None:
    """A group of the action, absolute or relative to a group of the state."""
    # The released code reads the width of a relative key from these as well.
    width = width_of(value_at(numbers, "action", key))
    if width is None:
        builder.problems.append(f"{key}: no statistics of the absolute action")
        return None
    reference, by_mean = about.references.get(key), key in about.mean_std
    group = builder.group(
        key,
        action_statistics(numbers, key, reference, switches["use_percentiles"] and not by_mean),
        "mean_std" if by_mean else "min_max",
        by_step=True,
        clips=switches["clip_outliers"],  # actions for training are clipped in every mode
        clips_back=not by_mean,
        returns_constant=by_mean,
        reference=reference,
    )
    if group is None:
        return None
    if group.size != width:
        builder.problems.append(f"action.{key}: {width} numbers, but relative statistics of {group.size}")
    assert group.first is not None
    if group.first.ndim == 2 and len(group.first) != about.steps:
        builder.problems.append(
            f"action.{key}: expected statistics of {about.steps} steps, as delta_indices has, got "
            f"{len(group.first)}"
        )
    check_reference(builder, group, sizes)
    return group


def _bounds(statistics: Any, uses_quantiles: bool) -> Any:
    """Statistics whose bounds are called ``min`` and ``max``."""
    if not uses_quantiles or not isinstance(statistics, Mapping):
        return statistics
    return {"min": statistics.get("q01"), "max": statistics.get("q99")}


def action_statistics(numbers: Any, key: str, reference: Reference | None, uses_quantiles: bool) -> Any:
    """Statistics of a key of the action, absolute or relative. Relative actions never use quantiles."""
    if reference is not None:
        return value_at(numbers, "relative_action", key)
    return _bounds(value_at(numbers, "action", key), uses_quantiles)


def _check_horizons(
    builder: Builder, kwargs: Mapping[str, Any], configs: Mapping[str, Any], version: str | None
) -> None:
    """N1.7 refuses a processor in which any robot has a longer chunk than ``max_action_horizon``."""
    most = kwargs.get("max_action_horizon", DEFAULT_HORIZON.get(version or ""))
    if most is None:
        return
    if type(most) is not int:
        builder.problems.append(f"max_action_horizon: expected an integer, got {most!r:.60}")
        return
    for tag, config in configs.items():
        steps = action_steps(config)
        if len(steps) > most:
            builder.problems.append(
                f"{tag} has chunks of {len(steps)} actions, expected at most {most} (max_action_horizon)"
            )
