"""Rotations and relative poses, compared with SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from saccade.robots import rotations

#: What SciPy calls intrinsic rotations about the axes.
AXES = {"r": "X", "p": "Y", "y": "Z"}


def random(count: int = 50) -> Any:
    return Rotation.random(count, random_state=np.random.RandomState(5))


def numbers(rotation: Any, name: str) -> npt.NDArray[Any]:
    """What SciPy makes of rotations in one representation."""
    if name == "quaternion":
        found = rotation.as_quat(scalar_first=True)
        found = np.where(found[:, :1] < 0, -found, found)
    elif name == "axis_angle":
        found = rotation.as_rotvec()
    elif name == "rotation_6d":
        found = rotation.as_matrix()[:, :2].reshape(-1, 6)
    else:
        found = rotation.as_euler("".join(AXES[letter] for letter in name.removeprefix("euler_angles_")))
    return np.asarray(found)


@pytest.mark.parametrize("source", rotations.SIZES)
@pytest.mark.parametrize("target", rotations.SIZES)
def test_every_representation_becomes_every_other(source: str, target: str) -> None:
    turns = random()
    found = rotations.converted(numbers(turns, source), source, target)
    assert found.shape == (50, rotations.SIZES[target])
    np.testing.assert_allclose(found, numbers(turns, target), atol=1e-10)


def test_rotations_need_not_be_exact() -> None:
    """Quaternions of any length, six numbers that are not orthonormal, angles beyond pi."""
    turns = random()
    matrix = turns.as_matrix()
    np.testing.assert_allclose(
        rotations.to_matrix(-3.5 * numbers(turns, "quaternion"), "quaternion"), matrix, atol=1e-12
    )
    six = numbers(turns, "rotation_6d").reshape(-1, 2, 3)
    skewed = np.concatenate([2 * six[:, 0], six[:, 1] + 0.3 * six[:, 0]], axis=-1)
    np.testing.assert_allclose(rotations.to_matrix(skewed, "rotation_6d"), matrix, atol=1e-12)
    vector = numbers(turns, "axis_angle")
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    longer = vector * (angle + 2 * np.pi) / angle
    np.testing.assert_allclose(rotations.to_matrix(longer, "axis_angle"), matrix, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 1e-3, np.pi - 1e-7, np.pi])
def test_small_and_half_turns(angle: float) -> None:
    vector = np.array([0.6, 0.0, 0.8]) * angle
    found = rotations.converted(vector, "axis_angle", "axis_angle")
    np.testing.assert_allclose(np.abs(found), np.abs(vector), atol=1e-9)


@pytest.mark.parametrize("source", ["quaternion", "rotation_6d"])
def test_zeros_are_no_rotation(source: str) -> None:
    zeros = np.zeros(rotations.SIZES[source])
    assert np.isnan(rotations.converted(zeros, source, "axis_angle")).any()


@pytest.mark.parametrize(("form", "name"), [(form, name) for form, (_, name) in rotations.POSES.items()])
def test_relative_poses(form: str, name: str) -> None:
    reference, step = random(), Rotation.random(50, random_state=np.random.RandomState(6))
    place, offset = np.random.default_rng(0).standard_normal((2, 50, 3))

    def pose(position: npt.NDArray[Any], rotation: Any) -> npt.NDArray[Any]:
        return np.concatenate([position, numbers(rotation, name)], axis=-1)

    absolute = pose(reference.apply(offset) + place, reference * step)
    found = rotations.composed(pose(place, reference), pose(offset, step), form)
    np.testing.assert_allclose(found, absolute, atol=1e-10)
    back = rotations.relative_to(pose(place, reference), absolute, form)
    np.testing.assert_allclose(back, pose(offset, step), atol=1e-10)


def test_an_example_by_hand() -> None:
    """A quarter turn about z: forward along x becomes forward along y."""
    reference = np.array([1.0, 2.0, 3.0, 0, 0, np.pi / 2])
    found = rotations.composed(reference, np.array([1.0, 0, 0, 0, 0, 0]), "XYZ_ROTVEC")
    np.testing.assert_allclose(found, [1, 3, 3, 0, 0, np.pi / 2], atol=1e-12)
