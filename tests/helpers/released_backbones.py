"""What the released backbones were given and returned: the files of tests/data/backbone, as NumPy arrays."""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import saccade
from saccade import _saccade
from saccade.policy.loading import BACKBONE
from tests.helpers import paths
from tests.helpers.tensor_files import read_tensor_file

DATA = paths.DATA / "backbone"
N15 = ("n15_one_view", "n15_two_views", "n15_batch_padded", "n15_bf16", "n15_pixel_shuffle")
N17 = ("n17_one_view", "n17_two_views", "n17_batch_padded")
NAMES = (*N15, "n16_two_views", *N17)


@dataclass(frozen=True)
class ReleasedBackbone:
    """One file: a checkpoint in the published layout with inputs and outputs next to the weights."""

    name: str
    about: dict[str, Any]  # what Backbone.from_pretrained takes as its config
    arrays: dict[str, NDArray[Any]]

    @property
    def path(self) -> Path:
        return DATA / f"{self.name}.safetensors"

    def load(self, precision: str = "float32", num_threads: int | None = None) -> saccade.Backbone:
        return saccade.Backbone.from_pretrained(
            self.path, config=self.about, precision=precision, num_threads=num_threads
        )

    def tensors(self) -> dict[str, torch.Tensor]:
        """The weights by their names without the prefix."""
        names = _saccade.tensor_names(str(self.path))
        prefix = next(one for one in BACKBONE if any(name.startswith(one) for name in names))
        stored = _saccade.read_tensors(str(self.path), prefix)
        return {name: torch.from_numpy(array.copy()) for name, array in stored.items()}

    @property
    def pixel_values(self) -> Any:
        if "_in.pixel_values" in self.arrays:
            return self.arrays["_in.pixel_values"]
        return [self.arrays[f"_in.pixel_values.{view}"] for view in range(2)]

    def inputs(self, **changes: Any) -> saccade.BackboneInputs:
        """The inputs, with some of them changed."""
        given = {
            "pixel_values": self.pixel_values,
            "input_ids": self.arrays["_in.input_ids"],
            "attention_mask": self.arrays["_in.attention_mask"],
            "image_grid_thw": self.arrays.get("_in.image_grid_thw"),
        }
        return saccade.BackboneInputs(**{**given, **changes})

    @property
    def features(self) -> NDArray[np.float64]:
        return self.arrays["_out.backbone_features"].astype(np.float64)

    @property
    def tolerance(self) -> NDArray[np.float64]:
        """How far float32 may be from the features: 4 x the released code's error, and rounding."""
        own_error = float(self.about["f32_max_abs_vs_f64"])
        return 4 * own_error + 1e-6 * np.maximum(1.0, np.abs(self.features))

    @property
    def image_token_id(self) -> int:
        about = self.about
        if "token_ids" in about:
            return int(about["token_ids"]["image_token_id"])
        return int(about.get("eagle", about)["image_token_index"])


@functools.cache
def released_backbone(name: str) -> ReleasedBackbone:
    """The file of that name; read-only arrays, since all tests share them."""
    metadata, arrays = read_tensor_file(DATA / f"{name}.safetensors", "_")
    return ReleasedBackbone(name, json.loads(metadata["about"]), arrays)


def relative_error(given: NDArray[Any], expected: NDArray[Any]) -> float:
    """The norm of the difference, relative to that of the expected rows."""
    return float(np.linalg.norm(given - expected) / np.linalg.norm(expected))
