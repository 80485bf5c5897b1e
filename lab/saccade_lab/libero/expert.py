"""A scripted expert that puts an object somewhere, from the full state of the simulation; NumPy only.

It moves the hand above the object, down, closes the gripper, lifts, carries, lowers, opens and retreats, with
the actions of LIBERO's controller. If it loses the object, it begins again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade_lab.libero.grasps import Grasp, Points, fingertip_height, plan_grasp, plan_rim_grasp

Vector = npt.NDArray[np.float64]

OPEN, CLOSE = -1.0, 1.0  # the last number of an action
GAIN = 20.0  # of an action for each metre that is missing; the controller moves 5 cm for an action of 1
TURN_GAIN = 2.0  # of an action for each radian; 0.5 radians for an action of 1
ABOVE = 0.08  # metres between the hand and the top of the object before it goes down
OVER_GOAL = 0.05  # metres between what it carries and the highest point of the goal
LOST = 0.15  # metres between the hand and the object that it should hold
RISE = np.array([0, 0, 0.02])  # metres, when it has lost the object
RETREAT = np.array([0, 0, 0.12])  # metres, after it has let go
TOPPLED = 0.01  # metres that the object's highest point has moved since the grasp was planned
# Control steps after which a phase ends, whatever has happened.
LIMITS = {
    "above": 60,
    "down": 40,
    "close": 12,
    "lift": 40,
    "carry": 70,
    "lower": 40,
    "open": 8,
    "retreat": 15,
}


@dataclass(frozen=True)
class Situation:
    """What the expert sees before a control step. Metres, in the frame of the world.

    Attributes:
        hand: ``(3,)``, the point between the fingertips.
        rotation: ``(3, 3)``, the axes of the hand as columns.
        body: ``(3,)``, the origin of the target.
        target: ``(n, 3)``, points that span the target.
        goal: ``(m, 3)``, points that span what the target is put into or onto.
    """

    hand: Vector
    rotation: npt.NDArray[np.float64]
    body: Vector
    target: Points
    goal: Points


class World(Protocol):
    """Where a situation comes from."""

    def situation(self) -> Situation:
        """The current situation."""
        ...

    def neighbours(self, above: float) -> Points:
        """The ground plan ``(m, 2)`` of the other objects that are higher than ``above``, metres."""
        ...

    def obstacles(self) -> Points:
        """Points ``(m, 3)`` of the other objects and of the furniture, metres."""
        ...


@dataclass(frozen=True)
class Technique:
    """How an object is taken, and where it is let go.

    Attributes:
        grasp: Plans how it is taken.
        release: Metres from the highest point of the goal up to the lowest one of the object when it is let
            go.
    """

    grasp: Callable[[Situation, World], Grasp]
    release: float


def grasp_middle(seen: Situation, world: World) -> Grasp:
    """Takes an object that is narrower than the gripper opens."""
    return plan_grasp(seen.target, world.neighbours(fingertip_height(seen.target) - 0.005))


def grasp_rim(seen: Situation, world: World) -> Grasp:
    """Takes a bowl."""
    return plan_rim_grasp(seen.target, world.obstacles(), seen.hand)


INTO_BASKET = Technique(grasp_middle, release=-0.03)
ONTO_PLATE = Technique(grasp_rim, release=0.004)


class Expert:
    """The expert of one episode.

    Args:
        world: The simulation that it acts in.
        technique: How it takes its target and lets go of it.

    Attributes:
        phase: What it is doing, a key of ``LIMITS``.
    """

    _hand: Vector  # where the hand was one step ago

    def __init__(self, world: World, technique: Technique) -> None:
        self._world, self._technique = world, technique
        seen = world.situation()
        self._down = downward(seen.rotation)
        self._held_at = seen.hand  # where it closed or opened the gripper last
        self._start(seen)

    def action(self) -> Float32Array:
        """Its action in the current state, ``(7,)`` in [-1, 1]; see ``LiberoEnvironment``."""
        seen = self._world.situation()
        speed = float(np.linalg.norm(seen.hand - self._hand))
        self._hand = seen.hand
        self._steps += 1
        turn = rotation_vector(about_z(self._grasp.yaw) @ self._down @ seen.rotation.T)
        goal, grip = self._move(seen, speed, float(np.linalg.norm(turn)))
        motion = np.concatenate((GAIN * (goal - seen.hand), TURN_GAIN * turn))
        return np.concatenate((np.clip(motion, -1, 1), [grip])).astype(np.float32)

    def begin_again(self) -> None:
        """Begins again from the current state; the hand's turns count from where they did before."""
        self._start(self._world.situation())

    def _start(self, seen: Situation) -> None:
        self._hand = seen.hand
        self._begin("above")
        self._plan(seen)

    def _begin(self, phase: str) -> None:
        self.phase, self._steps = phase, 0

    def _plan(self, seen: Situation) -> None:
        self._grasp = self._technique.grasp(seen, self._world)
        self._offset = self._grasp.xy - seen.body[:2]  # from the object's origin to the hand

    def _move(self, seen: Situation, speed: float, turn: float) -> tuple[Vector, float]:
        """Where the hand should be, ``(3,)``, and what the gripper should do; the phase may change."""
        hand, grasp = seen.hand, self._grasp
        summit = float(seen.goal[:, 2].max())
        over = max(summit + grasp.hang + OVER_GOAL, grasp.top + ABOVE)
        late = self._steps > LIMITS[self.phase]
        if self.phase in ("above", "down") and abs(seen.target[:, 2].max() - grasp.top) > TOPPLED:
            self._start(seen)
            return hand, OPEN
        if self.phase == "above":
            goal = np.append(seen.body[:2] + self._offset, grasp.top + ABOVE)
            away = goal - hand
            arrived = np.linalg.norm(away[:2]) < 0.008 and abs(away[2]) < 0.03
            if (arrived and turn < 0.08 and speed < 0.006) or late:
                self._xy = goal[:2]
                self._begin("down")
            return goal, OPEN
        if self.phase == "down":
            beside = float(np.linalg.norm(self._xy - hand[:2]))
            goal = np.append(self._xy, grasp.z if beside < 0.015 else max(grasp.z, hand[2] - 0.005))
            if (abs(goal[2] - hand[2]) < 0.006 and beside < 0.012) or late:
                self._begin("close")
            return goal, OPEN
        if self.phase == "close":
            if late:
                self._held_at = hand
                self._begin("lift")
            return np.append(self._xy, grasp.z), CLOSE
        if self.phase == "lift":
            if hand[2] > over - 0.01 or late:
                self._offset = hand[:2] - seen.body[:2]
                self._begin("carry")
            return np.append(self._held_at[:2], over + 0.02), CLOSE
        if self.phase in ("carry", "lower") and np.linalg.norm(hand - seen.body) > LOST:
            self._start(seen)
            return hand + RISE, OPEN
        middle = 0.5 * (seen.goal.min(axis=0) + seen.goal.max(axis=0))[:2]
        if self.phase in ("carry", "lower"):  # the object may turn in the hand
            self._offset = 0.8 * self._offset + 0.2 * (hand[:2] - seen.body[:2])
        if self.phase == "carry":
            goal = np.append(middle + self._offset, over)
            if np.linalg.norm((goal - hand)[:2]) < 0.012 or late:
                self._begin("lower")
            return goal, CLOSE
        if self.phase == "lower":
            low = hand[2] - (float(seen.target[:, 2].min()) - summit) + self._technique.release
            if hand[2] - low < 0.008 or late:
                self._held_at = hand
                self._begin("open")
            return np.append(middle + self._offset, low), CLOSE
        if self.phase == "open":
            if late:
                self._begin("retreat")
            return self._held_at, OPEN
        if late:  # it has let go, and the task is not done
            self._start(seen)
        return self._held_at + RETREAT, OPEN


def downward(rotation: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The rotation ``(3, 3)`` of a hand that points straight down, the nearer of two at right angles."""
    if abs(rotation[1, 0]) > abs(rotation[0, 0]):
        return np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return np.diag([1.0, -1, -1])


def about_z(angle: float) -> npt.NDArray[np.float64]:
    """The rotation ``(3, 3)`` by an angle in radians about the vertical axis."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def rotation_vector(rotation: npt.NDArray[np.float64]) -> Vector:
    """Axis times angle in radians, ``(3,)``, of a rotation ``(3, 3)``; the angle is at most pi.

    Example:
        >>> rotation_vector(about_z(0.5)).round(6).tolist()
        [0.0, 0.0, 0.5]
    """
    # The unit quaternion whose entry of largest magnitude is positive, which is exact also near pi.
    m = rotation
    trace = float(np.trace(m))
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
            [0, 0, m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
            [0, 0, 0, trace],
        ]
    )
    _, vectors = np.linalg.eigh(k, UPLO="U")
    x, y, z, w = vectors[:, -1]
    xyz = np.array([x, y, z]) * (-1.0 if w < 0 else 1.0)
    length = float(np.linalg.norm(xyz))
    if length == 0:
        return np.zeros(3)
    return np.asarray(xyz / length * 2 * np.arctan2(length, abs(w)))
