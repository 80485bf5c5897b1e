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
    YAWS,
    Points,
    finger_clearance,
    plan_grasp,
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
