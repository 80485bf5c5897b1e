"""The robot of LIBERO in numbers: its state, its actions, and how often it is controlled."""

from __future__ import annotations

POSE = {"x": 1, "y": 1, "z": 1, "roll": 1, "pitch": 1, "yaw": 1}
#: Position of the hand, its rotation vector (under Isaac-GR00T's names), the two fingers.
STATE_GROUPS = {**POSE, "gripper": 2}
#: In the environment's order: a step of the hand in the world's axes, a rotation vector, and the gripper.
ACTION_GROUPS = {**POSE, "gripper": 1}
STATE_DIM, ACTION_DIM = sum(STATE_GROUPS.values()), sum(ACTION_GROUPS.values())
CONTROL_HZ = 20
