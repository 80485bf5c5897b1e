"""Statistics of robots as the layouts have them, and helpers, for tests of the normalizer."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from saccade import Normalizer
from tests.helpers import layout_files

Array = NDArray[np.float32]


def draw(*shape: int, seed: int = 0, scale: float = 2.0) -> Array:
    return scale * np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def as_array(values: Any) -> Array:
    assert isinstance(values, np.ndarray)
    assert values.dtype == np.float32
    return values


def step_config(values: dict[str, Any]) -> dict[str, Any]:
    """The config of the step of GR00T in a lerobot pipeline."""
    found = next(step["config"] for step in values["steps"] if step["registry_name"].startswith("groot"))
    assert isinstance(found, dict)
    return found


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


# --- Isaac-GR00T N1.5 ---


def row(size: int, seed: int, *, constant: int | None = 1) -> dict[str, list[float]]:
    """Statistics of a key, one dimension constant."""
    rng = np.random.default_rng(seed)
    centre, half = rng.standard_normal(size), rng.random(size) + 0.1
    if constant is not None and constant < size:
        half[constant] = 0.0
    shares = {"min": -1.0, "max": 1.0, "mean": 0.2, "q01": -0.8, "q99": 0.7}
    return {name: (centre + share * half).tolist() for name, share in shares.items()} | {
        "std": (half / 3).tolist()
    }


def metadata(tag: str = "new_embodiment", **about: Any) -> dict[str, Any]:
    sizes = {"state": {"arm": 3, "gripper": 2}, "action": {"arm": 3, "gripper": 1}}
    modality = {"absolute": True, "rotation_type": None, "continuous": True}
    return {
        tag: {
            "statistics": {
                kind: {key: row(size, number) for number, (key, size) in enumerate(keys.items())}
                for kind, keys in sizes.items()
            },
            "modalities": {
                "video": {"front": {"resolution": [64, 48], "channels": 3, "fps": 30.0}},
                **{
                    kind: {
                        key: {**modality, "shape": [size], **about.get(key, {})} for key, size in keys.items()
                    }
                    for kind, keys in sizes.items()
                },
            },
            "embodiment_tag": tag,
        }
    }


def data_config(
    state_modes: str | dict[str, str] = "min_max",
    action_modes: str | dict[str, str] = "min_max",
    **changes: Any,
) -> dict[str, Any]:
    """A data config of the robot of `metadata`, with modes for all keys or by key."""
    keys = ("arm", "gripper")

    def modes(kind: str, given: str | dict[str, str]) -> dict[str, str]:
        if isinstance(given, dict):
            return given
        return {} if given == "none" else {f"{kind}.{key}": given for key in keys}

    return {
        "video_keys": ["video.front"],
        "state_keys": [f"state.{key}" for key in keys],
        "action_keys": [f"action.{key}" for key in keys],
        "language_keys": ["annotation.human.task_description"],
        "observation_indices": [0],
        "action_indices": list(range(16)),
        "state_modes": modes("state", state_modes),
        "action_modes": modes("action", action_modes),
        "target_rotations": {},
        **changes,
    }


# --- Isaac-GR00T N1.6 and N1.7 ---


def processor(**changes: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """`processor_config.json` and `statistics.json` of one robot: arm 3, gripper 1."""
    keys = ["arm", "gripper"]
    kwargs = {
        "modality_configs": {
            "robot": {
                "state": {"delta_indices": [0], "modality_keys": keys, **changes.pop("state", {})},
                "action": {"delta_indices": [0, 1, 2, 3], "modality_keys": keys, **changes.pop("action", {})},
            }
        },
        "max_state_dim": 9,
        "max_action_dim": 8,
        **changes,
    }
    numbers = {"arm": row(3, 0), "gripper": row(1, 1)}
    return {"processor_kwargs": kwargs}, {
        "robot": {"state": numbers, "action": numbers, "relative_action": {}}
    }


def load_processor(folder: Path, config: dict[str, Any], statistics: dict[str, Any]) -> Normalizer:
    layout_files.write_json(folder / "processor_config.json", config)
    layout_files.write_json(folder / "statistics.json", statistics)
    layout_files.write_json(folder / "embodiment_id.json", {"robot": 5, "other": 6})
    return Normalizer.from_pretrained(folder)
