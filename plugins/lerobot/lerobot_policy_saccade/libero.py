"""What lerobot does with an N1.7 checkpoint in Isaac-GR00T's layout for LIBERO's simulated robot.

Its GR00T policy turns the gripper's number as LIBERO takes it, executes 8 of 16 actions, and knows the wrist
camera by the name that lerobot's data sets and its environment have for it.
"""

from dataclasses import replace

import saccade
from saccade.robots.libero import CAMERA_ALIASES, TAG, is_isaac_libero


def is_libero(policy: saccade.Policy) -> bool:
    """Whether a policy is such a checkpoint; one that lerobot saved says itself what is done."""
    return is_isaac_libero(policy.normalizer, policy.head.config.version)


def as_in_lerobot(policy: saccade.Policy) -> saccade.Policy:
    """The policy with lerobot's gripper, -1 opens and 1 closes, and its camera's name; others as they are.

    Raises:
        saccade.InputError: The action has no gripper of one number.
    """
    if not is_libero(policy):
        return policy
    normalizer, needs = policy.normalizer, policy.requirements
    where = normalizer.action_slices.get("gripper", slice(0, 0))
    if where.stop - where.start != 1:
        keys = ", ".join(f"{group.key} ({group.size})" for group in normalizer.action_groups)
        raise saccade.InputError(f"action: expected a gripper of one number for {TAG}, got {keys}")
    cameras = needs.cameras and tuple(
        replace(camera, alias=CAMERA_ALIASES.get(camera.name, camera.alias)) for camera in needs.cameras
    )
    return saccade.Policy(
        policy.head,
        replace(normalizer, gripper=where.start),
        backbone=policy.backbone,
        processor=policy.processor,
        requirements=replace(needs, cameras=cameras),
    )
