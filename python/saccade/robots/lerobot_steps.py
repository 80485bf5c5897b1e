"""lerobot's groot policies: the known steps of their processors with their options, and a policy as read.

Every step is on a list of what is known, with its options. ``lerobot_pipeline`` refuses any other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.small_files import read_json
from saccade.errors import CheckpointError

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

#: The steps of the preprocessor and of the postprocessor with their options. Options of images and text are
#: read by ``saccade.Processor``.
BEFORE: Mapping[str, list[str]] = KNOWN["lerobot"]["preprocessor"]
AFTER: Mapping[str, list[str]] = KNOWN["lerobot"]["postprocessor"]
#: Keys of ``config.json`` of all releases. lerobot refuses others.
CONFIG = frozenset(KNOWN["lerobot"]["config"])
#: Keys that saccade reads besides: sizes of a part of the model, and several action decoders, of forks.
CONFIG_OF_PARTS = frozenset(KNOWN["lerobot"]["config_of_parts"])

#: lerobot replaces these of N1.5 by N1.7's when it loads a policy.
MIGRATED = {"chunk_size": (50, 40), "n_action_steps": (50, 40)}
#: Rows of a chunk of the published models.
N15_HORIZON, N17_HORIZON = 16, 40

#: Statistics by feature and name.
Statistics = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Step:
    """A step of a pipeline.

    Attributes:
        name: Its registered name.
        config: Its options.
        statistics: What its state file contains; empty without one.
    """

    name: str
    config: Mapping[str, Any]
    statistics: Statistics


@dataclass(frozen=True)
class Pipeline:
    """A policy that lerobot saved.

    Attributes:
        where: The preprocessor's file, for messages.
        config: The contents of ``config.json``.
        pack: The step that normalises the state.
        unpack: The step that turns actions into the robot's units.
        rename_map: Names of observations that the policy knows under another name.
        offset_names: Names of the action's numbers and names that are left out, where the state is added to
            the action; None where it is not.
    """

    where: str
    config: Mapping[str, Any]
    pack: Step
    unpack: Step
    rename_map: Mapping[str, str]
    offset_names: tuple[tuple[str, ...], tuple[str, ...]] | None

    @property
    def is_n17(self) -> bool:
        """Whether the policy is of N1.7; otherwise it is of N1.5."""
        return self.pack.name == PACK_N17

    def feature(self, kind: str, name: str) -> int | None:
        """Width of one of ``input_features`` or ``output_features``, or None."""
        features = self.config.get(kind)
        feature = features.get(name) if isinstance(features, Mapping) else None
        shape = feature.get("shape") if isinstance(feature, Mapping) else None
        found = shape[-1] if isinstance(shape, list) and shape else None
        return found if type(found) is int and found > 0 else None

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
            chunk = _positive(self.config.get("chunk_size"), 50)
            return N15_HORIZON, min(chunk, N15_HORIZON)
        limits = [N17_HORIZON, *(self._migrated(name) for name in MIGRATED)]
        local = self._local_rows()
        returned = min(limit for limit in [*limits, local or N17_HORIZON] if limit > 0)
        decoded = len(action_steps(self.unpack.config.get("modality_config"))) or returned
        returned = max(1, min(returned, decoded if self.unpack.name == DECODE else returned))
        trained = [
            _positive(self.pack.config.get(name), N17_HORIZON)
            for name in ("valid_action_horizon", "action_horizon")
        ]
        return returned, min(returned, self._migrated("chunk_size"), *trained)

    def _migrated(self, name: str) -> int:
        old, new = MIGRATED[name]
        value = self.config.get(name, new)
        return new if value == old else _positive(value, new)

    def _local_rows(self) -> int | None:
        """Actions of the checkpoint that the policy was made from, if that is still where it was."""
        base = self.config.get("base_model_path")
        path = Path(base) / "processor_config.json" if isinstance(base, str) and base else None
        try:
            values = read_json(path) if path is not None and path.is_file() else {}
            robot = values["processor_kwargs"]["modality_configs"][self.pack.config.get("embodiment_tag")]
            return len(action_steps(robot)) or None
        except (CheckpointError, KeyError, TypeError, OSError, ValueError):
            return None


def action_steps(modality_config: Any) -> list[Any]:
    """The steps of the actions in a modality config; empty if it does not say."""
    action = modality_config.get("action") if isinstance(modality_config, Mapping) else None
    steps = action.get("delta_indices") if isinstance(action, Mapping) else None
    return steps if isinstance(steps, list) else []


def _positive(value: Any, default: int) -> int:
    return value if type(value) is int and value > 0 else default
