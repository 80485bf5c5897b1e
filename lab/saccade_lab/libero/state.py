"""The state vector of a policy ``(8,)``: position of the hand, its orientation, the fingers.

Released clients compute the orientation in different arithmetic, so their vectors differ in the last bits.
The vector of a rotation is the axis times the angle. The sign of the quaternion is not made canonical, so
angles up to 2 pi occur. Isaac-GR00T calls the three numbers roll, pitch and yaw, but they are this vector.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

#: Below this, lerobot takes the rotation for none.
SMALL = 1e-10


@dataclass(frozen=True)
class Proprioception:
    """What the simulator measures of the robot.

    Attributes:
        position: Of the hand, metres, ``(3,)``, in the world.
        quaternion: Of the hand, ``(4,)``: x, y, z, w.
        fingers: Positions of the two finger joints, metres, ``(2,)``: the second is negative.
    """

    position: Float64Array
    quaternion: Float64Array
    fingers: Float64Array


def isaac_state(measured: Proprioception) -> Float64Array:
    """The state of Isaac-GR00T's clients ``(8,)``, in float64.

    The formula is that of ``quat2axisangle`` in its ``libero_env.py`` (N1.6, N1.7) and in
    ``examples/Libero/eval/utils.py`` (N1.5). gymnasium's vector environment then rounds it to float32 (N1.6,
    N1.7). N1.5's client sends float64.
    """
    x, y, z, w = (float(value) for value in measured.quaternion)
    w = min(max(w, -1.0), 1.0)
    root = math.sqrt(1.0 - w * w)
    rotation = np.zeros(3)
    if root != 0.0:
        rotation = (np.array([x, y, z]) * 2.0 * math.acos(w)) / root
    return np.concatenate([measured.position, rotation, measured.fingers])


def lerobot_state(measured: Proprioception) -> Float32Array:
    """The state of lerobot's ``LiberoProcessorStep`` ``(8,)``, computed in float32.

    torch's arc cosine in float32 may differ from NumPy's by a unit in the last place.
    """
    quaternion = measured.quaternion.astype(np.float32)
    one = np.float32(1.0)
    w = np.clip(quaternion[3], -one, one)
    root = np.sqrt(np.maximum(one - w * w, np.float32(0.0)))
    rotation = np.zeros(3, np.float32)
    if root > np.float32(SMALL):
        rotation = quaternion[:3] / root * (np.float32(2.0) * np.arccos(w))
    parts = (measured.position.astype(np.float32), rotation, measured.fingers.astype(np.float32))
    return np.concatenate(parts)
