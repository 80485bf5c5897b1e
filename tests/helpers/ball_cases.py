"""Tasks with coloured balls: going to a place, and where a camera sees a ball."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade_lab.sim.cameras import CameraPose
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.scenarios import Ball, BallScenario

Float64Array = npt.NDArray[np.float64]

FIELD_OF_VIEW = 45.0  # degrees, MuJoCo's default for a free camera


@contextlib.contextmanager
def make(task: str, **options: Any) -> Iterator[TaskEnvironment]:
    with contextlib.closing(TaskEnvironment(task, **options)) as environment:
        yield environment


def balls_of(environment: TaskEnvironment) -> tuple[Ball, ...]:
    assert isinstance(environment.scenario, BallScenario)
    return environment.scenario.placed


def go_to(environment: TaskEnvironment, target: Float64Array, steps: int = 150) -> bool:
    """Moves the fingertips to a place by feedback of our own; whether any step on the way was a success."""
    done = False
    for _ in range(steps):
        way = target - environment.fingertips()
        done = environment.advance(np.append(np.clip(20.0 * way, -1.0, 1.0), 0.0)).success or done
    return done


def eye_and_forward(camera: CameraPose) -> tuple[Float64Array, Float64Array]:
    """Position and viewing direction of a camera."""
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + [0.0, 0.0, np.sin(elevation)]
    return np.array(camera.lookat) - camera.distance * forward, forward


def seen_at(camera: CameraPose, points: Float64Array, size: int) -> tuple[Float64Array, Float64Array]:
    """Where a pinhole camera sees points `(n, 3)`: pixels from the middle, right and up; and their scale.

    The scale is that of lengths there, in pixels a metre.
    """
    eye, forward = eye_and_forward(camera)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = points - eye
    scale = size / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2)) / (away @ forward)
    pixels = np.stack([away @ right, away @ np.cross(right, forward)], axis=1) * scale[:, None]
    return pixels, scale


def coloured(picture: npt.NDArray[np.uint8], ball: Ball) -> Float64Array:
    """Rows and columns `(n, 2)` of the pixels that have the hue of a ball."""
    pixels = picture.astype(float)
    hue = np.array(ball.rgba[:3])
    bright = pixels.max(axis=2)
    cosine = pixels @ hue / np.maximum(np.linalg.norm(pixels, axis=2) * np.linalg.norm(hue), 1.0)
    return np.argwhere((cosine > 0.97) & (bright > 120)).astype(float)
