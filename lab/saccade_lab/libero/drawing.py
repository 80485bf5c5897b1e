"""The two cameras of LIBERO, drawn only when somebody looks.

robosuite samples images inside a control step, after 23 of its 25 physics steps, and draws them every time.
Drawing is most of the cost of a step. Here the scene is recorded at that moment, which takes microseconds,
and drawn from the record when an image is asked for. The pixels are the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from saccade._internal.arrays import UInt8Array
from saccade_lab.sim import closing, graphics

if TYPE_CHECKING:
    import mujoco

#: Names of images, and LIBERO's names of their cameras.
CAMERAS = {"image": "agentview", "wrist_image": "robot0_eye_in_hand"}
COLLISION_GROUP, VISUAL_GROUP = 0, 1  # robosuite draws geoms of the second, and not those of the first
#: Fields of MuJoCo's data that decide what a camera sees.
POSES = (
    *("xpos", "xquat", "xmat", "xipos", "ximat", "subtree_com", "geom_xpos", "geom_xmat"),
    *("site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir"),
)
MOST_GEOMS = 1000  # in a scene, as robosuite allows; further ones are not drawn


class RecordedScene:
    """What cameras need to draw one moment.

    Args:
        model: Of the running simulation.
        data: Of the running simulation.

    Raises:
        RuntimeError: The scene has things whose positions are not recorded; no task of LIBERO does.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        unknown = [name for name in ("nflex", "nskin", "ntendon", "nmocap") if getattr(model, name)]
        if unknown:
            raise RuntimeError(f"the scene has {', '.join(unknown)}, which are not recorded")
        self._data = data
        # The burner of a stove is a site. LIBERO changes its colour in the model, at the end of a step.
        self._live = [model.site_rgba, *(getattr(data, name) for name in POSES)]
        self._recorded = [np.empty_like(values) for values in self._live]
        self.record()

    def record(self) -> None:
        """Takes over the current moment."""
        for recorded, live in zip(self._recorded, self._live, strict=True):
            np.copyto(recorded, live)

    def show(self, renderer: mujoco.Renderer, camera: str, options: mujoco.MjvOption) -> None:
        """Gives the recorded moment to a renderer. The simulation is as before afterwards."""
        now = [live.copy() for live in self._live]
        try:
            for recorded, live in zip(self._recorded, self._live, strict=True):
                np.copyto(live, recorded)
            renderer.update_scene(self._data, camera, options)
        finally:
            for values, live in zip(now, self._live, strict=True):
                np.copyto(live, values)


class CameraRenderer:
    """Draws recorded scenes of one model.

    Call ``close`` to free the OpenGL context. Renderers that are still open when the interpreter ends are
    closed then.

    Args:
        model: LIBERO's.
        size: Pixels along each side.

    Raises:
        GraphicsError: OpenGL cannot be loaded.
    """

    def __init__(self, model: mujoco.MjModel, size: int) -> None:
        graphics.load_triton_first()
        mujoco = graphics.load_mujoco()
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, size)
        model.vis.global_.offheight = max(model.vis.global_.offheight, size)
        self._options = mujoco.MjvOption()
        self._options.geomgroup[COLLISION_GROUP] = 0
        self._options.geomgroup[VISUAL_GROUP] = 1
        self._renderer: Any = mujoco.Renderer(model, size, size, max_geom=MOST_GEOMS)
        closing.close_at_exit(self)

    def draw(self, scene: RecordedScene, camera: str) -> UInt8Array:
        """The picture ``(size, size, 3)``, upright and mirrored from left to right.

        Every released client turns robosuite's upside-down picture by 180 degrees, which mirrors it. Policies
        are trained on such pictures: letters on boxes read backwards.

        Args:
            scene: What to draw.
            camera: LIBERO's name of the camera.

        Raises:
            RuntimeError: The renderer is closed.
        """
        if self._renderer is None:
            raise RuntimeError("this renderer is closed")
        scene.show(self._renderer, camera, self._options)
        picture: UInt8Array = self._renderer.render()  # upright
        return np.ascontiguousarray(picture[:, ::-1])

    def close(self) -> None:
        """Frees the OpenGL context; may be called twice."""
        closing.closed(self)
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
