"""Reads the saved processors of lerobot's groot policies, step by step.

A known step is applied, or left out where it says that it is off. Any other step is refused by its name,
since it could change the robot's actions.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from saccade._internal.small_files import read_json, read_small_tensors
from saccade.errors import CheckpointError
from saccade.robots.building import Builder
from saccade.robots.lerobot_steps import (
    ABSOLUTE,
    AFTER,
    BEFORE,
    CONFIG,
    CONFIG_OF_PARTS,
    DECODE,
    DELTA,
    DEVICE,
    PACK_N15,
    PACK_N17,
    POSTPROCESSOR,
    PREPROCESSOR,
    RELATIVE,
    RENAME,
    UNPACK_N15,
    UNPACK_N17,
    Pipeline,
    Statistics,
    Step,
)


def read_pipeline(folder: Path, preprocessor: Mapping[str, Any]) -> Pipeline | None:
    """Reads both pipelines and ``config.json``; None if ``preprocessor`` is not of a groot policy.

    Raises:
        FileNotFoundError: A file that a step names is missing.
        CheckpointError: A step or an option is not known, or a file is damaged. The message lists every
            problem.
    """
    where = str(folder / PREPROCESSOR)
    before = preprocessor.get("steps")
    names = [step.get("registry_name") for step in before or () if isinstance(step, Mapping)]
    if not any(isinstance(name, str) and name.startswith("groot_") for name in names):
        return None
    after = folder / POSTPROCESSOR
    if not after.is_file():
        raise CheckpointError(f"{after}: missing: it turns actions into the robot's units")
    builder = Builder(where, np.float32)
    steps = _known(builder, folder, preprocessor, BEFORE)
    builder.check()
    ends = Builder(str(after), np.float32)
    steps_after = _known(ends, folder, read_json(after), AFTER)
    packs = [step for step in steps if step.name in (PACK_N15, PACK_N17)]
    unpacks = [step for step in steps_after if step.name in (UNPACK_N15, UNPACK_N17, DECODE)]
    if len(packs) != 1:
        builder.problems.append(f"expected one of {PACK_N15} and {PACK_N17}, got {len(packs)}")
    if len(unpacks) != 1:
        ends.problems.append(f"expected one of {UNPACK_N15}, {UNPACK_N17} and {DECODE}, got {len(unpacks)}")
    builder.check()
    ends.check()
    pack, unpack = packs[0], unpacks[0]
    if (pack.name == PACK_N15) != (unpack.name == UNPACK_N15):
        ends.problems.append(f"{unpack.name} does not belong to {pack.name}")
    _check_order(builder, ends, steps, steps_after, pack, unpack)
    rename = [step.config.get("rename_map") or {} for step in steps if step.name == RENAME]
    relative, other = (DELTA, RELATIVE) if pack.name == PACK_N15 else (RELATIVE, DELTA)
    if any(step.name == other and step.config.get("enabled") for step in steps):
        builder.problems.append(f"expected {relative}, as the releases with {pack.name} have it, got {other}")
    offsets = _offsets(ends, steps, steps_after, relative)
    builder.check()
    ends.check()
    if not (folder / "config.json").is_file():
        raise CheckpointError(f"{folder / 'config.json'}: missing: it decides how lerobot's steps act")
    config = read_json(folder / "config.json")
    policy = Builder(str(folder / "config.json"), np.float32)
    policy.refuse_unknown("the policy", config, CONFIG | CONFIG_OF_PARTS)
    policy.check()
    merged = {old: new for one in rename for old, new in one.items()}
    return Pipeline(where, config, pack, unpack, merged, offsets)


def _check_order(
    builder: Builder,
    ends: Builder,
    steps: list[Step],
    steps_after: list[Step],
    pack: Step,
    unpack: Step,
) -> None:
    """Records steps that act at another place than where lerobot's own pipelines have them."""
    renames = [step for step in steps if step.name == RENAME]
    if len(renames) > 1 or any(steps.index(step) > steps.index(pack) for step in renames):
        builder.problems.append(f"expected one {RENAME}, before {pack.name}")
    for step in renames:
        given = step.config.get("rename_map") or {}
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given.values()):
            builder.problems.append(f"{RENAME}: rename_map: expected names, got {given!r:.100}")
    if any(
        steps_after.index(step) < steps_after.index(unpack) for step in steps_after if step.name == ABSOLUTE
    ):
        ends.problems.append(f"expected {ABSOLUTE} after {unpack.name}")
    config = pack.config
    if config.get("language_key", "task") != "task":
        builder.problems.append(
            f"{pack.name}: language_key: expected task, got {config['language_key']!r:.60}"
        )
    if config.get("state_horizon", 1) != 1:
        builder.problems.append(
            f"{pack.name}: state_horizon: expected 1, got {config['state_horizon']!r:.60}"
        )
    for one, where in ((steps, builder), (steps_after, ends)):
        for step in one:
            dtype = step.config.get("float_dtype") if step.name == DEVICE else None
            if dtype not in (None, "float32"):
                where.problems.append(f"{DEVICE}: float_dtype: expected null, got {dtype!r:.60}")


def _offsets(
    ends: Builder, steps: list[Step], steps_after: list[Step], relative: str
) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Names for ``Pipeline.offset_names``."""
    enabled = [step for step in steps_after if step.name == ABSOLUTE and step.config.get("enabled")]
    if not enabled:
        return None
    if len(enabled) > 1:
        ends.problems.append(f"expected one {ABSOLUTE} that is enabled, got {len(enabled)}")
    sources = [step for step in steps if step.name == relative]
    if not sources:
        ends.problems.append(f"{ABSOLUTE} is enabled, but the preprocessor has no {relative}")
        return None
    lists = [sources[0].config.get(name) or [] for name in ("action_names", "exclude_joints")]
    for found in lists:
        if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
            ends.problems.append(f"{relative}: expected lists of names, got {found!r:.100}")
            return None
    return tuple(lists[0]), tuple(lists[1])


def _known(
    builder: Builder, folder: Path, values: Mapping[str, Any], known: Mapping[str, Collection[str]]
) -> list[Step]:
    """The steps of a pipeline, all of which are known; problems are recorded."""
    builder.refuse_unknown("the pipeline", values, ("name", "steps"))
    listed = values.get("steps")
    found = []
    for given in listed if isinstance(listed, list) else []:
        if not isinstance(given, Mapping):
            builder.problems.append(f"expected a step, got {given!r:.60}")
            continue
        name, config = given.get("registry_name"), given.get("config") or {}
        if not isinstance(name, str) or name not in known:
            shown = name if name is not None else given.get("class")
            off = isinstance(config, Mapping) and config.get("enabled") is False
            if not (off and isinstance(name, str)):
                builder.problems.append(
                    f"the step {shown!r:.100} is not known, and may change what the policy computes"
                )
            continue
        if not isinstance(config, Mapping):
            builder.problems.append(f"{name}: expected options, got {config!r:.60}")
            continue
        builder.refuse_unknown("the step", given, ("registry_name", "config", "state_file"))
        builder.refuse_unknown(name, config, known[name])
        found.append(Step(name, config, _statistics(folder, given.get("state_file"))))
    return found


def _statistics(folder: Path, name: Any) -> Statistics:
    """Statistics by feature in the file that a step names."""
    if name is None:
        return {}
    if not isinstance(name, str) or not name or Path(name).name != name:
        raise CheckpointError(
            f"{folder}: state_file: expected the name of a file in this folder, got {name!r}"
        )
    found: Statistics = {}
    for full, values in read_small_tensors(folder / name).items():
        key, _, statistic = full.rpartition(".")
        found.setdefault(key, {})[statistic] = values
    return found
