"""What the released code was given and returned: the files of tests/data, as NumPy arrays."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade import Chunking
from tests.helpers.paths import DATA
from tests.helpers.tensor_files import read_tensor_file

NAMES = ("n15_tiny", "n15_single_view", "n15_bf16")
VARIANTS = ("n17_tiny", "n17_rtc", "fork_two_decoders")


@dataclass(frozen=True)
class Released:
    """One file: a checkpoint in the published layout with inputs and outputs next to the weights."""

    name: str
    path: Path  # what ActionHead.from_pretrained takes as its source, with `config`
    config: dict[str, Any]  # the head's own config, with the published names
    backbone_features: NDArray[np.float32]  # (batch, T_vl, context_dim)
    state: NDArray[np.float32]  # (batch, 1, state_dim)
    embodiment_id: NDArray[np.int64]  # (batch,)
    noise: NDArray[np.float32]  # (batch, horizon, encoder_action_dim)
    vl_embs: NDArray[np.float32]  # (batch, T_vl, context_dim)
    actions_f32: NDArray[np.float32]  # (batch, horizon, action_dim)
    actions_f64: NDArray[np.float64]  # the same in float64
    options: dict[str, Any]  # the rest of what a head is called with: masks, real-time chunking

    @property
    def arguments(self) -> dict[str, Any]:
        """All that a head is called with."""
        return {
            "backbone_features": self.backbone_features,
            "state": self.state,
            "embodiment_id": self.embodiment_id,
            "noise": self.noise,
            **self.options,
        }

    @property
    def tolerance(self) -> NDArray[np.float64]:
        """How far a float32 head may be from `actions_f64`: 4 x the released code's error, and rounding."""
        own_error = float(np.abs(self.actions_f32 - self.actions_f64).max())
        return 4 * own_error + 1e-6 * np.maximum(1.0, np.abs(self.actions_f64))


@functools.cache
def load_released(name: str) -> Released:
    """The file of that name; read-only arrays, since all tests share them."""
    path = DATA / f"{name}.safetensors"
    metadata, arrays = read_tensor_file(path, "_")
    optional = ("attention_mask", "image_mask", "previous_chunk")
    options: dict[str, Any] = {name: arrays[f"_in.{name}"] for name in optional if f"_in.{name}" in arrays}
    if "rtc" in metadata:
        rtc = json.loads(metadata["rtc"])
        options["chunking"] = Chunking(
            overlap=rtc["rtc_overlap_steps"],
            frozen=rtc["rtc_frozen_steps"],
            ramp_rate=rtc["rtc_ramp_rate"],
            horizon=rtc["action_horizon"],
        )
    return Released(
        name=name,
        path=path,
        config=json.loads(metadata["config"]),
        backbone_features=arrays["_in.backbone_features"],
        state=arrays["_in.state"],
        embodiment_id=arrays["_in.embodiment_id"],
        noise=arrays["_in.noise"],
        vl_embs=arrays["_out.vl_embs"],
        actions_f32=arrays["_out.f32"],
        actions_f64=arrays["_out.f64"],
        options=options,
    )
