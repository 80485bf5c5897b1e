"""lerobot's groot policies: the known steps of their processors with their options, and a policy as read.

Every step is on a list of what is known, with its options. ``lerobot_pipeline`` refuses any other.
"""

from __future__ import annotations

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

#: Options of both releases' steps that pack an observation.
_PACK = (
    "state_horizon",
    "action_horizon",
    "max_state_dim",
    "max_action_dim",
    "language_key",
    "formalize_language",
    "embodiment_tag",
    "embodiment_mapping",
    "normalize_min_max",
)
#: Options of images that N1.7's step and the processors of Isaac-GR00T N1.6 and N1.7 have.
IMAGE_OPTIONS = (
    "model_name",
    "image_crop_size",
    "image_target_size",
    "shortest_image_edge",
    "crop_fraction",
    "use_albumentations",
)
#: The steps of the preprocessor and their options. ``saccade.Processor`` reads those of images and text.
BEFORE: Mapping[str, tuple[str, ...]] = {
    RENAME: ("rename_map",),
    BATCH: (),
    **dict.fromkeys((RELATIVE, DELTA), ("enabled", "exclude_joints", "action_names")),
    PACK_N15: _PACK,
    "groot_eagle_encode_v3": ("tokenizer_assets_repo",),
    "groot_eagle_collate_v3": ("tokenizer_assets_repo",),
    PACK_N17: (
        *_PACK,
        "valid_action_horizon",
        "video_horizon",
        "state_dropout_prob",
        "clip_outliers",
        "use_percentiles",
        "video_modality_keys",
        "raw_stats",
        "modality_config",
    ),
    "groot_n1_7_vlm_encode_v1": (*IMAGE_OPTIONS, "letter_box_transform", "device"),
    DEVICE: ("device", "float_dtype"),
}
#: The steps of the postprocessor.
AFTER: Mapping[str, tuple[str, ...]] = {
    UNPACK_N15: ("env_action_dim", "normalize_min_max"),
    UNPACK_N17: (
        "env_action_dim",
        "normalize_min_max",
        "clip_normalized_action",
        "libero_gripper_action",
        "libero_gripper_binarize",
    ),
    DECODE: (
        "env_action_dim",
        "raw_stats",
        "modality_config",
        "use_percentiles",
        "use_relative_action",
        "action_decode_transform",
    ),
    ABSOLUTE: ("enabled",),
    DEVICE: ("device", "float_dtype"),
}

#: Keys of ``config.json`` of all releases. lerobot refuses others.
CONFIG = frozenset(
    """
    type action_decode_transform balance_dataset_weights balance_trajectory_weights base_model_path batch_size
    chunk_size dataloader_num_workers dataset_paths device embodiment_tag image_size input_features license
    lora_alpha lora_dropout lora_full_model lora_rank max_action_dim max_state_dim max_steps model_params_fp32
    n_action_steps n_obs_steps normalization_mapping num_inference_timesteps optimizer_betas optimizer_eps
    optimizer_lr optimizer_weight_decay output_dir output_features pretrained_path pretrained_revision private
    push_to_hub relative_exclude_joints repo_id report_to resume rtc_ramp_rate save_steps tags
    tokenizer_assets_repo tune_diffusion_model tune_llm tune_projector tune_top_llm_layers tune_visual
    tune_vlln use_amp use_bf16 use_flash_attention use_peft use_relative_actions video_backend warmup_ratio
    """.split()  # noqa: SIM905
)
#: Keys that saccade reads besides: sizes of a part of the model, and several action decoders, of forks.
CONFIG_OF_PARTS = frozenset(
    """
    action_head_cfg backbone_cfg eagle_config text_config vision_config select_layer use_multi_action_heads
    split_arm_heads num_target_vision_tokens action_arm_dim action_claw_dim action_left_arm_dim
    action_right_arm_dim
    """.split()  # noqa: SIM905
)

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
