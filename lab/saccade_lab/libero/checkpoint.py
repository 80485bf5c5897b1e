"""The files of a small LIBERO policy besides its weights, in NVIDIA's layout of N1.5 or of N1.7.

Keys and units are those of the released embodiment ``libero_sim``: a state of position, axis times angle and
the two fingers, an action of ``OSC_POSE``, relative to the hand, and a gripper from 0, closed, to 1, open.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from saccade._internal.arrays import Float32Array
from saccade._internal.files import write_json
from saccade.head.config import HeadConfig
from saccade.processor import Processor
from saccade.robots import LANGUAGE_KEY, Normalizer
from saccade_lab.backbone_sizes import BackboneSizes, eagle_config
from saccade_lab.libero.layout import ACTION_DIM, ACTION_GROUPS, CONTROL_HZ, STATE_DIM, STATE_GROUPS
from saccade_lab.random_checkpoint.robot_metadata import metadata
from saccade_lab.random_checkpoint.tokenizer import tokenizer
from saccade_lab.sim.settings import (
    CROP_SHARE,
    DATA_CONFIG_FILE,
    METADATA_FILE,
    n15_config,
    statistics_of,
    vocabulary,
)

CONFIG_FILE, TOKENIZER_FILE = "config.json", "tokenizer.json"
PROCESSOR_FILE, STATISTICS_FILE, IDS_FILE = "processor_config.json", "statistics.json", "embodiment_id.json"
PIXELS_FILE = "preprocessor_config.json"

VERSIONS = ("n1.5", "n1.7")
EMBODIMENT = "libero_sim"
EMBODIMENT_ID = 0
CAMERAS = ("image", "wrist_image")
PATCH_SIZE = 16  # of both towers, in pixels; four patches become an image token


@dataclass(frozen=True)
class LiberoConfig:
    """All of a small LIBERO policy that is decided before its training.

    Attributes:
        version: One of ``VERSIONS``.
        head: Config of the head, in the published keys.
        backbone: Config of the backbone, in the keys of ``saccade_lab.published.RELEASED``.
        said: The instructions of the tasks, in the order of their numbers.
        frame_size: Pixels along each side of a recorded frame.
        view_size: Pixels along each side of a frame as the vision tower sees it.
        statistics: Statistics of ``state`` and ``action`` by group; empty before the demonstrations are read.
    """

    version: str
    head: Mapping[str, Any]
    backbone: Mapping[str, Any]
    said: tuple[str, ...]
    frame_size: int
    view_size: int
    statistics: Mapping[str, Mapping[str, Mapping[str, list[float]]]] = field(default_factory=dict)

    @property
    def instructions(self) -> tuple[tuple[str, ...], ...]:
        """The wordings of each task, of which LIBERO has one."""
        return tuple((said,) for said in self.said)

    @property
    def impossible(self) -> tuple[tuple[int, ...], ...]:
        """The tasks whose object is absent in the scene of a task: unknown here, so none."""
        return ((),) * len(self.said)

    @property
    def num_cameras(self) -> int:
        """Views of an observation."""
        return len(CAMERAS)

    @property
    def head_config(self) -> HeadConfig:
        """The head's config."""
        return HeadConfig.from_dict(self.head)

    @property
    def backbone_sizes(self) -> BackboneSizes:
        """The backbone's sizes."""
        return BackboneSizes.from_config({**self.backbone, "kind": f"{self.version} backbone"})

    @property
    def normalizer(self) -> Normalizer:
        """What the policy's states and actions are normalised by, as found in its files."""
        with tempfile.TemporaryDirectory() as folder:
            self.write(Path(folder))
            return Normalizer.from_pretrained(
                Path(folder), EMBODIMENT, state_dim=STATE_DIM, action_dim=ACTION_DIM
            )

    def processor(self) -> Processor:
        """What prepares images and instruction, as found by :meth:`saccade.Policy.from_pretrained`."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / TOKENIZER_FILE
            write_json(path, self._tokenizer())
            if self.version == "n1.7":
                options = {
                    **self._processor_options(),
                    "use_albumentations": True,
                    "min_pixels": self.view_size**2,
                }
                return Processor("n1.7", path, preprocessing="isaac", options=options)
            return Processor(
                "n1.5",
                path,
                preprocessing="isaac",
                image_size=self.view_size,
                tokens_per_view=(self.view_size // (2 * PATCH_SIZE)) ** 2,
            )

    def to_dict(self) -> dict[str, Any]:
        """The content of ``config.json``."""
        if self.version == "n1.7":
            inner = eagle_config(self.version, self.backbone)
            return {
                **self.head,
                "architectures": ["Gr00tN1d7"],
                "backbone_model_type": "qwen",
                "select_layer": self.backbone["select_layer"],
                "use_relative_action": False,
                "backbone_cfg": {"select_layer": self.backbone["select_layer"], "eagle_config": inner},
            }
        return n15_config(self.head, self.backbone)

    def metadata(self) -> dict[str, Any]:
        """Statistics by embodiment and kind; with N1.5 the content of ``experiment_cfg/metadata.json``."""
        if self.version == "n1.7":
            return {EMBODIMENT: {**self.statistics, "relative_action": {}}}
        size = {"resolution": [self.frame_size] * 2, "channels": 3, "fps": float(CONTROL_HZ)}
        groups = {"state": STATE_GROUPS, "action": ACTION_GROUPS}
        return metadata(EMBODIMENT, self.statistics, groups, dict.fromkeys(CAMERAS, size))

    def write(self, folder: Path) -> None:
        """Writes all files of the policy except its weights."""
        write_json(folder / TOKENIZER_FILE, self._tokenizer())
        write_json(folder / CONFIG_FILE, self.to_dict())
        if self.version == "n1.7":
            write_json(folder / STATISTICS_FILE, self.metadata())
            write_json(folder / IDS_FILE, {EMBODIMENT: EMBODIMENT_ID})
            write_json(folder / PROCESSOR_FILE, self._processor_config())
            # The released processor enlarges frames to an area of 256 x 256 pixels where no file says less.
            write_json(folder / PIXELS_FILE, {"min_pixels": self.view_size**2})
            return
        (folder / METADATA_FILE).parent.mkdir(parents=True, exist_ok=True)
        write_json(folder / METADATA_FILE, self.metadata())
        write_json(folder / DATA_CONFIG_FILE, self._data_config())

    def _tokenizer(self) -> dict[str, Any]:
        return tokenizer(published_ids=False, words=vocabulary(self.said))

    def _processor_options(self) -> dict[str, Any]:
        """What ``processor_config.json`` says of images and words."""
        return {
            "crop_fraction": CROP_SHARE,
            "formalize_language": True,
            "letter_box_transform": False,
            "shortest_image_edge": self.view_size,
        }

    def _processor_config(self) -> dict[str, Any]:
        """The content of ``processor_config.json``."""
        steps = list(range(self.head["action_horizon"]))
        keys: dict[str, tuple[Sequence[str], list[int]]] = {
            "video": (CAMERAS, [0]),
            "state": (list(STATE_GROUPS), [0]),
            "action": (list(ACTION_GROUPS), steps),
            "language": ([LANGUAGE_KEY], [0]),
        }
        modalities = {
            kind: {"delta_indices": indices, "modality_keys": list(names)}
            for kind, (names, indices) in keys.items()
        }
        return {
            "processor_class": "Gr00tN1d7Processor",
            "processor_kwargs": {
                **self._processor_options(),
                "clip_outliers": True,
                "max_action_dim": ACTION_DIM,
                "max_action_horizon": len(steps),
                "max_state_dim": STATE_DIM,
                "modality_configs": {EMBODIMENT: modalities},
                "use_albumentations": True,
                "use_percentiles": False,
                "use_relative_action": False,
            },
        }

    def _data_config(self) -> dict[str, Any]:
        """The content of ``experiment_cfg/data_config.json``: groups and cameras, scaled by their bounds."""
        state = [f"state.{name}" for name in STATE_GROUPS]
        action = [f"action.{name}" for name in ACTION_GROUPS]
        return {
            "video_keys": [f"video.{name}" for name in CAMERAS],
            "state_keys": state,
            "action_keys": action,
            "language_keys": [LANGUAGE_KEY],
            "observation_indices": [0],
            "action_indices": list(range(self.head["action_horizon"])),
            "state_modes": dict.fromkeys(state, "min_max"),
            "action_modes": dict.fromkeys(action, "min_max"),
            "target_rotations": {},
        }


def recorded_statistics(state: Float32Array, action: Float32Array) -> dict[str, Any]:
    """Statistics of ``(n, 8)`` states and ``(n, 7)`` actions, by group."""
    return {
        "state": statistics_of(state, STATE_GROUPS),
        "action": statistics_of(action, ACTION_GROUPS),
    }


def policy_actions(actions: Float32Array) -> Float32Array:
    """Actions of the environment ``(..., 7)`` as a policy is trained on them: a gripper of 1 is open.

    Example:
        >>> policy_actions(np.float32([[0, 0, 0, 0, 0, 0, -1]]))[0, -1]
        np.float32(1.0)
    """
    changed = actions.copy()
    changed[..., -1] = 0.5 - 0.5 * actions[..., -1]
    return changed
