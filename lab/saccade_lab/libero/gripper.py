"""What the gripper's number of a checkpoint means: by the released program, or by the statistics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from saccade import Policy
from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.robots.groups import Group
from saccade.robots.libero import TAG, gripper_command, is_isaac_libero
from saccade_lab.libero.protocols import AS_GIVEN, OPEN_IS_ONE, Protocol

#: How far bounds of statistics may be from the two known ranges.
TOLERANCE = 1e-3
#: The ranges of statistics, and what they say.
RANGES = {(0.0, 1.0): OPEN_IS_ONE, (-1.0, 1.0): AS_GIVEN}
#: Embodiments of checkpoints for LIBERO in Isaac-GR00T's layouts: only theirs are these ranges known to mean
#: that. Published N1.5 checkpoints have N1.5's tag for any robot.
EMBODIMENTS = {"n1.5": ("new_embodiment", TAG), "n1.6": ("libero_panda",), "n1.7": (TAG,)}


@dataclass(frozen=True)
class GripperRule:
    """What is done with the last number of an action, and why.

    Attributes:
        rule: ``"as given"``, or ``"-sign(2 g - 1)"`` for a number from 0, closed, to 1, open.
        reason: Where the rule comes from, a sentence's part.

    Example:
        >>> rule = GripperRule("-sign(2 g - 1)", "the released client has it")
        >>> rule.applied(np.array([[0, 0, 0, 0, 0, 0, 0.9]], np.float32))[0, -1]
        np.float32(-1.0)
    """

    rule: str
    reason: str

    def applied(self, actions: Float32Array) -> Float32Array:
        """Actions ``(steps, 7)`` float32 as the environment takes them: -1 opens, 1 closes."""
        if self.rule == AS_GIVEN:
            return actions
        found = actions.copy()
        found[:, -1] = gripper_command(found[:, -1])
        return found


def gripper_rule(policy: Policy, protocol: Protocol, *, by_statistics: bool) -> GripperRule:
    """The rule of a policy under a protocol.

    Args:
        policy: The policy; the last number of its action is the gripper's.
        protocol: The protocol.
        by_statistics: Whether the statistics decide, as for ``--protocol auto``. Otherwise the rule is what
            the protocol's program does, whatever they are.

    Raises:
        InputError: The statistics are to decide, and are neither from 0 to 1 nor from -1 to 1; or the
            embodiment is none that is known for LIBERO; or they contradict what lerobot does with a
            checkpoint that it saved.
    """
    normalizer, version = policy.normalizer, policy.head.config.version
    last = next((group for group in normalizer.action_groups if group.key == "gripper"), None)
    last = last or normalizer.action_groups[-1]  # lerobot's one group of all numbers
    said = _said(last)
    bounds = None if last.mode == "binary" else _bounds(last)
    shown = "binary statistics" if last.mode == "binary" else f"statistics {_shown(bounds)}"
    by_name = f"pass --protocol {protocol.name} to do what its program does"
    if normalizer.pipeline is not None:
        done = AS_GIVEN if normalizer.gripper is None else OPEN_IS_ONE
        reason = f"lerobot's steps in the checkpoint did it, {done}, as its config.json says"
        if said not in (None, done):
            if by_statistics:
                raise InputError(
                    f"--protocol auto: the gripper is {done} by the checkpoint's config.json, but its "
                    f"{shown} say {said}: {by_name}"
                )
            reason += f"; the checkpoint's {shown} say {said}"
        return GripperRule(AS_GIVEN, reason)  # nothing is left to do
    if by_statistics:
        known = EMBODIMENTS.get(version, ())
        if normalizer.embodiment not in known:
            raise InputError(
                f"--protocol auto: what the gripper's number means is known for the embodiments "
                f"{', '.join(known)} of {version}, got {normalizer.embodiment}: {by_name}"
            )
        if said is None:
            raise InputError(
                f"--protocol auto: action.{last.key}: expected statistics of the gripper from 0 to 1 (1 is "
                f"open) or from -1 to 1 (1 closes), got {shown} ({last.mode}): {by_name}"
            )
        return GripperRule(said, f"the checkpoint's {shown}")
    if not protocol.lerobot_form:
        rule, reason = protocol.gripper, "the program does it with every checkpoint"
    elif is_isaac_libero(normalizer, version):
        rule, reason = OPEN_IS_ONE, f"lerobot does it for the embodiment {TAG}"
    else:
        rule, reason = protocol.gripper, "lerobot passes on what the checkpoint gives"
    doubt = "" if said in (None, rule) else f"; the checkpoint's {shown} say {said}"
    return GripperRule(rule, reason + doubt)


def _said(group: Group) -> str | None:
    """What the statistics of the gripper say, or None."""
    if group.mode == "binary":
        return OPEN_IS_ONE
    found = _bounds(group)
    if found is None:
        return None
    for known, rule in RANGES.items():
        if np.allclose(found, known, rtol=0, atol=TOLERANCE):
            return rule
    return None


def _bounds(group: Group) -> tuple[float, float] | None:
    """The bounds of the gripper's number, or None if the statistics have none."""
    if group.mode not in ("min_max", "q99") or group.first is None or group.second is None:
        return None
    # With a row for each step of a chunk, those of all steps.
    return float(np.min(group.first[..., -1])), float(np.max(group.second[..., -1]))


def _shown(bounds: tuple[float, float] | None) -> str:
    return "without bounds" if bounds is None else f"from {bounds[0]:g} to {bounds[1]:g}"
