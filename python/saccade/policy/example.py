"""An observation that a policy accepts, to try it."""

from __future__ import annotations

from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.observations import Camera, Requirements
from saccade.robots import LANGUAGE_KEY, Group, Normalizer
from saccade.robots.rotations import POSES, from_matrix

#: Size of the frames of a camera whose size is not known.
SIDE = 256

INSTRUCTION = "pick up the red block"

#: The camera of a checkpoint that names none.
CAMERA = "front"


def example_observation(needs: Requirements, normalizer: Normalizer, seed: int) -> dict[str, Any]:
    """See :meth:`saccade.Policy.example_observation`."""
    rng = np.random.default_rng(seed)
    cameras = needs.cameras or (Camera(CAMERA),)
    horizon = needs.video_horizon or 1
    video = {
        camera.name: rng.integers(
            0, 256, (1, horizon, camera.height or SIDE, camera.width or SIDE, 3), np.uint8
        )
        for camera in cameras
    }
    poses = {
        group.reference.key: group.reference.pose
        for group in normalizer.action_groups
        if group.reference is not None and group.reference.pose is not None
    }
    state = {
        group.key: np.tile(_middle(group, poses.get(group.key)), (1, needs.state_history, 1))
        for group in normalizer.state_groups
    }
    return {
        "video": video,
        "state": state,
        "language": {key: [[INSTRUCTION]] for key in needs.language_keys or (LANGUAGE_KEY,)},
    }


def _middle(group: Group, pose: str | None) -> Float32Array:
    """The middle of the range of a part of the state, ``(size,)``, or of a pose; rotations are of nothing."""
    if group.conversion is not None:
        return from_matrix(np.eye(3), group.conversion.robot).astype(np.float32)
    if pose is not None:
        rotation = from_matrix(np.eye(3), POSES[pose][1])
        return np.concatenate([_middle(group, None)[:3], rotation]).astype(np.float32)
    if group.first is None or group.second is None:
        return np.zeros(group.size, np.float32)
    middle = group.first if group.mode == "mean_std" else (group.first + group.second) / 2
    return np.broadcast_to(middle, (group.size,)).astype(np.float32)
