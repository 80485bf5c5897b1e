"""Grasps that miss, for demonstrations that begin after one; NumPy only.

A policy that was trained on demonstrations without misses has never seen a closed hand that is empty: when it
misses, it carries nothing to the goal, and stays there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade_lab.libero.expert import Expert, Situation, Technique, Vector, World
from saccade_lab.libero.grasps import Points
from saccade_lab.sim.scenarios import StepOutcome

DISTANCES = (0.02, 0.07)  # metres from the object to where the hand takes hold, in the plane
HEIGHTS = (0.0, 0.03)  # metres, above
STEPS = (20, 130)  # control steps of the miss; the expert needs 80 to 210 for the whole task
HOLDING = ("lift", "carry", "lower")  # phases of the expert in which the object should be in the hand


class Imagined:
    """A world whose target seems to be elsewhere, and to move with the hand once it was taken.

    Args:
        world: The world as it is.
        away: ``(3,)`` metres from the target to where it seems to be.

    Attributes:
        held: Whether the target seems to be in the hand.
    """

    def __init__(self, world: World, away: Vector) -> None:
        seen = world.situation()
        self._world = world
        self._hand, self._body, self._target = seen.hand, seen.body + away, seen.target + away
        self.held = False

    def situation(self) -> Situation:
        """See ``World``."""
        seen = self._world.situation()
        if self.held:
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
    """Lets an expert that misses act for a random number of control steps.

    They end anywhere between the way to the object and after nothing was put down. Whoever goes on from
    there finds the hand open or closed at a place where demonstrations from the start never have it, and
    sometimes the object pushed or toppled.

    Args:
        world: The simulation that it acts in.
        technique: How it would take the object.
        advance: Executes an action.
        rng: Draws where it takes hold, and for how long it acts.

    Returns:
        Whether it missed. By accident the task may be done, where a small distance was drawn.
    """
    angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(*DISTANCES)
    away = np.array([distance * np.cos(angle), distance * np.sin(angle), rng.uniform(*HEIGHTS)])
    imagined = Imagined(world, away)
    expert = Expert(imagined, technique)
    for _ in range(rng.integers(*STEPS)):
        if advance(expert.action()).success:
            return False
        imagined.held = expert.phase in HOLDING
    return True
