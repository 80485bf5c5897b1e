"""What lerobot's groot policy does with the embodiment ``libero_sim`` of N1.7, and with no other.

It turns the gripper's number g, 1 for open, as LIBERO takes it, ``-sign(2 g - 1)``, and executes 8 actions of
a chunk at most.
"""

from __future__ import annotations

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.robots.robot import Robot

#: The embodiment's tag, and how many actions of a chunk are executed.
TAG, EXECUTED_STEPS = "libero_sim", 8
#: lerobot's groot policies know this camera by two names.
CAMERA_ALIASES = {"wrist_image": "image2"}


def gripper_command(opening: Float32Array) -> Float32Array:
    """The gripper as LIBERO takes it, -1 opens and 1 closes, from NVIDIA's, where 1 is open and 0 closed."""
    return -np.sign(2 * opening - 1)


def is_isaac_libero(robot: Robot, version: str) -> bool:
    """Whether a checkpoint is of that embodiment in Isaac-GR00T's layout of N1.7.

    A checkpoint that lerobot saved says itself what is done.

    Args:
        robot: The checkpoint's robot.
        version: Version of its head, such as ``"n1.7"``.
    """
    return robot.pipeline is None and version == "n1.7" and robot.embodiment == TAG
