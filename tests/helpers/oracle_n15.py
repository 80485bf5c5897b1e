"""What GR00T N1 and N1.5 compute from metadata.json and a data config: an oracle in float64.

Written from a description of the released code alone, not from saccade's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.helpers.oracle_rotations import EULER, F64, WIDTHS, from_numbers, to_numbers

PROJECTORS = {"new_embodiment": 31, "oxe_droid": 17, "agibot_genie1": 26, "gr1": 24}
STATISTICS = {
    "min_max": ("min", "max"),
    "q99": ("q01", "q99"),
    "mean_std": ("mean", "std"),
    "scale": ("min", "max"),
}
TARGETS = ("quaternion", "axis_angle", "rotation_6d", *EULER)


class Key:
    """One key of the data config: how its numbers reach the head, and how the head's come back."""

    def __init__(self, name: str, entry: dict[str, Any], config: dict[str, Any]) -> None:
        self.name = name
        self.kind, self.key = name.split(".")
        self.about = entry["modalities"][self.kind].get(self.key)
        self.mode = config[f"{self.kind}_modes"].get(name)
        self.target: Any = config["target_rotations"].get(name)
        rows = entry["statistics"][self.kind].get(self.key)
        self.has_statistics = rows is not None
        # Statistics are cast to the state's dtype first; comparisons come after.
        self.rows: dict[str, F64] = {
            k: np.asarray(v, np.float32).astype(np.float64) for k, v in (rows or {}).items()
        }
        self.width = self.about["shape"][0] if self.about else 0
        self.source: Any = self.about["rotation_type"] if self.about else None
        self.converted = self.target is not None and self.target != self.source
        if self.converted and self.mode == "min_max" and self.target in WIDTHS:
            bound = 1.0 if self.target in ("rotation_6d", "quaternion") else math.pi
            ends = np.full(WIDTHS[self.target], bound)
            self.rows = {"min": -ends, "max": ends}

    def refused(self) -> str | None:
        """Why the released code, or the issue's rules, refuse this key."""
        mode, target = self.mode, self.target
        if self.about is None:
            return "not in the modalities"
        if mode not in (None, "binary", "sin_cos", *STATISTICS):
            return "unknown mode"
        # The release also wants statistics of binary keys, but reads nothing there.
        if mode in STATISTICS and not self.has_statistics:
            return "not in the statistics"
        if self.kind == "action" and mode in ("scale", "sin_cos"):
            return "cannot be inverted"
        if target is not None and target not in TARGETS:
            return "unknown target, or a matrix"
        if target is not None and self.source is None:
            return "a target without a rotation_type"
        if self.converted:
            return self.conversion_refused()
        if not self.about["continuous"] and mode not in (None, "binary"):
            return "discrete"
        return None

    def conversion_refused(self) -> str | None:
        source, target = self.source, self.target
        if self.mode is not None and (self.mode != "min_max" or not self.about["absolute"]):
            return "conversion with a mode other than min_max, or of a relative rotation"
        if source == "matrix" or (source in EULER and target in EULER) or WIDTHS[source] != self.width:
            return "no such conversion"
        own = (self.width,) if self.kind == "action" else (self.width, 2 * self.width, 6)
        return None if WIDTHS[target] in own else "width"

    def to_head(self, x: F64) -> F64:
        if self.converted:
            x = to_numbers(self.target, from_numbers(self.source, x))
        if self.mode is None:
            return x
        if self.mode == "sin_cos":
            return np.concatenate([np.sin(x), np.cos(x)], -1)
        if self.mode == "binary":
            return (x > 0.5).astype(np.float64)
        low, high = (self.rows[name] for name in STATISTICS[self.mode])
        if self.mode == "mean_std":
            return np.where(high != 0, (x - low) / np.where(high != 0, high, 1), x)
        if self.mode == "scale":
            largest = np.maximum(np.abs(low), np.abs(high))
            return np.where(largest != 0, x / np.where(largest != 0, largest, 1), 0.0)
        scaled = 2 * (x - low) / np.where(low != high, high - low, 1) - 1
        if self.mode == "min_max":
            return np.where(low != high, scaled, 0.0)
        return np.clip(np.where(low != high, scaled, x), -1, 1)

    def denormalised(self, x: F64) -> F64:
        """From the head, in the target's representation still."""
        if self.mode is None:
            return x
        if self.mode == "binary":
            return (x > 0.5).astype(np.float64)
        low, high = (self.rows[name] for name in STATISTICS[self.mode])
        if self.mode == "mean_std":
            return x * high + low
        return (x + 1) / 2 * (high - low) + low

    def from_head(self, x: F64) -> F64:
        x = self.denormalised(x)
        return to_numbers(self.source, from_numbers(self.target, x)) if self.converted else x


class Oracle:
    """One robot of metadata.json with one data config."""

    def __init__(
        self, entry: dict[str, Any], config: dict[str, Any], state_dim: int, action_dim: int
    ) -> None:
        self.config, self.state_dim, self.action_dim = config, state_dim, action_dim
        self.embodiment_id = PROJECTORS.get(entry["embodiment_tag"])
        self.states = [Key(name, entry, config) for name in config["state_keys"]]
        self.actions_ = [Key(name, entry, config) for name in config["action_keys"]]
        self.action_horizon = len(config["action_indices"])

    def refused(self) -> str | None:
        config, indices = self.config, self.config["observation_indices"]
        named = {*config["state_modes"], *config["action_modes"], *config["target_rotations"]}
        if not named <= {*config["state_keys"], *config["action_keys"]}:
            return "a mode or target of a key that is not listed"
        if indices[-1] != 0 or max(indices) > 0 or len({*np.diff(indices).tolist()}) > 1:
            return "observation indices"
        for key in (*self.states, *self.actions_):
            if reason := key.refused():
                return f"{key.name}: {reason}"
        if sum(key.width for key in self.actions_) > self.action_dim:
            return "the action is wider than the head's"
        return None

    def state(self, state: NDArray[np.float32]) -> F64:
        """``(..., width)`` to ``(..., state_dim)``: cut off or zero-padded."""
        parts = [key.to_head(state[..., cut].astype(np.float64)) for key, cut in self.parts(self.states)]
        joined = np.concatenate(parts, -1)[..., : self.state_dim]
        pad = [(0, 0)] * (joined.ndim - 1) + [(0, self.state_dim - joined.shape[-1])]
        return np.pad(joined, pad)

    def actions(self, chunk: NDArray[np.float32]) -> F64:
        """``(..., horizon, action_dim)`` to ``(..., horizon, width)``."""
        parts = self.parts(self.actions_)
        return np.concatenate([key.from_head(chunk[..., cut].astype(np.float64)) for key, cut in parts], -1)

    @staticmethod
    def parts(keys: list[Key]) -> list[tuple[Key, slice]]:
        ends = np.cumsum([key.width for key in keys]).tolist()
        return [(key, slice(end - key.width, end)) for key, end in zip(keys, ends, strict=True)]

    def slices(self, kind: str) -> dict[str, slice]:
        keys = self.states if kind == "state" else self.actions_
        return {key.key: cut for key, cut in self.parts(keys)}
