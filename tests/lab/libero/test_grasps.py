"""Grasps from above, against widths that are computed in another way."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from saccade_lab.libero.expert import about_z
from saccade_lab.libero.grasps import (
    FINGER_CLEARANCE,
    FINGER_REACH,
    MAX_WIDTH,
    OUTER_FINGER,
    RIM_INSET,
    YAWS,
    Points,
    finger_clearance,
    plan_grasp,
    plan_rim_grasp,
)

NOBODY = np.zeros((0, 2))


def box(
    size: tuple[float, float, float], yaw: float = 0.0, at: tuple[float, float, float] = (0, 0, 0)
) -> Points:
    corners = np.stack(np.meshgrid(*3 * [[-0.5, 0.5]], indexing="ij"), axis=-1).reshape(-1, 3) * size
    return np.asarray(Rotation.from_euler("z", yaw).apply(corners) + at)


def caliper(points: Points, direction: Points) -> float:
    """The width of the ground plan along a direction, from its hull."""
    hull = points[ConvexHull(points[:, :2]).vertices, :2]
    return float(np.max(hull @ direction) - np.min(hull @ direction))


@pytest.mark.parametrize("turned", [-80, -35, 0, 20, 65])
def test_the_fingers_close_on_the_short_side(turned: int) -> None:
    points = box((0.12, 0.03, 0.08), np.radians(turned), at=(0.3, -0.2, 0.5))
    grasp = plan_grasp(points, NOBODY)
    np.testing.assert_allclose(grasp.xy, [0.3, -0.2], atol=1e-12)
    assert np.degrees(grasp.yaw) == pytest.approx(turned, abs=5.1)  # the short side is y, as the closing axis
    closing = about_z(grasp.yaw)[:2, 1]
    assert grasp.width == pytest.approx(caliper(points, closing))
    widths = [caliper(points, about_z(yaw)[:2, 1]) for yaw in YAWS]
    assert grasp.width <= min(widths) + 0.012


def test_of_equal_widths_the_hand_turns_least() -> None:
    assert plan_grasp(box((0.05, 0.05, 0.1)), NOBODY).yaw == 0


@pytest.mark.parametrize(
    ("height", "depth"), [(0.2, 0.04), (0.05, 0.55 * 0.05), (0.02, 0.02 - 0.012), (0.005, 0.005 - 0.012)]
)
def test_the_height_of_the_fingertips(height: float, depth: float) -> None:
    grasp = plan_grasp(box((0.04, 0.04, height), at=(0, 0, 1)), NOBODY)
    assert grasp.top == pytest.approx(1 + height / 2)
    assert grasp.top - grasp.z == pytest.approx(depth)
    assert grasp.hang == pytest.approx(height - depth)


def test_too_wide_a_side_is_never_chosen_if_another_fits() -> None:
    points = box((0.06, MAX_WIDTH + 0.002, 0.1))
    grasp = plan_grasp(points, NOBODY)
    assert grasp.width < MAX_WIDTH
    assert abs(np.degrees(grasp.yaw)) == 90


def test_the_fingers_avoid_a_neighbour() -> None:
    cylinder = np.concatenate([about_z(angle)[:2, :1].T * 0.03 for angle in np.linspace(0, 6.2, 32)])
    points = np.concatenate([np.insert(cylinder, 2, z, axis=1) for z in (0, 0.1)])
    neighbour = np.array([[0.0, FINGER_REACH]])  # where a finger would land with yaw 0
    assert abs(np.degrees(plan_grasp(points, NOBODY).yaw)) < 10
    grasp = plan_grasp(points, neighbour)
    assert finger_clearance(neighbour - grasp.xy, about_z(grasp.yaw)[:2, 1]) >= FINGER_CLEARANCE


def test_the_distance_of_a_finger_is_that_of_its_box() -> None:
    rng = np.random.default_rng(0)
    for point in rng.uniform(-0.1, 0.1, (200, 2)):
        yaw = rng.uniform(-1.5, 1.5)
        across, along = about_z(-yaw)[:2, :2] @ point  # in the frame of the hand
        expected = min(max(abs(along - side) - 0.012, abs(across) - 0.014) for side in (-0.045, 0.045))
        assert finger_clearance(point[None], about_z(yaw)[:2, 1]) == pytest.approx(expected)
    assert finger_clearance(NOBODY, np.array([0.0, 1.0])) == np.inf


HAND = np.array([0.3, -0.2, 0.4])  # above the bowl


def bowl(radius: float = 0.053, height: float = 0.05) -> Points:
    """A cone whose rim is wider than the gripper opens."""
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    circle = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    rings = [(radius * share, share * height) for share in np.linspace(0.5, 1, 6)]
    points = np.concatenate([np.insert(size * circle, 2, z, axis=1) for size, z in rings])
    return np.asarray(points + np.array([0.3, -0.2, 0.9]))


def test_a_bowl_is_wider_than_the_gripper_opens() -> None:
    assert np.ptp(bowl()[:, 1]) > MAX_WIDTH


@pytest.mark.parametrize("blocked", [0, 45, 100, 180, 260, 315])
def test_one_finger_goes_inside_the_rim_where_there_is_room(blocked: int) -> None:
    way = np.array([np.cos(np.radians(blocked)), np.sin(np.radians(blocked))])
    wall = np.append(np.array([0.3, -0.2]) + 0.08 * way, 1.0)[None]
    grasp = plan_rim_grasp(bowl(), wall, HAND)
    outward = (grasp.xy - [0.3, -0.2]) / (0.053 - RIM_INSET)
    assert np.linalg.norm(outward) == pytest.approx(1)  # on the rim
    closing = about_z(grasp.yaw)[:2, 1]
    assert abs(closing @ outward) == pytest.approx(1)  # the fingers close across it
    finger = np.array([0.3, -0.2]) + (0.053 + OUTER_FINGER) * outward
    assert np.linalg.norm(finger - wall[0, :2]) > 0.06
    assert -np.pi / 2 <= grasp.yaw < np.pi / 2
    assert 0.9 < grasp.z < grasp.top
    assert grasp.hang == pytest.approx(grasp.z - 0.9 - 0.025)


def test_with_room_on_all_sides_the_hand_turns_least_and_then_takes_the_shortest_way() -> None:
    free = np.zeros((0, 3))
    assert plan_rim_grasp(bowl(), free, HAND).yaw == 0
    for side in (-1, 1):
        grasp = plan_rim_grasp(bowl(), free, HAND + np.array([0, side * 0.3, 0]))
        np.testing.assert_allclose(grasp.xy, [0.3, -0.2 + side * (0.053 - RIM_INSET)], atol=1e-12)


def test_at_right_angles_the_turn_is_in_its_range() -> None:
    sides = np.radians(np.delete(np.arange(0, 360, 30), 3))  # all but 90 degrees
    walls = np.stack((0.3 - 0.09 * np.sin(sides), -0.2 + 0.09 * np.cos(sides), np.ones(11)), axis=-1)
    assert np.degrees(plan_rim_grasp(bowl(), walls, HAND).yaw) == pytest.approx(-90)


def test_what_is_lower_than_the_fingers_is_no_obstacle() -> None:
    low = np.array([[0.3, -0.1, 0.92]])
    free = plan_rim_grasp(bowl(), np.zeros((0, 3)), HAND)
    assert plan_rim_grasp(bowl(), low, HAND).yaw == free.yaw
    np.testing.assert_array_equal(plan_rim_grasp(bowl(), low, HAND).xy, free.xy)
