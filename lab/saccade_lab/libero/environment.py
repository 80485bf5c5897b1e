"""The gymnasium environment: a task of LIBERO with its two camera images, state and instruction."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from saccade._internal.arrays import UInt8Array
from saccade.errors import InputError, ShapeError
from saccade_lab.libero.drawing import CAMERAS, CameraRenderer
from saccade_lab.libero.layout import ACTION_DIM, CONTROL_HZ
from saccade_lab.libero.simulation import Simulation
from saccade_lab.libero.state import Float32Array, Proprioception, isaac_state, lerobot_state
from saccade_lab.libero.suites import find_task, initial_states
from saccade_lab.sim.scenarios import StepOutcome

#: ``{"images": {name: (H, W, 3) uint8}, "state": (8,) float32, "instruction": str}``
LiberoObservation = dict[str, Any]

DEFAULT_IMAGE_SIZE = 256
DEFAULT_SETTLE_STEPS = 10
SEEDS = 2**32  # NumPy's legacy generator takes seeds below this
#: Bounds of the state: the hand in metres, its rotation vector in radians, the finger joints in metres.
STATE_HIGH = np.array([3.0] * 3 + [2 * np.pi + 0.01] * 3 + [0.1] * 2, np.float32)


class LiberoEnvironment(gymnasium.Env[LiberoObservation, npt.NDArray[np.float32]]):
    """One task of LIBERO or LIBERO-PRO.

    An observation is what released clients give to a policy: both cameras turned by 180 degrees (upright, and
    mirrored), the state vector (see ``state``) and the instruction (see ``suites``). Images are drawn only by
    ``observe``, so ``advance`` is the cheap way through a chunk of actions.

    Create it by name, ``gymnasium.make("saccade/libero_object-0-v0")``, after ``import saccade_lab.libero``.
    Every episode starts with a hard reset, 2 seconds: a soft one leaves other pixels. The same initial state
    and seed give the same pixels. An episode ends (``terminated``) at its first success.

    Args:
        suite: Name of the suite, such as ``libero_object``.
        task: Number of the task in it, from 0.
        image_size: Pixels along each side.
        max_steps: Control steps after which ``step`` says ``truncated``, settling not counted; None: those of
            the suite.
        settle_steps: Control steps at the start in which the robot stands still until objects have come to
            rest.
        official_states: Start from the official initial states. Otherwise from the layout that a reset draws
            from the seed, which is what Isaac-GR00T's client of N1.6 and N1.7 does.
        state_of: ``"isaac"`` or ``"lerobot"``: whose arithmetic gives the state vector.
        render_mode: ``"rgb_array"`` lets ``render`` return the picture of the first camera.

    Attributes:
        task: The task: its names and words.
        success: Whether the goal was reached after the last step.
        steps: Control steps since the start, settling not counted.
        last_observation: What ``observe`` returned last.

    Raises:
        InputError: An argument is unusable.
        MissingExtraError, PackagesError: LIBERO's packages are missing, or are not those that were tested.
        GraphicsError: OpenGL cannot be loaded.

    Example:
        >>> env = LiberoEnvironment("libero_object", 7)
        >>> observation, info = env.reset(seed=0, options={"state": 3})
        >>> observation["images"]["wrist_image"].shape, observation["instruction"]
        ((256, 256, 3), 'pick up the milk and place it in the basket')
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}  # noqa: RUF012

    def __init__(
        self,
        suite: str,
        task: int,
        *,
        image_size: int = DEFAULT_IMAGE_SIZE,
        max_steps: int | None = None,
        settle_steps: int = DEFAULT_SETTLE_STEPS,
        official_states: bool = True,
        state_of: str = "isaac",
        render_mode: str | None = None,
    ) -> None:
        for name, value, least in (
            ("image_size", image_size, 8),
            ("max_steps", 1 if max_steps is None else max_steps, 1),
            ("settle_steps", settle_steps, 0),
        ):
            if value < least:
                raise InputError(f"{name}: given {value}, expected at least {least}")
        if state_of not in ("isaac", "lerobot"):
            raise InputError(f"state_of: given {state_of!r}, expected 'isaac' or 'lerobot'")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode: given {render_mode!r}, expected 'rgb_array' or None")
        self.task = find_task(suite, task)
        self.image_size = image_size
        self.max_steps = self.task.suite.max_steps if max_steps is None else max_steps
        self.settle_steps = settle_steps
        self.render_mode = render_mode
        self.instruction = self.task.instruction
        self.initial_states = initial_states(self.task) if official_states else None
        self.observation_space = observation_space(self.instruction, image_size)
        self.action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
        self.success = False
        self.steps = 0
        self.last_observation: LiberoObservation = {}
        self._state_of = state_of
        self.simulation = Simulation(self.task.bddl_file)
        self._renderer: CameraRenderer | None = None
        self._pictures: dict[str, tuple[int, UInt8Array]] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[LiberoObservation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Of the layout: of everything, or with an official state of cabinets and stoves, which such a
                state does not contain. Without one, a seed is drawn.
            options: ``{"state": index}`` chooses the official initial state. Without it, one is drawn.

        Raises:
            InputError: An unknown option, or no such state.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        state = chosen.pop("state", None)
        if chosen:
            raise InputError(f"options: given {', '.join(map(repr, chosen))}, expected only 'state'")
        if state is None and self.initial_states is not None:
            state = int(self.np_random.integers(len(self.initial_states)))
        self.restart(state, int(self.np_random.integers(SEEDS)) if seed is None else seed)
        return self.observe(), {"success": self.success, "state": state}

    def step(self, action: npt.ArrayLike) -> tuple[LiberoObservation, float, bool, bool, dict[str, Any]]:
        """Applies one action ``(7,)``; ``info["success"]``: whether the task is done."""
        outcome = self.advance(action)
        truncated = self.steps >= self.max_steps and not outcome.success
        return self.observe(), outcome.reward, outcome.success, truncated, {"success": outcome.success}

    def restart(
        self, state: int | None, seed: int | None, *, resets: int = 1, loads: int | None = None
    ) -> None:
        """Like ``reset``, without drawing an observation.

        Cabinets and stoves stand where the reset draws them, also with an official state. Where they stand
        depends on the seed and, because LIBERO keeps a list that grows with every reset, on the number of
        earlier resets. Two arguments repeat what a released client does in its n-th episode (from 0) of a
        task, in one environment:

        - lerobot seeds before each episode: ``seed=1000 + n, loads=2 + n``.
        - Isaac-GR00T's client of N1.5 seeds once: ``seed=0, resets=1 + n``.

        Args:
            state: Number of the official initial state. None for the layout that the reset draws.
            seed: Of the layout, below 2^32. None continues the random numbers of the last episode.
            resets: Number of resets after the seed, 2 seconds each; the last one starts the episode.
            loads: Number of earlier resets that count, and 1 for the construction. None for 1 with a seed,
                and without one for those that there were, attempts without room for all objects included.

        Raises:
            InputError: An argument is out of range, or ``state`` does not fit ``official_states``.
            RuntimeError: The environment is closed.
        """
        self._require_open()
        states = self.initial_states
        if (state is None) != (states is None):
            expected = "None" if states is None else "the number of a state"
            raise InputError(
                f"state: given {state}, expected {expected}, because official_states is {states is not None}"
            )
        if state is not None and states is not None and not 0 <= state < len(states):
            raise InputError(f"state: given {state}, expected 0 to {len(states) - 1}")
        if seed is not None and not 0 <= seed < SEEDS:
            raise InputError(f"seed: given {seed}, expected 0 to {SEEDS - 1}")
        for name, value in (("resets", resets), ("loads", loads)):
            if value is not None and value < 1:
                raise InputError(f"{name}: given {value}, expected at least 1")
        self._close_renderer()  # its model is about to be replaced
        self.simulation.restart(
            None if state is None or states is None else states[state],
            seed,
            resets=resets,
            loads=1 if loads is None and seed is not None else loads,
            settle_steps=self.settle_steps,
        )
        self.steps = 0
        self.success = self.simulation.is_solved()

    def advance(self, action: npt.ArrayLike) -> StepOutcome:
        """Like ``step``, without drawing an observation, which policies need only once per chunk.

        Args:
            action: ``(7,)``: translation (1 is 5 cm a step), rotation vector (1 is 0.5 rad), gripper
                (negative opens, positive closes). LIBERO clips the first six to [-1, 1] and takes the sign
                of the last.

        Raises:
            ShapeError, InputError: ``action`` has another shape, or is not finite.
            RuntimeError: The environment is closed, or the episode has lasted for 1000 steps, settling
                included, after which robosuite refuses to continue.
        """
        self._require_open()
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (ACTION_DIM,):
            raise ShapeError(f"action: given shape {action.shape}, expected ({ACTION_DIM},)")
        if not np.isfinite(action).all():
            raise InputError(f"action: expected finite numbers, given {action}")
        outcome = self.simulation.step(action)
        self.steps += 1
        self.success = outcome.success
        return outcome

    def observe(self) -> LiberoObservation:
        """The current observation; also stored as ``last_observation``."""
        self.last_observation = {
            "images": {name: self._picture(name) for name in CAMERAS},
            "state": self.state(),
            "instruction": self.instruction,
        }
        return self.last_observation

    def state(self) -> Float32Array:
        """The state vector ``(8,)`` of the current observation, without drawing."""
        measured = self.proprioception()
        if self._state_of == "lerobot":
            return lerobot_state(measured)
        return isaac_state(measured).astype(np.float32)

    def proprioception(self) -> Proprioception:
        """What the state vector is computed from, in float64."""
        self._require_open()
        return self.simulation.proprioception()

    def render(self) -> UInt8Array | None:
        """The first camera's picture ``(H, W, 3)`` as a policy sees it, if ``render_mode`` asks for it."""
        return None if self.render_mode is None else self._picture(next(iter(CAMERAS))).copy()

    def close(self) -> None:
        """Frees the world and the OpenGL context; may be called twice."""
        self._close_renderer()
        self.simulation.close()

    def _picture(self, name: str) -> UInt8Array:
        """The current image of a camera, drawn once for every recorded moment."""
        self._require_open()
        moment, scene = self.simulation.moments, self.simulation.scene
        drawn = self._pictures.get(name)
        if drawn is None or drawn[0] != moment:
            if self._renderer is None:
                self._renderer = CameraRenderer(self.simulation.model, self.image_size)
            drawn = (moment, self._renderer.draw(scene, CAMERAS[name]))
            self._pictures[name] = drawn
        return drawn[1]

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._pictures.clear()

    def _require_open(self) -> None:
        if self.simulation.inner.sim is None:
            raise RuntimeError("this environment is closed")


def observation_space(instruction: str, image_size: int) -> spaces.Dict:
    """The space of ``LiberoEnvironment.observe``."""
    shape = (image_size, image_size, 3)
    return spaces.Dict(
        {
            "images": spaces.Dict({name: spaces.Box(0, 255, shape, np.uint8) for name in CAMERAS}),
            "state": spaces.Box(-STATE_HIGH, STATE_HIGH, dtype=np.float32),
            "instruction": spaces.Text(
                min_length=1, max_length=200, charset=spaces.text.alphanumeric | frozenset(instruction)
            ),
        }
    )
