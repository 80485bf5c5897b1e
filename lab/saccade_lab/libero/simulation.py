"""A task of LIBERO in MuJoCo, started and stepped as LIBERO's own wrapper does, without drawing.

LIBERO takes its layouts from NumPy's global random numbers. A simulation has its own stream of them, which
stands in for the global one during LIBERO's calls, so that other code neither changes the layouts nor sees
its own numbers changed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saccade_lab.libero import packages
from saccade_lab.libero.drawing import RecordedScene
from saccade_lab.libero.layout import CONTROL_HZ
from saccade_lab.libero.state import Proprioception
from saccade_lab.sim.scenarios import StepOutcome

if TYPE_CHECKING:
    import mujoco

#: Steps of an episode, settling included, after which robosuite refuses to continue.
HORIZON = 1000
ROBOT = "Panda"
CONTROLLER = "OSC_POSE"
SCENE = "recorded_scene"  # name of the observable that records


class Simulation:
    """One task's world. ``restart`` must be called before anything else.

    Args:
        bddl_file: The file that defines the task.

    Attributes:
        inner: robosuite's environment, LIBERO's ``BDDLBaseDomain``, for experts and tests.
        moments: How often the world was recorded; it changes whenever an image would.

    Raises:
        MissingExtraError, PackagesError: As ``packages.require``.
        GraphicsError: OpenGL cannot be loaded.
    """

    def __init__(self, bddl_file: Path) -> None:
        packages.prepare_simulator()
        from robosuite.utils.observables import Observable, sensor

        self._random: tuple[Any, ...] = np.random.RandomState().get_state()  # type: ignore[assignment]
        with self._own_random():
            self.inner = until_placed(lambda: make_inner(bddl_file))
        self.moments = 0
        self._scene: RecordedScene | None = None
        self._values: dict[str, Any] = {}
        # LIBERO appends to this list at every load of the model, and never empties it.
        self._drawn_properties = list(self.inner.object_property_initializers)
        load_sim = self.inner._initialize_sim

        def initialize_sim(xml_string: str | None = None) -> None:
            load_sim(xml_string)
            self.inner.sim.forward()  # robosuite does when it makes its renderer, here left out
            self._scene = None

        self.inner._initialize_sim = initialize_sim

        def record(_: dict[str, Any]) -> npt.NDArray[np.float64]:
            self._record()
            return np.zeros(1)

        recorder = Observable(SCENE, sensor(modality=SCENE)(record), sampling_rate=CONTROL_HZ)
        self.inner.add_observable(recorder)

    def restart(
        self,
        state: npt.NDArray[np.float64] | None,
        seed: int | None,
        *,
        resets: int,
        loads: int | None,
        settle_steps: int,
    ) -> None:
        """Starts an episode.

        Args:
            state: An initial state, or None for the layout that the reset has drawn.
            seed: Of the random numbers; None continues those of the last episode.
            resets: Number of resets after the seed; the last one starts the episode.
            loads: How often the model is taken to have been loaded before, its construction included. None
                for how often it was, attempts without room for all objects included.
            settle_steps: Steps in which the robot stands still with open gripper.
        """
        with self._own_random():
            if seed is not None:
                np.random.seed(seed)  # noqa: NPY002  that is what LIBERO reads
            if loads is not None:
                self.inner.object_property_initializers[:] = self._drawn_properties * loads
            for _ in range(resets):
                self._values = until_placed(self.inner.reset)
            if state is not None:
                self._values = self._set_state(state)
            self._settle(settle_steps)

    def step(self, action: npt.NDArray[np.float64]) -> StepOutcome:
        """One control step of 25 physics steps.

        Args:
            action: ``(7,)``: three of translation, three of rotation, one of the gripper.

        Raises:
            RuntimeError: More than ``HORIZON`` steps since the start.
        """
        with self._own_random():
            return self._step(action)

    @property
    def scene(self) -> RecordedScene:
        """The moment that an observation shows."""
        self._require_start()
        assert self._scene is not None  # a start records it
        return self._scene

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model, another one after each restart."""
        return self.inner.sim.model._model

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's data, other ones after each restart."""
        return self.inner.sim.data._data

    def proprioception(self) -> Proprioception:
        """What the simulator measured of the robot at the moment of ``scene``."""
        self._require_start()
        names = ("robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
        return Proprioception(*(np.array(self._values[name], np.float64) for name in names))

    def is_solved(self) -> bool:
        """Whether the goal is reached now."""
        return bool(self.inner._check_success())

    def close(self) -> None:
        """Frees the world; may be called twice."""
        self._scene = None
        if self.inner.sim is not None:
            self.inner.close()

    def _require_start(self) -> None:
        if not self._values:
            raise RuntimeError("no episode has been started: call reset or restart first")

    def _step(self, action: npt.NDArray[np.float64]) -> StepOutcome:
        self._require_start()
        if self.inner.done:
            raise RuntimeError(f"an episode of LIBERO ends after {HORIZON} steps, settling included")
        self._values, reward, success, _ = self.inner.step(action)
        return StepOutcome(float(reward), bool(success))

    def _settle(self, steps: int) -> None:
        for _ in range(steps):
            self._step(SETTLE_ACTION)

    def _set_state(self, state: npt.NDArray[np.float64]) -> dict[str, Any]:
        """LIBERO's ``set_init_state``."""
        self.inner.sim.set_state_from_flattened(state)
        self.inner.sim.forward()
        self.inner._check_success()
        self.inner._post_process()
        self.inner._update_observables(force=True)
        values: dict[str, Any] = self.inner._get_observations()
        return values

    def _record(self) -> None:
        """Records the scene. The sensor calls it when robosuite would draw."""
        if self._scene is None:
            self._scene = RecordedScene(self.model, self.data)
        self._scene.record()
        self.moments += 1

    @contextlib.contextmanager
    def _own_random(self) -> Iterator[None]:
        """Puts the simulation's random numbers in the place of NumPy's global ones."""
        others = np.random.get_state()  # noqa: NPY002
        np.random.set_state(self._random)  # noqa: NPY002
        try:
            yield
        finally:
            self._random = np.random.get_state()  # type: ignore[assignment]  # noqa: NPY002
            np.random.set_state(others)  # noqa: NPY002


#: No motion, gripper open; what released clients do until objects have come to rest.
SETTLE_ACTION = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])


def until_placed(draw: Callable[[], Any]) -> Any:
    """Calls again while the layout that was drawn has no room for all objects."""
    from robosuite.utils.errors import RandomizationError

    while True:
        try:
            return draw()
        except RandomizationError:
            continue


def make_inner(bddl_file: Path) -> Any:
    """LIBERO's environment with the settings of its ``OffScreenRenderEnv``, but without a renderer."""
    import robosuite
    from libero.libero.envs import TASK_MAPPING
    from libero.libero.envs.bddl_utils import get_problem_info

    return TASK_MAPPING[get_problem_info(str(bddl_file))["problem_name"]](
        str(bddl_file),
        robots=[ROBOT],
        controller_configs=robosuite.load_controller_config(default_controller=CONTROLLER),
        gripper_types="default",
        initialization_noise=None,
        use_camera_obs=False,
        has_renderer=False,
        has_offscreen_renderer=False,
        render_camera="frontview",
        control_freq=CONTROL_HZ,
        horizon=HORIZON,
        ignore_done=False,
        hard_reset=True,
        renderer="mujoco",
        renderer_config=None,
    )
