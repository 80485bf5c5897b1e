"""Grasps that miss, for demonstrations that begin after one; NumPy only.

In demonstrations without them a closed hand always holds the object. A policy that was trained on these, and
misses, carries nothing to the goal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade_lab.libero.expert import CLOSE, Expert, Situation, Technique, Vector, World
from saccade_lab.libero.grasps import Points
from saccade_lab.sim.scenarios import StepOutcome

MISS_SHARE = 1 / 3  # of the demonstrations
DISTANCES = (0.03, 0.07)  # metres from the object to where the hand takes hold, in the plane
HEIGHTS = (0.0, 0.03)  # metres, above
STEPS = (20, 131)  # control steps of a miss, the second excluded; a whole task without one takes 80 to 210
UNDECIDED = ("close", "lift")  # phases in which the object may be between the fingers, and still on the floor
LIFTED = 0.01  # metres that the object has risen, if it was grasped


class Imagined:
    """A world whose target seems to be elsewhere, and to be in the hand once that has closed.

    Args:
        world: The world as it is.
        away: ``(3,)`` metres from the target to where it seems to be.
    """

    def __init__(self, world: World, away: Vector) -> None:
        seen = world.situation()
        self._world = world
        self._hand, self._body, self._target = seen.hand, seen.body + away, seen.target + away
        self._closed = False

    def command(self, grip: float) -> None:
        """Says what the gripper is told: ``OPEN`` or ``CLOSE``."""
        self._closed = grip == CLOSE

    def situation(self) -> Situation:
        """See ``World``."""
        seen = self._world.situation()
        if self._closed:
            moved = seen.hand - self._hand
            self._body, self._target = self._body + moved, self._target + moved
        self._hand = seen.hand
        return replace(seen, body=self._body, target=self._target)

    def neighbours(self, above: float) -> Points:
        """See ``World``."""
        return self._world.neighbours(above)

    def obstacles(self) -> Points:
        """See ``World``."""
        return self._world.obstacles()


def miss(
    world: World,
    technique: Technique,
    advance: Callable[[Float32Array], StepOutcome],
    rng: np.random.Generator,
) -> bool:
    """Executes a grasp beside the object, and what would follow, for a random number of steps.

    It ends on the way to the object, while an empty hand is carried to the goal, or after that has opened.
    The object may have been pushed or toppled.

    Args:
        world: The simulation.
        technique: How the object would be taken.
        advance: Executes an action.
        rng: Draws where the hand closes, and the number of steps.

    Returns:
        Whether the object was missed. Otherwise it was grasped after all, and no demonstration should begin
        here: its first action would be to let go.
    """
    angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*DISTANCES)
    away = np.array([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(*HEIGHTS)])
    lowest = world.situation().target[:, 2].min()
    imagined = Imagined(world, away)
    expert = Expert(imagined, technique)
    steps = rng.integers(*STEPS)
    while steps > 0 or expert.phase in UNDECIDED:
        action = expert.action()
        if advance(action).success:
            return False
        imagined.command(float(action[-1]))
        steps -= 1
    return bool(world.situation().target[:, 2].min() < lowest + LIFTED)
