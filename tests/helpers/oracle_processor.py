"""What GR00T N1.6 and N1.7 compute from processor_config.json and statistics.json: an oracle in float64.

Written from a description of the released code alone, not from saccade's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.helpers.oracle_rotations import F64, from_rows, from_vector, to_numbers

IDS = {
    "n1.6": {
        "oxe_google": 0,
        "oxe_widowx": 1,
        "libero_panda": 2,
        "unitree_g1": 8,
        "new_embodiment": 10,
        "robocasa_panda_omron": 13,
        "oxe_droid": 16,
        "gr1": 20,
        "behavior_r1_pro": 24,
    },
    "n1.7": {
        "simpler_env_google": 0,
        "simpler_env_widowx": 1,
        "libero_sim": 2,
        "new_embodiment": 10,
        "robocasa_panda_omron": 10,
        "robocasa_gr1_tabletop": 10,
        "unitree_g1_sonic": 11,
        "oxe_droid_relative_eef_relative_joint": 24,
        "real_g1_relative_eef_relative_joints": 25,
        "unitree_g1_full_body_with_waist_height_nav_cmd": 25,
        "real_r1_pro_sharpa_relative_eef": 26,
        "real_r1_pro_sharpa_relative_eef_human": 26,
        "real_r1_pro_sharpa_relative_eef_maxinsights": 26,
        "real_r1_pro_sharpa_relative_eef_mecka": 26,
        "xdof_relative_eef_relative_joint": 27,
        "xdof_relative_eef_relative_joint_subtask": 27,
    },
}
NAMES = {  # N1.7's enum names that are not the value in capitals
    "XDOF": "xdof_relative_eef_relative_joint",
    "XDOF_SUBTASK": "xdof_relative_eef_relative_joint_subtask",
    "REAL_G1": "real_g1_relative_eef_relative_joints",
    "REAL_R1_PRO_SHARPA": "real_r1_pro_sharpa_relative_eef",
    "REAL_R1_PRO_SHARPA_HUMAN": "real_r1_pro_sharpa_relative_eef_human",
    "REAL_R1_PRO_SHARPA_MAXINSIGHTS": "real_r1_pro_sharpa_relative_eef_maxinsights",
    "REAL_R1_PRO_SHARPA_MECKA": "real_r1_pro_sharpa_relative_eef_mecka",
    "UNITREE_G1": "unitree_g1_full_body_with_waist_height_nav_cmd",
    "LIBERO_PANDA": "libero_sim",
}
DEFAULTS: dict[str, Any] = {"max_state_dim": 29, "max_action_dim": 29, "clip_outliers": True}
POSES = {"XYZ_ROT6D": 9, "XYZ_ROTVEC": 6}


def pose(numbers: F64, form: str) -> tuple[F64, F64]:
    read = from_rows if form == "XYZ_ROT6D" else from_vector
    return numbers[..., :3], read(numbers[..., 3:])


class Oracle:
    """One robot of a processor's files."""

    def __init__(
        self, config: dict[str, Any], statistics: dict[str, Any], ids: dict[str, int] | None, tag: str
    ) -> None:
        self.release = "n1.7" if config["processor_class"] == "Gr00tN1d7Processor" else "n1.6"
        self.options = {**DEFAULTS, "max_action_horizon": 50 if self.release == "n1.7" else 40}
        self.options |= config["processor_kwargs"]
        self.robots = self.options["modality_configs"]
        self.statistics = statistics[tag]
        self.embodiment_id = (IDS[self.release] | (ids or {})).get(tag)
        modalities = self.robots[tag]
        self.state_keys: list[str] = modalities["state"]["modality_keys"]
        self.action_keys: list[str] = modalities["action"]["modality_keys"]
        self.modalities = modalities
        self.action_horizon = len(modalities["action"]["delta_indices"])
        listed = modalities["action"].get("action_configs")
        absolute = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
        self.count = len(self.action_keys) if listed is None else len(listed)
        self.configs = dict(zip(self.action_keys, listed or [absolute] * len(self.action_keys), strict=False))

    def option(self, name: str) -> Any:
        return self.options.get(name, False)

    def width(self, kind: str, key: str) -> int:
        return len(self.statistics[kind][key]["mean"])

    def converted(self, key: str) -> bool:
        return bool(self.option("use_relative_action") and self.configs[key]["rep"] == "RELATIVE")

    def reference(self, key: str) -> str:
        return self.configs[key].get("state_key") or key

    def in_list(self, kind: str, name: str, key: str) -> bool:
        return key in (self.modalities[kind].get(name) or [])

    # --- refusals ---

    def refused(self) -> str | None:
        if self.count != len(self.action_keys):
            return "count of action_configs"
        longest = max(len(robot["action"]["delta_indices"]) for robot in self.robots.values())
        if self.release == "n1.7" and longest > self.options["max_action_horizon"]:
            return "horizon"
        for key in self.action_keys:
            if self.converted(key) and (reason := self.conversion_refused(key)):
                return f"{key}: {reason}"
        if sum(self.width("action", key) for key in self.action_keys) > self.options["max_action_dim"]:
            return "action too wide"
        # With exclude_state the release joins zeros as wide as the raw state, and checks their width.
        double = [self.encoded(key) and not self.option("exclude_state") for key in self.state_keys]
        widths = [
            self.width("state", key) * (1 + twice) for key, twice in zip(self.state_keys, double, strict=True)
        ]
        if sum(widths) > self.options["max_state_dim"]:
            return "state too wide"
        return None

    def conversion_refused(self, key: str) -> str | None:
        config, width = self.configs[key], self.width("action", key)
        if key not in (self.statistics.get("relative_action") or {}):
            return "no relative statistics"
        rows = np.shape(self.statistics["relative_action"][key]["min"])
        if len(rows) == 2 and rows[0] not in (1, self.action_horizon):
            return "steps of statistics"
        if rows[-1] != width:
            return "width of statistics"
        if self.reference(key) not in self.state_keys:
            return "no reference"
        if self.width("state", self.reference(key)) != width:
            return "reference of another width"
        if config["type"] == "NON_EEF":
            return None if config["format"] == "DEFAULT" else "joints as a pose"
        return None if POSES.get(config["format"]) == width else "width of a pose"

    # --- numbers ---

    def encoded(self, key: str) -> bool:
        listed = self.in_list("state", "sin_cos_embedding_keys", key)
        return bool(self.option("apply_sincos_state_encoding") and listed)

    def bounds(self, kind: str, key: str) -> tuple[F64, F64]:
        quantiles = self.option("use_percentiles") and kind != "relative_action"
        names = ("q01", "q99") if quantiles else ("min", "max")
        low, high = (np.array(self.statistics[kind][key][name], np.float64) for name in names)
        return low, high

    def moments(self, kind: str, key: str) -> tuple[F64, F64]:
        mean, std = (np.array(self.statistics[kind][key][name], np.float64) for name in ("mean", "std"))
        return mean, std

    def state_key(self, key: str, x: F64) -> F64:
        if self.encoded(key):
            return np.concatenate([np.sin(x), np.cos(x)], -1)
        if self.in_list("state", "mean_std_embedding_keys", key):
            mean, std = self.moments("state", key)
            return np.where(std == 0, x, (x - mean) / np.where(std == 0, 1, std))
        low, high = self.bounds("state", key)
        constant = np.abs(high - low) <= 1e-8 + 1e-5 * np.abs(low)
        scaled = np.where(constant, 0.0, 2 * (x - low) / np.where(constant, 1, high - low) - 1)
        return np.clip(scaled, -1, 1) if self.options["clip_outliers"] else scaled

    def state(self, state: NDArray[np.float32]) -> F64:
        """``(..., width)`` to ``(..., max_state_dim)``."""
        result = np.zeros((*state.shape[:-1], self.options["max_state_dim"]))
        if self.option("exclude_state"):
            return result
        cuts = self.slices("state")
        parts = [self.state_key(key, state[..., cut].astype(np.float64)) for key, cut in cuts.items()]
        joined = np.concatenate(parts, -1)
        result[..., : joined.shape[-1]] = joined
        return result

    def actions(self, chunk: NDArray[np.float32], state: NDArray[np.float32]) -> F64:
        """``(batch, steps, max_action_dim)`` with states ``(batch, history, width)``."""
        references = self.slices("state")
        parts = []
        for key, cut in self.slices("action").items():
            x = self.action_key(key, chunk[:, : self.action_horizon, cut].astype(np.float64))
            if self.converted(key):
                raw = state[:, -1, references[self.reference(key)]].astype(np.float64)
                x = self.absolute(key, x, raw[:, None])
            parts.append(x)
        return np.concatenate(parts, -1)

    def action_key(self, key: str, x: F64) -> F64:
        kind = "relative_action" if self.converted(key) else "action"
        if self.in_list("action", "mean_std_embedding_keys", key):
            mean, std = self.moments(kind, key)
            return np.where(std == 0, x, x * std + mean)
        low, high = self.bounds(kind, key)
        return (np.clip(x, -1, 1) + 1) / 2 * (high - low) + low

    def absolute(self, key: str, x: F64, reference: F64) -> F64:
        form = self.configs[key]["format"]
        if self.configs[key]["type"] == "NON_EEF":
            return reference + x
        origin, frame = pose(reference, form)
        moved, turned = pose(x, form)
        position = (frame @ moved[..., None])[..., 0] + origin
        name = "rotation_6d" if form == "XYZ_ROT6D" else "axis_angle"
        return np.concatenate([position, to_numbers(name, frame @ turned)], -1)

    def slices(self, kind: str) -> dict[str, slice]:
        keys = self.state_keys if kind == "state" else self.action_keys
        widths = [self.width(kind, key) for key in keys]
        ends = np.cumsum(widths).tolist()
        return {key: slice(end - w, end) for key, end, w in zip(keys, ends, widths, strict=True)}
