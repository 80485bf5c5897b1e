"""The saved processors of lerobot's groot policies, step by step.

A known step is applied, or left out where it says that it is off. Any other step is refused by its name,
since it could change the robot's actions.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.small_files import read_json, read_small_tensors
from saccade.errors import CheckpointError
from saccade.robots.building import Builder, bounded_size, size_of, value_at

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"

PACK_N15, PACK_N17 = "groot_pack_inputs_v3", "groot_n1_7_pack_inputs_v1"
UNPACK_N15, UNPACK_N17 = "groot_action_unpack_unnormalize_v1", "groot_action_unpack_unnormalize_v2"
DECODE = "groot_n1_7_action_decode_v1"
RENAME, DEVICE, BATCH = "rename_observations_processor", "device_processor", "to_batch_processor"
RELATIVE, ABSOLUTE = "relative_actions_processor", "absolute_actions_processor"
#: The name of RELATIVE in lerobot 0.5, the last with N1.5. Neither release can load the other's.
DELTA = "delta_actions_processor"

#: What is known: steps of lerobot's processors with their options, keys of its config, and the options of
#: Isaac-GR00T's processors.
KNOWN = json.loads(Path(__file__).with_name("known_options.json").read_text(encoding="utf-8"))

#: Options of images and text are read by ``saccade.Processor``. ``config`` are the keys of ``config.json`` of
#: all releases, of which lerobot refuses others; ``config_of_parts`` those that saccade reads besides: sizes
#: of a part of the model, and several action decoders, of forks.
LEROBOT: Mapping[str, Any] = KNOWN["lerobot"]

#: lerobot replaces these of N1.5 by N1.7's when it loads a policy.
MIGRATED = {"chunk_size": (50, 40), "n_action_steps": (50, 40)}
#: Rows of a chunk of the published models.
N15_HORIZON, N17_HORIZON = 16, 40

#: Statistics by feature and name.
Statistics = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Step:
    """A step of a pipeline: its registered name, its options, and what its state file contains."""

    name: str
    config: Mapping[str, Any]
    statistics: Statistics


@dataclass(frozen=True)
class Pipeline:
    """A policy that lerobot saved."""

    where: str  # the preprocessor's file, for messages
    config: Mapping[str, Any]  # the contents of ``config.json``
    pack: Step  # normalises the state
    unpack: Step  # turns actions into the robot's units
    rename_map: Mapping[str, str]
    #: Where the state is added to the action: names of the action's numbers, and names that are left out.
    offset_names: tuple[tuple[str, ...], tuple[str, ...]] | None

    @property
    def is_n17(self) -> bool:
        """Whether the policy is of N1.7; otherwise it is of N1.5."""
        return self.pack.name == PACK_N17

    def feature(self, kind: str, name: str) -> int | None:
        """Width of one of ``input_features`` or ``output_features``, or None."""
        shape = value_at(self.config, kind, name, "shape")
        return bounded_size(f"{kind}: {name}", shape[-1]) if isinstance(shape, list) and shape else None

    def offsets(self, width: int) -> npt.NDArray[np.bool_] | None:
        """True for each number of an action of this width that the state is added to; None if it is to none.

        lerobot leaves out a number if both lists are given and its name contains a name of the second.
        """
        if self.offset_names is None:
            return None
        names, excluded = self.offset_names
        tokens = [token.lower() for token in excluded if token]
        left_out = [any(token in name.lower() for token in tokens) for name in names[:width]]
        return np.array([not out for out in left_out] + [True] * (width - len(left_out)))

    @property
    def rows(self) -> tuple[int, int]:
        """Number of actions that lerobot returns, and how many of them were trained."""
        if not self.is_n17:
            return N15_HORIZON, min(size_of(self.config.get("chunk_size")) or 50, N15_HORIZON)
        limits = [self._migrated(name) for name in MIGRATED]
        returned = min(N17_HORIZON, self._local_rows() or N17_HORIZON, *limits)
        decoded = len(action_steps(self.unpack.config.get("modality_config"))) or returned
        returned = max(1, min(returned, decoded if self.unpack.name == DECODE else returned))
        trained = [
            size_of(self.pack.config.get(name)) or N17_HORIZON
            for name in ("valid_action_horizon", "action_horizon")
        ]
        return returned, min(returned, self._migrated("chunk_size"), *trained)

    def _migrated(self, name: str) -> int:
        old, new = MIGRATED[name]
        value = self.config.get(name, new)
        return new if value == old else size_of(value) or new

    def _local_rows(self) -> int | None:
        """Actions of the checkpoint that the policy was made from, if that is still where it was."""
        base = self.config.get("base_model_path")
        path = Path(base) / "processor_config.json" if isinstance(base, str) and base else None
        try:
            values = read_json(path) if path is not None and path.is_file() else {}
            tag = self.pack.config.get("embodiment_tag")
            return len(action_steps(value_at(values, "processor_kwargs", "modality_configs", tag))) or None
        except (CheckpointError, TypeError, OSError, ValueError):
            return None


def read_pipeline(folder: Path, preprocessor: Mapping[str, Any]) -> Pipeline | None:
    """Reads both pipelines and ``config.json``; None if ``preprocessor`` is not of a groot policy."""
    where, before = str(folder / PREPROCESSOR), preprocessor.get("steps")
    names = [value_at(step, "registry_name") for step in before or ()]
    if not any(isinstance(name, str) and name.startswith("groot_") for name in names):
        return None
    after = folder / POSTPROCESSOR
    if not after.is_file():
        raise CheckpointError(f"{after}: missing: it turns actions into the robot's units")
    builder = Builder(where, np.float32)
    steps = _known(builder, folder, preprocessor, LEROBOT["preprocessor"])
    builder.check()
    ends = Builder(str(after), np.float32)
    steps_after = _known(ends, folder, read_json(after), LEROBOT["postprocessor"])
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
    policy.refuse_unknown("the policy", config, LEROBOT["config"] + LEROBOT["config_of_parts"])
    policy.check()
    merged = {old: new for one in rename for old, new in one.items()}
    return Pipeline(where, config, pack, unpack, merged, offsets)


def _check_order(
    builder: Builder, ends: Builder, steps: list[Step], steps_after: list[Step], pack: Step, unpack: Step
) -> None:
    """Records steps that act at another place than where lerobot's own pipelines have them."""
    renames = [step for step in steps if step.name == RENAME]
    if len(renames) > 1 or any(steps.index(step) > steps.index(pack) for step in renames):
        builder.problems.append(f"expected one {RENAME}, before {pack.name}")
    for step in renames:
        given = step.config.get("rename_map") or {}
        if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given.values()):
            builder.problems.append(f"{RENAME}: rename_map: expected names, got {given!r:.100}")
    if any(step.name == ABSOLUTE for step in steps_after[: steps_after.index(unpack)]):
        ends.problems.append(f"expected {ABSOLUTE} after {unpack.name}")
    for name, only in (("language_key", "task"), ("state_horizon", 1)):
        if pack.config.get(name, only) != only:
            builder.problems.append(f"{pack.name}: {name}: expected {only}, got {pack.config[name]!r:.60}")
    for one, where in ((steps, builder), (steps_after, ends)):
        for dtype in [step.config.get("float_dtype") for step in one if step.name == DEVICE]:
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
            if not isinstance(name, str) or value_at(config, "enabled") is not False:
                shown = name if name is not None else given.get("class")
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


def action_steps(modality_config: Any) -> list[Any]:
    """The steps of the actions in a modality config; empty if it does not say."""
    steps = value_at(modality_config, "action", "delta_indices")
    return steps if isinstance(steps, list) else []
