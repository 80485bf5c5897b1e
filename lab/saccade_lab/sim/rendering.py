"""Fast drawing: what the policy sees, and the larger picture for videos.

The settings that make drawing fast are the same for demonstrations and evaluation. Milliseconds per picture
at 128 px with Mesa's software renderer on one core: 200 as Meta-World configures it, 5.1 without shadows,
multisampling and reflections, 3.5 without the arm above the wrist. Almost all of the remaining time is spent
on the vertices of hand and scene. Pictures are therefore drawn at twice their size and averaged down, which
costs little and places edges with subpixel precision.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from saccade._internal.arrays import UInt8Array
from saccade_lab.sim import closing, graphics
from saccade_lab.sim.cameras import CameraPose
from saccade_lab.sim.scenarios import Ball

if TYPE_CHECKING:
    import mujoco


SUPERSAMPLING = 2
HIDDEN_GROUP = 5  # geoms of this group are not drawn for the policy
# The arm above the wrist: 52,000 of 67,000 triangles, and it hides what the hand does.
ARM_BODIES = frozenset(
    (
        *("pedestal", "pedestal_feet", "torso", "head", "screen", "controller_box", "right_arm_base_link"),
        *(f"right_l{link}" for link in range(6)),
    )
)
GOAL_SITE = "goal"
GOAL_RADIUS = 0.03  # metres; Meta-World's own 0.02 is 2 pixels wide at 64 px
GOAL_RGBA = (0.0, 1.0, 0.0, 1.0)


def prepare_model(model: mujoco.MjModel, *, draws_goal: bool) -> None:
    """Configures the scene for fast drawing, in place.

    Args:
        model: A Meta-World model.
        draws_goal: Whether the goal is marked with a green ball; otherwise Meta-World's marker is hidden.
    """
    model.vis.quality.shadowsize = 0
    model.vis.quality.offsamples = 0
    model.mat_reflectance[:] = 0.0
    for geom in range(model.ngeom):
        if model.body(model.geom_bodyid[geom]).name in ARM_BODIES:
            model.geom_group[geom] = HIDDEN_GROUP
    for site in range(model.nsite):
        if model.site(site).name == GOAL_SITE:
            model.site_rgba[site] = GOAL_RGBA if draws_goal else (0.0, 0.0, 0.0, 0.0)
            model.site_size[site, 0] = GOAL_RADIUS


def average_down(picture: UInt8Array, factor: int) -> UInt8Array:
    """Means of ``factor x factor`` pixels: ``(factor * H, factor * W, 3)`` to ``(H, W, 3)``, rounded."""
    height, width, channels = picture.shape
    blocks = picture.reshape(height // factor, factor, width // factor, factor, channels)
    total = blocks.sum(axis=(1, 3), dtype=np.uint16)  # (H, W, 3)
    averaged: UInt8Array = ((total + factor * factor // 2) // (factor * factor)).astype(np.uint8)
    return averaged


def free_camera(camera: CameraPose) -> mujoco.MjvCamera:
    """The camera in MuJoCo's form."""
    view = graphics.load_mujoco().MjvCamera()
    view.lookat[:] = camera.lookat
    view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
    return view


def add_ball(scene: mujoco.MjvScene, ball: Ball) -> None:
    """Adds a ball to the scene that is drawn next."""
    mujoco = graphics.load_mujoco()
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom],
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=np.full(3, ball.radius),
        pos=ball.position,
        mat=np.eye(3).ravel(),
        rgba=np.array(ball.rgba, dtype=np.float32),
    )
    scene.ngeom += 1


class Renderer:
    """Draws one simulation through several cameras.

    Call ``close`` to free the OpenGL context. Renderers that are still open when the interpreter ends are
    closed then.

    Args:
        model: Prepared by ``prepare_model``.
        size: Pixels along each side of the result.
        for_video: Draw the whole robot, and without averaging, which takes three times as long.

    Raises:
        GraphicsError: OpenGL cannot be loaded.
    """

    def __init__(self, model: mujoco.MjModel, size: int, *, for_video: bool = False) -> None:
        graphics.load_triton_first()
        mujoco = graphics.load_mujoco()
        self._supersampling = 1 if for_video else SUPERSAMPLING
        drawn = size * self._supersampling
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, drawn)
        model.vis.global_.offheight = max(model.vis.global_.offheight, drawn)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[HIDDEN_GROUP] = 1 if for_video else 0
        self._renderer: Any = mujoco.Renderer(model, drawn, drawn)
        closing.close_at_exit(self)

    def draw(self, data: mujoco.MjData, camera: CameraPose, balls: Iterable[Ball] = ()) -> UInt8Array:
        """The picture ``(size, size, 3)``, with balls that the simulation does not have.

        Raises:
            RuntimeError: The renderer is closed.
        """
        if self._renderer is None:
            raise RuntimeError("this renderer is closed")
        self._renderer.update_scene(data, free_camera(camera), self._options)
        for ball in balls:
            add_ball(self._renderer.scene, ball)
        return average_down(self._renderer.render(), self._supersampling)

    def close(self) -> None:
        """Frees the OpenGL context; may be called twice."""
        closing.closed(self)
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
