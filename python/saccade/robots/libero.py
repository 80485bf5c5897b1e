"""What lerobot's groot policy does with the embodiment ``libero_sim`` of N1.7, and with no other.

It turns the gripper's number g, 1 for open, as LIBERO takes it, ``-sign(2 g - 1)``, and executes 8 actions of
a chunk at most.
"""

from __future__ import annotations

from saccade.robots.robot import Robot

#: The embodiment's tag, and how many actions of a chunk are executed.
TAG, EXECUTED_STEPS = "libero_sim", 8


def is_isaac_libero(robot: Robot, version: str) -> bool:
    """Whether a checkpoint is of that embodiment in Isaac-GR00T's layout of N1.7.

    A checkpoint that lerobot saved says itself what is done.

    Args:
        robot: The checkpoint's robot.
        version: Version of its head, such as ``"n1.7"``.
    """
    return robot.pipeline is None and version == "n1.7" and robot.embodiment == TAG
