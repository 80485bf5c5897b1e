"""What lerobot's groot policy computes from a saved folder: an oracle in float64.

Written from a description of the released code alone, not from saccade's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.helpers.oracle_processor import pose
from tests.helpers.oracle_rotations import F64, to_numbers

KNOWN = {
    "n1.5": {
        "rename_observations_processor",
        "to_batch_processor",
        "delta_actions_processor",
        "absolute_actions_processor",
        "groot_pack_inputs_v3",
        "groot_eagle_encode_v3",
        "groot_eagle_collate_v3",
        "device_processor",
        "groot_action_unpack_unnormalize_v1",
    },
    "n1.7": {
        "rename_observations_processor",
        "to_batch_processor",
        "relative_actions_processor",
        "absolute_actions_processor",
        "groot_n1_7_pack_inputs_v1",
        "groot_n1_7_vlm_encode_v1",
        "device_processor",
        "groot_action_unpack_unnormalize_v2",
        "groot_n1_7_action_decode_v1",
    },
}
RELATIVE = {"n1.5": "delta_actions_processor", "n1.7": "relative_actions_processor"}
MIGRATED = {"chunk_size": (50, 40), "n_action_steps": (50, 40)}
Tensors = dict[str, NDArray[np.float32]]


class Oracle:
    """A saved folder: its three JSON files and the tensors of its state files by step name."""

    def __init__(
        self,
        config: dict[str, Any],
        before: dict[str, Any],
        after: dict[str, Any],
        states: dict[str, Tensors],
    ) -> None:
        self.config, self.states = config, states
        # The absolute step takes the first of several relative steps.
        self.before = {step["registry_name"]: step["config"] for step in reversed(before["steps"])}
        self.after = {step["registry_name"]: step["config"] for step in reversed(after["steps"])}
        self.release = "n1.5" if "groot_pack_inputs_v3" in self.before else "n1.7"
        names = {name for name in self.before if "pack_inputs" in name}
        self.pack_name = names.pop()
        self.pack = self.before[self.pack_name]
        self.embodiment_id = self.pack["embodiment_mapping"].get(self.pack["embodiment_tag"], 0)
        self.state_width = config["input_features"]["observation.state"]["shape"][0]
        self.action_width = config["output_features"]["action"]["shape"][0]
        self.native = self.after.get("groot_n1_7_action_decode_v1")
        self.unpack_name = next((name for name in self.after if "unnormalize" in name), "")
        self.relative = self.before.get(RELATIVE[self.release])
        self.absolute = self.after.get("absolute_actions_processor", {}).get("enabled", False)

    # --- what config.json says ---

    def number(self, name: str) -> int:
        """``chunk_size`` or ``n_action_steps`` of N1.7, migrated from N1.5's default."""
        old, new = MIGRATED[name]
        value = self.config.get(name, new)
        return new if value == old else int(value)

    @property
    def libero(self) -> bool:
        value = self.config.get("action_decode_transform", "auto")
        if value == "auto":
            return bool(self.config.get("embodiment_tag", "new_embodiment") == "libero_sim")
        return bool(value == "libero")

    @property
    def action_horizon(self) -> int:
        if self.release == "n1.5":
            return 16
        rows = max(1, min(40, self.number("chunk_size"), self.number("n_action_steps")))
        indices = self.native and self.native["modality_config"]["action"].get("delta_indices")
        return max(1, min(rows, len(indices))) if indices else rows

    # --- refusals ---

    def refused(self) -> str | None:
        steps = self.before | self.after
        # A step that says that it is off changes nothing.
        enabled = {name for name in steps if steps[name].get("enabled") is not False}
        if unknown := enabled - KNOWN[self.release]:
            return f"unknown steps {unknown}"
        if self.absolute and self.relative is None:
            return "absolute without relative"
        # lerobot also refuses n_action_steps above chunk_size, but the smaller of them counts anyhow.
        if self.release == "n1.7" and self.state_width > self.pack["max_state_dim"]:
            return "state too wide"
        if self.native and (reason := self.native_refused()):
            return reason
        if self.absolute and self.state_width < self.result_width:
            return "state narrower than the action"
        return None

    def native_refused(self) -> str | None:
        assert self.native is not None
        statistics, keys = self.native["raw_stats"], self.groups("action")
        for key, config in self.action_configs().items():
            if not self.is_relative(key):
                continue
            rows = np.shape(statistics.get("relative_action", {}).get(key, {}).get("min"))
            if not rows or (len(rows) == 2 and 1 != rows[0] < self.action_horizon):
                return f"{key}: relative statistics"
            reference = config.get("state_key") or key
            if self.groups("state").get(reference) != keys[key]:
                return f"{key}: reference"
            if config["type"].lower() == "eef" and (
                config["format"].lower() not in ("xyz+rot6d", "xyz_rot6d") or keys[key] != 9
            ):
                return f"{key}: pose"
            end = np.cumsum(list(keys.values()))[list(keys).index(key)]
            if config["type"].lower() == "eef" and end - keys[key] < self.result_width < end:
                return f"{key}: a pose that is cut: lerobot takes it, saccade does not"
        if self.libero:
            end = np.cumsum(list(keys.values()))[list(keys).index("gripper")] if "gripper" in keys else 0
            if keys.get("gripper") != 1 or end > self.result_width:
                return "gripper"
        return None

    # --- groups of native pipelines ---

    def groups(self, kind: str) -> dict[str, int]:
        assert self.native is not None
        found = self.native["raw_stats"][kind]
        names = ("mean", "min", "q01") if kind == "state" else ("mean", "q01", "min", "max", "std")
        keys = self.native["modality_config"][kind]["modality_keys"]
        rows = {key: next(found[key][name] for name in names if name in found[key]) for key in keys}
        return {key: np.shape(row)[-1] for key, row in rows.items()}

    def action_configs(self) -> dict[str, dict[str, Any]]:
        assert self.native is not None
        listed = self.native["modality_config"]["action"].get("action_configs") or []
        return dict(zip(self.groups("action"), listed, strict=False))

    def is_relative(self, key: str) -> bool:
        assert self.native is not None
        rep = self.action_configs().get(key, {}).get("rep", "absolute")
        return bool(self.native["use_relative_action"]) and rep.lower() == "relative"

    @property
    def result_width(self) -> int:
        width = sum(self.groups("action").values()) if self.native else self.action_width
        step = self.native if self.native else self.after[self.unpack_name]
        limit = self.action_width if self.release == "n1.5" else step.get("env_action_dim", 0)
        return min(width, int(self.action_width), int(limit or width))

    # --- numbers ---

    def state(self, state: NDArray[np.float32]) -> F64:
        """``(batch, width)`` to ``(batch, max_state_dim)``."""
        x = state.astype(np.float64)
        tensors = self.states.get(self.pack_name, {})
        rows = {
            name: tensors[f"observation.state.{name}"].astype(np.float64)
            for name in ("min", "max")
            if f"observation.state.{name}" in tensors
        }
        known = any(name.startswith("observation.state.") for name in tensors)
        if known and (self.release == "n1.5" or self.pack["normalize_min_max"]):
            low, high = (
                fitted(rows.get(name), self.state_width, pad) for name, pad in (("min", 0.0), ("max", 1.0))
            )
            x = np.where(high != low, 2 * (x - low) / np.where(high != low, high - low, 1) - 1, 0.0)
            if self.release == "n1.7" and self.pack["clip_outliers"]:
                x = np.clip(x, -1, 1)
        width = self.pack["max_state_dim"]
        x = x[..., :width]
        return np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, width - x.shape[-1])])

    def actions(self, chunk: NDArray[np.float32], state: NDArray[np.float32]) -> F64:
        """``(batch, steps, max_action_dim)`` with states ``(batch, width)``."""
        x = chunk[:, : self.action_horizon, : self.action_width].astype(np.float64)
        x = self.decoded(x, state) if self.native else self.unpacked(x)
        if self.absolute:
            x = x + (state[:, : x.shape[-1]] * self.mask(x.shape[-1]))[:, None]
        return x

    def unpacked(self, x: F64) -> F64:
        step, tensors = self.after[self.unpack_name], self.states.get(self.unpack_name, {})
        x = x[..., : self.result_width]
        if tensors and (self.release == "n1.5" or step["normalize_min_max"]):
            width = x.shape[-1]
            low, high = np.zeros(width), np.ones(width)
            if any(name.startswith("action.") for name in tensors):
                ends = ("min", 0.0), ("max", 1.0)
                low, high = (fitted(tensors.get(f"action.{name}"), width, 0.0, pad) for name, pad in ends)
            if self.release == "n1.7" and step["clip_normalized_action"]:
                x = np.clip(x, -1, 1)
            x = (x + 1) / 2 * (high - low) + low
        if self.release == "n1.7" and self.libero and x.shape[-1] >= 7:
            x = inverted(x, x.shape[-1] - 1)
        return x

    def decoded(self, x: F64, state: NDArray[np.float32]) -> F64:
        assert self.native is not None
        statistics, parts, start = self.native["raw_stats"], [], 0
        ends = dict(zip(self.groups("state"), np.cumsum(list(self.groups("state").values())), strict=True))
        for key, width in self.groups("action").items():
            relative = self.is_relative(key)
            quantiles = self.native["use_percentiles"] and not relative
            rows = statistics["relative_action" if relative else "action"][key]
            low, high = (
                np.asarray(rows[name], np.float32).astype(np.float64)
                for name in (("q01", "q99") if quantiles else ("min", "max"))
            )
            if low.ndim == 2:
                low, high = low[: x.shape[1]], high[: x.shape[1]]
            part = (np.clip(x[..., start : start + width], -1, 1) + 1) / 2 * (high - low) + low
            start += width
            if relative:
                config = self.action_configs()[key]
                reference = config.get("state_key") or key
                raw = state[:, None, ends[reference] - width : ends[reference]].astype(np.float64)
                part = moved(part, raw, config["type"].lower() == "eef")
            parts.append(part)
        joined = np.concatenate(parts, -1)[..., : self.result_width]
        if self.libero:
            keys = list(self.groups("action"))
            widths = list(self.groups("action").values())
            joined = inverted(joined, sum(widths[: keys.index("gripper")]))
        return joined

    def mask(self, width: int) -> F64:
        assert self.relative is not None
        names, tokens = self.relative.get("action_names"), self.relative.get("exclude_joints")
        mask = np.ones(width)
        for n, name in enumerate((names or [])[:width]):
            if any(token.lower() in name.lower() for token in tokens or []):
                mask[n] = 0.0
        return mask


def fitted(
    row: NDArray[np.float32] | F64 | None, width: int, pad: float, missing: float | None = None
) -> F64:
    """A row of statistics, cut off or padded to the width; a missing one is all ``missing`` (or ``pad``)."""
    if row is None:
        return np.full(width, pad if missing is None else missing)
    found = row.astype(np.float64).reshape(-1)[:width]
    return np.pad(found, (0, width - len(found)), constant_values=pad)


def inverted(x: F64, column: int) -> F64:
    result = x.copy()
    result[..., column] = -np.sign(2 * x[..., column] - 1)
    return result


def moved(x: F64, reference: F64, is_pose: bool) -> F64:
    if not is_pose:
        return x + reference
    origin, frame = pose(reference, "XYZ_ROT6D")
    offset, turn = pose(x, "XYZ_ROT6D")
    position = (frame @ offset[..., None])[..., 0] + origin
    return np.concatenate([position, to_numbers("rotation_6d", frame @ turn)], -1)
