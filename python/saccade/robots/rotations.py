"""Rotations in the representations of Isaac-GR00T, and poses relative to another pose.

Everything goes through rotation matrices ``(..., 3, 3)`` that act on column vectors, in float64. The
formulas are those of pytorch3d 0.7.6, which GR00T N1 and N1.5 use, and of SciPy's ``Rotation``, which N1.6
and N1.7 use. Both agree where both have the representation.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Float64Array: TypeAlias = "npt.NDArray[np.float64]"

#: Representations of N1.5, and how many numbers each has. ``euler_angles_abc`` are intrinsic rotations about
#: the axes a, b, c, where r, p, y are x, y, z.
SIZES = {
    "quaternion": 4,  # w, x, y, z
    "rotation_6d": 6,  # the first two rows of the matrix
    "axis_angle": 3,
    **{f"euler_angles_{order}": 3 for order in ("rpy", "ryp", "pry", "pyr", "yrp", "ypr")},
}

#: Fixed bounds of converted numbers, which N1.5 uses in place of the file's.
BOUNDS = {name: 1.0 if size > 3 else float(np.pi) for name, size in SIZES.items()}

#: Numbers of a pose by its format: a translation, and a rotation as ``rotation_6d`` or ``axis_angle``.
POSES = {"XYZ_ROT6D": (9, "rotation_6d"), "XYZ_ROTVEC": (6, "axis_angle")}

#: Rows of ``rotation_6d`` are parallel below this sine of their angle: float32 numbers have an error of 6e-8.
PARALLEL = 1e-6

#: Below this angle, sin(t / 2) / t comes from its series.
SMALL_ANGLE = 1e-6


def converted(values: npt.NDArray[Any], source: str, target: str) -> Float64Array:
    """Rotations ``(..., SIZES[source])`` in another representation, ``(..., SIZES[target])``.

    NaN where the numbers are no rotation, such as a quaternion of zeros.

    Example:
        A quarter turn about z:

        >>> converted(np.array([0.0, 0.0, np.pi / 2]), "axis_angle", "quaternion").round(3)
        array([0.707, 0.   , 0.   , 0.707])
    """
    return from_matrix(to_matrix(values, source), target)


def to_matrix(values: npt.NDArray[Any], source: str) -> Float64Array:
    """Rotation matrices ``(..., 3, 3)`` of rotations in the representation ``source``."""
    given = np.asarray(values, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # what is no rotation becomes NaN
        if source == "rotation_6d":
            return _of_rows(given[..., :3], given[..., 3:])
        if source == "quaternion":
            return _of_quaternion(given)
        if source == "axis_angle":
            angle = np.linalg.norm(given, axis=-1, keepdims=True)
            half = given * _half_sine(angle)
            return _of_quaternion(np.concatenate([np.cos(angle / 2), half], axis=-1))
        turns = [_about(axis, given[..., place]) for place, axis in enumerate(_axes(source))]
        product: Float64Array = turns[0] @ turns[1] @ turns[2]
        return product


def from_matrix(matrix: Float64Array, target: str) -> Float64Array:
    """Rotation matrices ``(..., 3, 3)`` in the representation ``target``.

    Quaternions have w >= 0, angles about an axis are in [0, pi].
    """
    if target == "rotation_6d":
        return matrix[..., :2, :].reshape(*matrix.shape[:-2], 6)
    if target == "quaternion":
        return _to_quaternion(matrix)
    if target == "axis_angle":
        quaternion = _to_quaternion(matrix)
        vector = quaternion[..., 1:]
        angle = 2 * np.arctan2(np.linalg.norm(vector, axis=-1, keepdims=True), quaternion[..., :1])
        found: Float64Array = vector / _half_sine(angle)
        return found
    i, j, k = _axes(target)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    # Rounding may leave a sine just above 1.
    middle = np.arcsin(np.clip(sign * matrix[..., i, k], -1.0, 1.0))
    first = np.arctan2(-sign * matrix[..., j, k], matrix[..., k, k])
    last = np.arctan2(-sign * matrix[..., i, j], matrix[..., i, i])
    return np.stack([first, middle, last], axis=-1)


def composed(reference: npt.NDArray[Any], relative: npt.NDArray[Any], form: str) -> Float64Array:
    """Poses that are given in the frame of a reference pose: R_ref R_rel and R_ref t_rel + t_ref."""
    turn, place = _pose(reference, form)
    inner, offset = _pose(relative, form)
    return _joined(turn @ inner, (turn @ offset[..., None])[..., 0] + place, form)


def relative_to(reference: npt.NDArray[Any], poses: npt.NDArray[Any], form: str) -> Float64Array:
    """The inverse of ``composed``: R_ref^T R and R_ref^T (t - t_ref)."""
    turn, place = _pose(reference, form)
    outer, position = _pose(poses, form)
    back = np.swapaxes(turn, -1, -2)
    return _joined(back @ outer, (back @ (position - place)[..., None])[..., 0], form)


def _pose(values: npt.NDArray[Any], form: str) -> tuple[Float64Array, Float64Array]:
    """Rotation matrix and translation of a pose."""
    given = np.asarray(values, np.float64)
    return to_matrix(given[..., 3:], POSES[form][1]), given[..., :3]


def _joined(matrix: Float64Array, position: Float64Array, form: str) -> Float64Array:
    return np.concatenate([position, from_matrix(matrix, POSES[form][1])], axis=-1)


def _of_rows(first: Float64Array, second: Float64Array) -> Float64Array:
    """The matrix whose first two rows are these after Gram-Schmidt."""
    one = first / np.linalg.norm(first, axis=-1, keepdims=True)
    rest = second - (one * second).sum(-1, keepdims=True) * one
    length = np.linalg.norm(rest, axis=-1, keepdims=True)
    # Of parallel rows only rounding is left, which is no direction.
    is_noise = length <= PARALLEL * np.linalg.norm(second, axis=-1, keepdims=True)
    two = rest / np.where(is_noise, np.nan, length)
    return np.stack([one, two, np.cross(one, two)], axis=-2)


def _of_quaternion(values: Float64Array) -> Float64Array:
    """The matrix of a quaternion of any length but zero."""
    w, x, y, z = np.moveaxis(values, -1, 0)
    s = 2 / (values * values).sum(-1)
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    return _stacked(rows)


def _stacked(rows: list[list[Float64Array]]) -> Float64Array:
    """Matrices of their numbers."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _to_quaternion(matrix: Float64Array) -> Float64Array:
    """The quaternion with w >= 0, computed by the largest of its four numbers."""
    r = matrix
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # Each is four times the square of one of w, x, y, z.
    squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz]
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    # Row n is 4 q_n times the quaternion.
    rows = [[squares[0], a, b, c], [a, squares[1], d, e], [b, d, squares[2], f], [c, e, f, squares[3]]]
    largest = np.argmax(np.stack(squares, axis=-1), axis=-1)[..., None, None]
    chosen = np.take_along_axis(_stacked(rows), largest, axis=-2)[..., 0, :]
    with np.errstate(invalid="ignore"):
        unit = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    positive: Float64Array = np.where(unit[..., :1] < 0, -unit, unit)
    return positive


def _half_sine(angle: Float64Array) -> Float64Array:
    """sin(t / 2) / t."""
    small = angle < SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    found: Float64Array = np.where(small, 0.5 - angle * angle / 48, np.sin(safe / 2) / safe)
    return found


def _about(axis: int, angle: Float64Array) -> Float64Array:
    """Right-handed rotations about one axis."""
    matrix = np.zeros((*angle.shape, 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix[..., axis, axis] = 1
    matrix[..., j, j] = matrix[..., k, k] = np.cos(angle)
    matrix[..., k, j] = np.sin(angle)
    matrix[..., j, k] = -matrix[..., k, j]
    return matrix


def _axes(name: str) -> tuple[int, ...]:
    """The axes of Euler angles, 0 to 2, in order."""
    return tuple("rpy".index(letter) for letter in name.removeprefix("euler_angles_"))
