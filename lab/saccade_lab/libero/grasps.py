"""Where a parallel gripper that points straight down takes hold of an object, or of its rim; NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]

MAX_WIDTH = 0.074  # metres between the open fingers of the Panda, less a margin
MAX_DEPTH = 0.04  # metres that the fingers reach below the top of an object, at most
DEPTH_SHARE = 0.55  # of the object's height, for low ones
FLOOR_MARGIN = 0.012  # metres that the fingertips stay above the bottom of the object
FINGER_REACH = 0.045  # metres from the middle of the hand to an open finger
FINGER_HALF = (0.012, 0.014)  # half of a finger's size, along the closing axis and across
FINGER_CLEARANCE = 0.006  # metres between an open finger and a neighbour that cost nothing
TURN_COST = 0.012  # metres of width that a turn by 90 degrees is worth
TOO_WIDE_COST = 0.2
NEIGHBOUR_COST = 3.0
YAWS = np.radians(np.arange(-90, 90, 5))

# Of a bowl, which is wider than the gripper opens: one finger goes inside.
# Angles of the places on the rim, from the direction in which the fingers close when the hand is not turned.
SIDES = np.radians([0, 180, 30, -30, 150, -150, 60, -60, 120, -120, 90, -90])
RIM_BAND = 0.012  # metres below the highest point that belong to the rim
RIM_INSET = 0.006  # metres from the outside of the rim to the middle of the hand
RIM_DEPTH = 0.018  # metres that the fingers reach below the rim
OUTER_FINGER = FINGER_REACH - RIM_INSET  # metres from the outside of the rim to the outer finger
FREE_ENOUGH = 0.06  # metres around the outer finger beyond which more room is worth nothing
RIM_TURN_COST = 0.01  # metres of that room that a turn by a radian is worth
RIM_WAY_COST = 0.02  # the same, for each metre of the hand's way


@dataclass(frozen=True)
class Grasp:
    """A grasp from above.

    Attributes:
        xy: ``(2,)`` metres, where the hand goes down.
        z: Height of the hand when it closes, metres.
        yaw: Turn of the hand from its pose at the start, radians in [-pi/2, pi/2).
        width: Extent of the object along the closing axis, metres.
        top: Height of the object's highest point, metres.
        hang: Metres from the hand down to the lowest point of the object that it holds.
    """

    xy: npt.NDArray[np.float64]
    z: float
    yaw: float
    width: float
    top: float
    hang: float


def plan_grasp(points: Points, neighbours: Points) -> Grasp:
    """The grasp over the middle of an object whose closing axis meets the least width.

    The open fingers should also not land on a neighbour. Both are weighed against turning the hand.

    Args:
        points: ``(n, 3)``, points of the object that span its convex hull, metres.
        neighbours: ``(m, 2)``, the ground plan of other objects that are as high as the fingertips.

    Example:
        >>> box = np.array([[x, y, z] for x in (0, 0.03) for y in (0, 0.2) for z in (0, 0.1)])
        >>> grasp = plan_grasp(box, np.zeros((0, 2)))
        >>> grasp.xy, round(grasp.z, 3), round(np.degrees(grasp.yaw)), round(grasp.width, 3)
        (array([0.015, 0.1  ]), 0.06, -90, 0.03)
    """
    low, high = points.min(axis=0), points.max(axis=0)
    z = fingertip_height(points)
    middle = 0.5 * (low + high)[:2]
    best = (np.inf, 0.0, 0.0)
    for yaw in YAWS:
        closing = np.array([-np.sin(yaw), np.cos(yaw)])
        along = points[:, :2] @ closing
        width = float(along.max() - along.min())
        cost = width + TURN_COST * abs(yaw) / (np.pi / 2) + TOO_WIDE_COST * (width > MAX_WIDTH)
        clearance = finger_clearance(neighbours - middle, closing)
        cost += NEIGHBOUR_COST * max(0.0, FINGER_CLEARANCE - clearance)
        best = min(best, (cost, float(yaw), width))
    _, yaw, width = best
    return Grasp(middle, z, yaw, width, top=float(high[2]), hang=z - float(low[2]))


def plan_rim_grasp(points: Points, obstacles: Points, hand: npt.NDArray[np.float64]) -> Grasp:
    """The grasp of the rim of a round object with one finger inside, on the side with the most room.

    Args:
        points: ``(n, 3)``, points of the object that span its convex hull, metres.
        obstacles: ``(m, 3)``, points of everything else, metres.
        hand: ``(3,)``, where the hand is, metres.

    Example:
        >>> angles = np.radians(np.arange(0, 360, 10))
        >>> rim = 0.05 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
        >>> bowl = np.concatenate([np.insert(rim, 2, height, axis=1) for height in (0, 0.05)])
        >>> grasp = plan_rim_grasp(bowl, np.array([[0, 0.1, 0.1]]), np.zeros(3))
        >>> grasp.xy.round(3), round(grasp.z, 3), round(np.degrees(grasp.yaw))  # away from the obstacle
        (array([-0.   , -0.044]), 0.032, 0)
    """
    low, high = points.min(axis=0), points.max(axis=0)
    middle, top = 0.5 * (low + high)[:2], float(high[2])
    rim = points[points[:, 2] > top - RIM_BAND, :2]
    radius = float(np.linalg.norm(rim - middle, axis=1).max())
    beside = obstacles[obstacles[:, 2] > top - RIM_DEPTH, :2]
    best = (np.inf, 0.0, 0.0, 0.0)
    for side in SIDES:
        yaw = side if -np.pi / 2 <= side < np.pi / 2 else side - np.copysign(np.pi, side)
        outward = np.array([-np.sin(side), np.cos(side)])
        xy, finger = (middle + away * outward for away in (radius - RIM_INSET, radius + OUTER_FINGER))
        room = np.linalg.norm(beside - finger, axis=1).min(initial=FREE_ENOUGH)
        way = np.linalg.norm(xy - hand[:2])
        best = min(best, (RIM_TURN_COST * abs(yaw) + RIM_WAY_COST * way - room, yaw, *xy))
    _, yaw, *xy = best
    z = top - RIM_DEPTH
    return Grasp(np.array(xy), z, float(yaw), width=2 * RIM_INSET, top=top, hang=z - float(low[2]))


def fingertip_height(points: Points) -> float:
    """The height at which the hand closes on an object, metres; see ``plan_grasp``."""
    low, high = float(points[:, 2].min()), float(points[:, 2].max())
    return max(high - min(MAX_DEPTH, DEPTH_SHARE * (high - low)), low + FLOOR_MARGIN)


def finger_clearance(neighbours: Points, closing: npt.NDArray[np.float64]) -> float:
    """Metres from the open fingers to the nearest neighbour, infinite if there is none.

    Args:
        neighbours: ``(m, 2)``, relative to the middle of the hand.
        closing: ``(2,)``, the unit vector along which the fingers close.
    """
    if not len(neighbours):
        return np.inf
    across = np.array([closing[1], -closing[0]])
    gaps = np.maximum(
        np.abs(np.abs(neighbours @ closing) - FINGER_REACH) - FINGER_HALF[0],
        np.abs(neighbours @ across) - FINGER_HALF[1],
    )
    return float(gaps.min())
