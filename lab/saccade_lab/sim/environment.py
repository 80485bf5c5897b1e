"""The gymnasium environment: a Meta-World task with camera images and a text instruction."""

from collections.abc import Collection, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from saccade._internal.arrays import UInt8Array
from saccade.errors import InputError, ShapeError
from saccade_lab.sim import graphics
from saccade_lab.sim.cameras import DEFAULT_CAMERAS, DEFAULT_IMAGE_SIZE, VIDEO_CAMERA, CameraPose
from saccade_lab.sim.rendering import Renderer, prepare_model
from saccade_lab.sim.scenarios import StepOutcome
from saccade_lab.sim.tasks import ACTION_DIM, PROPRIO_DIM, find_task

#: ``{"images": {camera: (H, W, 3) uint8}, "proprio": (4,) float32, "instruction": str}``
SimulatedObservation = dict[str, Any]

VIDEO_SIZE = 360
SIMULATION_HZ = 80  # control steps in a second of simulated time
#: Bounds of the proprioception, to which Meta-World clips it: the hand in metres, the gripper's opening.
PROPRIO_LOW = np.array([-0.525, 0.348, -0.0525, 0.0], np.float32)
PROPRIO_HIGH = np.array([0.525, 1.025, 0.7, 1.0], np.float32)


class TaskEnvironment(gymnasium.Env[SimulatedObservation, npt.NDArray[np.float32]]):
    """One task as a language-conditioned pixel task.

    An observation contains what a real robot would have: images, proprioception and the instruction. It does
    not contain positions of objects and goals; experts and training targets get them from
    ``privileged_state``.

    Create it by name, ``gymnasium.make("saccade/reach-v0")``, after ``import saccade_lab.sim``. The same seed
    gives
    the same layout, wording and pixels. An episode ends (``terminated``) at its first success.

    Args:
        task: Its name, see ``saccade_lab.sim.tasks``.
        image_size: Pixels along each side.
        cameras: Those of the policy.
        blanked: Names of cameras whose images are black, to test what the policy does without them.
        render_mode: ``"rgb_array"`` lets ``render`` draw the whole robot for videos.

    Raises:
        InputError: Unknown task, unusable image size or cameras, or a blanked name without a camera.
        GraphicsError: OpenGL cannot be loaded.

    Example:
        >>> env = TaskEnvironment("push")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info["success"]
        False
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": SIMULATION_HZ}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        *,
        image_size: int = DEFAULT_IMAGE_SIZE,
        cameras: Sequence[CameraPose] = DEFAULT_CAMERAS,
        blanked: Collection[str] = (),
        render_mode: str | None = None,
    ) -> None:
        if image_size < 8:
            raise InputError(f"image_size: given {image_size}, expected at least 8")
        if not cameras or len({camera.name for camera in cameras}) != len(cameras):
            raise InputError("cameras: expected at least one, each with a name of its own")
        names = [camera.name for camera in cameras]
        if isinstance(blanked, str) or not set(blanked) <= set(names):
            raise InputError(f"blanked: given {blanked!r}, expected names out of {', '.join(names)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode: given {render_mode!r}, expected 'rgb_array' or None")
        self.task = find_task(task)
        self.cameras = tuple(cameras)
        self.blanked = frozenset(blanked)
        self.image_size = image_size
        self.render_mode = render_mode
        self.instruction = self.task.instructions[0]
        self.observation_space = observation_space(self.cameras, image_size)
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

        self._world = make_world(self.task.scene)
        # Otherwise every seed would give the same layout.
        self._world._freeze_rand_vec = False
        self._world.seeded_rand_vec = True
        self._world._set_task_called = True
        self._world._partially_observable = False  # experts need the goal; the policy gets `observe` only
        # Meta-World clips its observations to this cached space. It was computed while the goal was hidden
        # and would clip the goal to zero.
        self._world.__dict__.pop("sawyer_observation_space", None)
        self.scenario = self.task.scenario(self._world)
        prepare_model(self._world.model, draws_goal=self.task.draws_goal)
        self._full_state = np.zeros(39)
        self._steps = 0
        self.last_observation: SimulatedObservation = {}
        self._renderer: Renderer | None = None
        self._video_renderer: Renderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[SimulatedObservation, dict[str, Any]]:
        """Starts an episode; without a seed, one of the evaluation seeds is drawn."""
        super().reset(seed=seed)
        self.restart(int(self.np_random.integers(1_000_000)) if seed is None else seed)
        return self.observe(), {"success": False, "task": self.task.name}

    def step(self, action: npt.ArrayLike) -> tuple[SimulatedObservation, float, bool, bool, dict[str, Any]]:
        """Applies one action ``(4,)``, clipped to [-1, 1]; ``info["success"]``: whether the task is done."""
        outcome = self.advance(action)
        truncated = self._steps >= self.task.max_steps and not outcome.success
        info = {"success": outcome.success, "task": self.task.name}
        return self.observe(), outcome.reward, outcome.success, truncated, info

    def restart(self, seed: int) -> None:
        """Like ``reset``, without drawing an observation."""
        self.instruction = self.task.instruction(seed)
        self._world.seed(seed)
        self._full_state, _ = self._world.reset()
        self.scenario.start(seed)
        # Meta-World moves the goal marker in the model only. Without this the picture shows the marker of the
        # last episode.
        graphics.load_mujoco().mj_forward(self._world.model, self._world.data)
        self._steps = 0

    def advance(self, action: npt.ArrayLike) -> StepOutcome:
        """Like ``step``, without drawing an observation, which policies need only once per chunk.

        Args:
            action: ``(4,)``, clipped to [-1, 1].

        Raises:
            ShapeError, InputError: ``action`` has another shape, or is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (ACTION_DIM,):
            raise ShapeError(f"action: given shape {action.shape}, expected ({ACTION_DIM},)")
        if not np.isfinite(action).all():
            raise InputError(f"action: expected finite numbers, given {action}")
        self._full_state, reward, _, _, info = self._world.step(np.clip(action, -1.0, 1.0))
        self._steps += 1
        return self.scenario.outcome(float(reward), bool(info["success"]))

    def observe(self) -> SimulatedObservation:
        """The current observation; also stored as ``last_observation``."""
        self.last_observation = {
            "images": {camera.name: self._picture(camera) for camera in self.cameras},
            "proprio": self._full_state[:PROPRIO_DIM].astype(np.float32),
            "instruction": self.instruction,
        }
        return self.last_observation

    def _picture(self, camera: CameraPose) -> UInt8Array:
        """The current image of one of the policy's cameras."""
        if camera.name in self.blanked:
            return np.zeros((self.image_size, self.image_size, 3), dtype=np.uint8)
        if self._renderer is None:
            self._renderer = Renderer(self._world.model, self.image_size)
        return self._renderer.draw(self._world.data, camera, self.scenario.balls())

    def render(self) -> UInt8Array | None:
        """The whole robot from the side, ``(360, 360, 3)``, if ``render_mode`` is ``"rgb_array"``."""
        if self.render_mode is None:
            return None
        if self._video_renderer is None:
            self._video_renderer = Renderer(self._world.model, VIDEO_SIZE, for_video=True)
        return self._video_renderer.draw(self._world.data, VIDEO_CAMERA, self.scenario.balls())

    def privileged_state(self) -> npt.NDArray[np.float64]:
        """Meta-World's own observation ``(39,)``, goal included. For experts; never for a policy."""
        return self._full_state.copy()

    def privileged_targets(self) -> npt.NDArray[np.float32]:
        """Positions of the object and of the goal ``(6,)``, metres: training targets, never an input.

        In tasks with balls these are the first and the last ball, also after they have vanished.
        """
        return self.scenario.targets(self._full_state).astype(np.float32)

    def fingertips(self) -> npt.NDArray[np.float64]:
        """The point between the fingertips ``(3,)``, metres, which decides the success of a reach."""
        return np.asarray(self._world.tcp_center, dtype=np.float64).copy()

    def close(self) -> None:
        """Frees the OpenGL contexts; may be called twice."""
        for renderer in (self._renderer, self._video_renderer):
            if renderer is not None:
                renderer.close()
        self._renderer = self._video_renderer = None
        self._world.close()


def make_world(scene: str) -> Any:
    """The Meta-World environment of that name.

    Raises:
        GraphicsError: OpenGL cannot be loaded.
        ModuleNotFoundError: Mujoco or metaworld is not installed.
    """
    graphics.load_mujoco()  # metaworld imports it too, with a less helpful error where OpenGL is missing
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    return ALL_V3_ENVIRONMENTS[scene]()


def observation_space(cameras: Sequence[CameraPose], image_size: int) -> spaces.Dict:
    """The space of ``TaskEnvironment.observe``."""
    shape = (image_size, image_size, 3)
    return spaces.Dict(
        {
            "images": spaces.Dict({camera.name: spaces.Box(0, 255, shape, np.uint8) for camera in cameras}),
            "proprio": spaces.Box(PROPRIO_LOW, PROPRIO_HIGH, dtype=np.float32),
            "instruction": spaces.Text(max_length=200, charset=spaces.text.alphanumeric | frozenset(" ,.'-")),
        }
    )
