"""Rotations in float64, written from their definitions: the part of the oracles that all releases share."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

EULER = tuple("euler_angles_" + "".join(order) for order in itertools.permutations("rpy"))
WIDTHS = {"quaternion": 4, "axis_angle": 3, "rotation_6d": 6, "matrix": 9} | dict.fromkeys(EULER, 3)


def axis_rotation(axis: int, angle: F64) -> F64:
    """The right-handed rotation about one coordinate axis: ``(...)`` to ``(..., 3, 3)``."""
    matrix = np.zeros((*angle.shape, 3, 3))
    one, two = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1.0
    matrix[..., one, one] = matrix[..., two, two] = np.cos(angle)
    matrix[..., two, one] = np.sin(angle)
    matrix[..., one, two] = -np.sin(angle)
    return matrix


def from_vector(vector: F64) -> F64:
    """The matrix of a rotation vector, by Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    unit = vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-300)
    x, y, z = np.moveaxis(unit, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    turned: F64 = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def to_vector(matrix: F64) -> F64:
    """The rotation vector of a matrix, angle in [0, pi). The matrix must not turn by about pi."""
    twice = np.stack(
        [
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ],
        -1,
    )
    sine = np.linalg.norm(twice, axis=-1, keepdims=True) / 2
    cosine = (np.trace(matrix, axis1=-2, axis2=-1)[..., None] - 1) / 2
    angle = np.arctan2(sine, cosine)
    vector: F64 = twice / 2 * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-300), 1.0)
    return vector


def from_rows(six: F64) -> F64:
    """The matrix of the first two rows, made orthonormal by Gram-Schmidt."""
    first = six[..., :3] / np.linalg.norm(six[..., :3], axis=-1, keepdims=True)
    second = six[..., 3:] - (first * six[..., 3:]).sum(-1, keepdims=True) * first
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], -2)


def from_quaternion(numbers: F64) -> F64:
    w, x, y, z = np.moveaxis(numbers / np.linalg.norm(numbers, axis=-1, keepdims=True), -1, 0)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(rows, -1).reshape(*w.shape, 3, 3)


def axes(name: str) -> list[int]:
    """The axes of ``euler_angles_...``, in order."""
    return ["rpy".index(letter) for letter in name.removeprefix("euler_angles_")]


def from_numbers(name: str, numbers: F64) -> F64:
    """``(..., 3, 3)`` of numbers in the representation ``name``."""
    if name == "quaternion":
        return from_quaternion(numbers)
    if name == "axis_angle":
        return from_vector(numbers)
    if name == "rotation_6d":
        return from_rows(numbers)
    one, two, three = (axis_rotation(axis, numbers[..., n]) for n, axis in enumerate(axes(name)))
    turned: F64 = one @ two @ three
    return turned


def to_numbers(name: str, matrix: F64) -> F64:
    """The numbers of a matrix in the representation ``name``."""
    if name == "rotation_6d":
        return matrix[..., :2, :].reshape(*matrix.shape[:-2], 6)
    if name == "axis_angle":
        return to_vector(matrix)
    if name == "quaternion":
        half = to_vector(matrix) / 2
        angle = np.linalg.norm(half, axis=-1, keepdims=True)
        return np.concatenate([np.cos(angle), half * np.sinc(angle / np.pi)], -1)
    i, j, k = axes(name)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    return np.stack(
        [
            np.arctan2(-sign * matrix[..., j, k], matrix[..., k, k]),
            np.arcsin(np.clip(sign * matrix[..., i, k], -1, 1)),
            np.arctan2(-sign * matrix[..., i, j], matrix[..., i, i]),
        ],
        -1,
    )


def well_conditioned(name: str, matrix: F64) -> NDArray[np.bool_]:
    """Where float32 suffices for :func:`to_numbers`: no half turn, no gimbal lock, no jump by 2 pi."""
    if name == "rotation_6d":
        return np.ones(matrix.shape[:-2], np.bool_)
    if name in ("axis_angle", "quaternion"):
        return np.asarray(np.trace(matrix, axis1=-2, axis2=-1) > -0.8)
    angles = to_numbers(name, matrix)
    return np.asarray((np.abs(angles) < [3.0, 1.25, 3.0]).all(-1))
