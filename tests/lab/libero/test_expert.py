"""The expert in a toy world of points, and its rotations against scipy's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from saccade._internal.arrays import Float32Array
from saccade_lab.libero.expert import (
    CLOSE,
    INTO_BASKET,
    LIMITS,
    ONTO_PLATE,
    Expert,
    Situation,
    Vector,
    downward,
    rotation_vector,
)
from saccade_lab.libero.grasps import Points
from saccade_lab.libero.misses import STEPS, miss
from saccade_lab.sim.scenarios import StepOutcome
from tests.helpers.paths import ROOT

STEP, TURN = 0.05, 0.5  # of the controller for an action of 1
BOX = np.stack(np.meshgrid(*3 * [[-0.5, 0.5]], indexing="ij"), axis=-1).reshape(-1, 3)
DOWN = np.diag([1.0, -1, -1])


class Toy:
    """A hand that goes where it is told, a box that it can hold, and a basket."""

    def __init__(self, at: tuple[float, float], slips: int = 0) -> None:
        self.hand, self.turned = np.array([-0.1, 0.0, 0.4]), DOWN.copy()
        self.size = np.array([0.08, 0.04, 0.1])
        self.body = np.array([*at, 0.05])
        self.basket = np.array([0.0, 0.26, 0.05])
        self.slips = slips  # how often the box is lost while it is carried
        self.held = False

    def situation(self) -> Situation:
        goal = self.basket + BOX * [0.2, 0.2, 0.1]
        return Situation(
            self.hand.copy(), self.turned.copy(), self.body.copy(), self.body + BOX * self.size, goal
        )

    def neighbours(self, above: float) -> Points:
        return np.zeros((0, 2))

    def obstacles(self) -> Points:
        return np.zeros((0, 3))

    def step(self, action: Float32Array) -> None:
        assert action.shape == (7,)
        assert action.dtype == np.float32
        assert np.abs(action).max() <= 1
        shift = 0.3 * STEP * action[:3].astype(float)
        self.turned = Rotation.from_rotvec(0.3 * TURN * action[3:6]).as_matrix() @ self.turned
        closed = action[6] > 0
        if closed and not self.held:
            self.held = self.is_near()
        self.held = self.held and closed
        if self.held and self.hand[1] > 0.1 and self.slips:
            self.slips -= 1
            self.held = False
            self.body[:2] -= [0.0, 0.2]
        if self.held:
            self.body += shift
        self.hand += shift
        if not self.held:
            self.body[2] = 0.05

    def is_near(self) -> bool:
        return bool((np.abs(self.hand - self.body) < [0.03, 0.03, 0.06]).all())

    def solved(self) -> bool:
        return bool((np.abs(self.body - self.basket)[:2] < 0.05).all()) and not self.held


class ToyBowl(Toy):
    """A bowl that is wider than the gripper opens, and a plate."""

    def __init__(self, at: tuple[float, float]) -> None:
        super().__init__(at)
        self.let_go = np.inf  # height above the plate

    def situation(self) -> Situation:
        seen = super().situation()
        plate = self.basket * [1, 1, 0] + BOX * [0.14, 0.14, 0.02] + [0, 0, 0.01]
        angles = np.linspace(0, 2 * np.pi, 24)
        circle = 0.05 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        bowl = np.concatenate([np.insert(circle, 2, z, axis=1) for z in (-0.025, 0.025)])
        return replace(seen, target=self.body + bowl, goal=plate)

    def step(self, action: Float32Array) -> None:
        was_held, lowest = self.held, self.body[2] - 0.025
        super().step(action)
        if was_held and not self.held:
            self.let_go = lowest - 0.02

    def is_near(self) -> bool:
        away = np.abs(self.hand - self.body)
        rim = away[:2].max()
        return bool(0.03 < rim < 0.06 and away[2] < 0.03)


@pytest.mark.parametrize("at", [(-0.12, -0.24), (0.15, 0.03)])
def test_it_puts_the_bowl_onto_the_plate(at: tuple[float, float]) -> None:
    world = ToyBowl(at)
    expert = Expert(world, ONTO_PLATE)
    for _ in range(300):
        world.step(expert.action())
        if expert.phase == "retreat":
            break
    assert world.solved()
    assert 0 < world.let_go < 0.015  # metres


@pytest.mark.parametrize("at", [(-0.12, -0.24), (0.15, 0.03), (-0.2, -0.1)])
@pytest.mark.parametrize("slips", [0, 1])
def test_it_puts_the_box_into_the_basket(at: tuple[float, float], slips: int) -> None:
    world = Toy(at, slips)
    expert = Expert(world, INTO_BASKET)
    phases = [expert.phase]
    for _ in range(400):
        world.step(expert.action())
        if expert.phase != phases[-1]:
            phases.append(expert.phase)
        if world.solved() and expert.phase == "retreat":
            break
    assert world.solved()
    usual = ["above", "down", "close", "lift", "carry", "lower", "open", "retreat"]
    assert phases == (usual if slips == 0 else [*usual[:5], *usual])
    assert set(usual) == set(LIMITS)


class Recorded:
    """An episode of libero_object's second task that the expert solved in the simulator."""

    def __init__(self) -> None:
        with np.load(ROOT / "tests" / "data" / "libero_expert.npz") as arrays:
            self.arrays = dict(arrays)
        self.seen, self.plans = 0, 0

    def situation(self) -> Situation:
        names = ("hand", "rotation", "body", "target", "goal")
        self.seen += 1
        return Situation(**{name: self.arrays[name][self.seen - 1] for name in names})

    def neighbours(self, above: float) -> Points:
        self.plans += 1
        return np.asarray(self.arrays["neighbours"][self.plans - 1])

    def obstacles(self) -> Points:
        raise AssertionError("only bowls are taken by their rim")


def test_in_a_recorded_episode_it_does_what_solved_the_task() -> None:
    """The first attempt failed, so the episode has each phase, some of them twice."""
    recorded = Recorded()
    expert = Expert(recorded, INTO_BASKET)
    for action, phase in zip(recorded.arrays["actions"], recorded.arrays["phases"], strict=True):
        np.testing.assert_allclose(expert.action(), action, atol=1e-6)
        assert expert.phase == phase
    assert recorded.plans == 2


def test_it_begins_again_if_the_box_falls_over() -> None:
    world = Toy((0.0, -0.1))
    expert = Expert(world, INTO_BASKET)
    while expert.phase != "down":
        world.step(expert.action())
    world.size = np.array([0.1, 0.08, 0.04])
    world.body[2] = 0.02
    expert.action()
    assert expert.phase == "above"


def missed(seed: int) -> tuple[Toy, Expert, bool, list[Float32Array]]:
    """A world after a miss, an expert from before it, whether the box was missed, what was executed."""
    world = Toy((-0.05, -0.15))
    expert = Expert(world, INTO_BASKET)
    executed: list[Float32Array] = []

    def advance(action: Float32Array) -> StepOutcome:
        executed.append(action)
        world.step(action)
        return StepOutcome(0.0, world.solved())

    was_missed = miss(world, INTO_BASKET, advance, np.random.default_rng(seed))
    return world, expert, was_missed, executed


def test_a_miss_ends_anywhere_but_with_the_box_in_the_hand() -> None:
    opened, carried, gone_on = list[Vector](), list[Vector](), 0
    for seed in range(60):
        world, _, was_missed, executed = missed(seed)
        if not was_missed:
            assert world.held or world.solved()  # by accident: the hand closed near enough
            continue
        assert not world.held
        assert STEPS[0] <= len(executed)
        gone_on += len(executed) >= STEPS[1]
        is_closed = executed[-1][6] == CLOSE
        (carried if is_closed else opened).append(world.hand.copy())
    assert len(opened) > 15
    assert len(carried) > 8
    assert gone_on < 8  # until it was known whether the box is in the hand
    assert np.array(carried)[:, 2].min() > 0.1  # metres: it is not about to grasp
    # An empty hand is carried to the basket, at y = 0.26.
    assert max(hand[1] for hand in carried) > 0.2


def test_it_solves_the_task_after_a_grasp_that_missed() -> None:
    for seed in range(20):
        world, expert, was_missed, _ = missed(seed)
        if not was_missed:
            continue
        expert.begin_again()
        for _ in range(400):
            world.step(expert.action())
            if world.solved():
                break
        assert world.solved()


def test_a_phase_ends_after_its_limit() -> None:
    world = Toy((0.0, -0.1))
    expert = Expert(world, INTO_BASKET)
    for _ in range(LIMITS["above"]):  # the hand does not move
        expert.action()
    assert expert.phase == "above"
    expert.action()
    assert expert.phase == "down"


def test_rotation_vectors_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((200, 3))
    vectors *= (rng.uniform(0, np.pi - 1e-3, 200) / np.linalg.norm(vectors, axis=1))[:, None]
    found = [rotation_vector(Rotation.from_rotvec(vector).as_matrix()) for vector in vectors]
    np.testing.assert_allclose(found, vectors, atol=1e-7)
    np.testing.assert_array_equal(rotation_vector(np.eye(3)), 0)
    for axis in np.eye(3):  # half a turn, whose axis has two directions
        half = rotation_vector(Rotation.from_rotvec(np.pi * axis).as_matrix())
        np.testing.assert_allclose(np.abs(half), np.pi * axis, atol=1e-7)


def test_the_hand_points_down_without_turning_far() -> None:
    for yaw in np.radians([0, 30, 60, 90, 130]):
        turned = Rotation.from_euler("z", yaw).as_matrix() @ DOWN
        down = downward(turned)
        np.testing.assert_array_equal(down[:, 2], [0, 0, -1])
        assert np.linalg.det(down) == pytest.approx(1)
