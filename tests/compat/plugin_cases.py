"""A checkpoint of saccade's simulated robot, and what lerobot gives its policy, for the tests of the plugin.

The checkpoint is small and random, with the cameras, the state and the actions of that robot.
"""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call"

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from lerobot_policy_saccade import SaccadeConfig
from lerobot_policy_saccade.modeling_saccade import SaccadePolicy
from saccade_lab import random_checkpoint
from saccade_lab.sim.cameras import DEFAULT_IMAGE_SIZE

VIEWS = ("left", "right", "top")
HORIZON, WIDTH = 16, 4
TEXTS = ["reach the red ball", "push", "open the drawer slowly"]


def random_policy(folder: Path, views: Sequence[str], size: int) -> Path:
    """A random checkpoint of the simulated robot: its hand in place of the arm, and these cameras."""
    random_checkpoint.write(
        folder,
        backbone=random_checkpoint.small_backbone("n1.5"),
        head=random_checkpoint.small_head("n1.5"),
    )
    path = folder / "experiment_cfg" / "metadata.json"
    metadata = json.loads(path.read_text())
    robot = metadata["new_embodiment"]
    view = {"resolution": [size, size], "channels": 3, "fps": 80.0}
    robot["modalities"]["video"] = dict.fromkeys(views, view)
    for kind in ("state", "action"):
        for part in (robot["statistics"], robot["modalities"]):
            part[kind] = {"hand": part[kind].pop("single_arm"), **part[kind]}
        hand = robot["statistics"][kind]["hand"]
        robot["statistics"][kind]["hand"] = {name: values[:3] for name, values in hand.items()}
        robot["modalities"][kind]["hand"]["shape"] = [3]
    path.write_text(json.dumps(metadata))
    (folder / "optimizer.pt").write_bytes(b"large")
    return folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_policy(tmp_path_factory.mktemp("whole") / "checkpoint", VIEWS, DEFAULT_IMAGE_SIZE)


@pytest.fixture(scope="module")
def policy(checkpoint: Path) -> SaccadePolicy:
    return SaccadePolicy(SaccadeConfig(checkpoint=str(checkpoint), num_threads=1, seed=7))


@pytest.fixture
def batch() -> dict[str, Any]:
    """Three observations as lerobot's processors give them."""
    shape = (len(VIEWS), 3, 3, DEFAULT_IMAGE_SIZE, DEFAULT_IMAGE_SIZE)
    frames = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    images = {
        f"observation.images.{name}": torch.from_numpy(seen).float() / 255
        for name, seen in zip(VIEWS, frames, strict=True)
    }
    state = torch.linspace(0, 0.5, 3 * WIDTH).reshape(3, WIDTH)
    return {**images, "observation.state": state, "task": TEXTS, "action": None, "next.reward": 0.0}


def plain(batch: dict[str, Any]) -> dict[str, Any]:
    """The same observations in Isaac-GR00T's form, with the pixels as bytes."""
    video = {
        name: (batch[f"observation.images.{name}"] * 255).byte().movedim(1, -1).numpy()[:, None]
        for name in VIEWS
    }
    state = batch["observation.state"].numpy()[:, None]
    return {
        "video": video,
        "state": {"hand": state[..., :3], "gripper": state[..., 3:]},
        "language": {"annotation.human.task_description": [[text] for text in batch["task"]]},
    }


def joined(answer: dict[str, Any]) -> np.ndarray[Any, Any]:
    return np.concatenate([answer["hand"], answer["gripper"]], -1)
