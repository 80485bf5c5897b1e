"""The environments of LIBERO in the simulator: against LIBERO's own wrapper, in the same process."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env

import saccade_lab.libero  # noqa: F401  (registers the environments)
from saccade import InputError, ShapeError
from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.simulation import HORIZON
from saccade_lab.libero.suites import SUITES, find_task, initial_states
from tests.helpers.paths import ROOT
from tests.libero.released_clients import STAND, actions

STOVE = ("libero_goal", 7)  # turn on the stove: its burner is a site that changes its colour
DRAWER = ("libero_spatial", 4)  # a drawer is open at the start, so earlier resets change the layout
CHEAP: dict[str, Any] = {"image_size": 32, "settle_steps": 0}


@contextlib.contextmanager
def make(suite: str, task: int, **options: Any) -> Iterator[LiberoEnvironment]:
    with contextlib.closing(LiberoEnvironment(suite, task, **options)) as environment:
        yield environment


class Original:
    """LIBERO's own wrapper of the same task, which draws every step.

    robosuite draws in whatever OpenGL context is current, so its own is made current before.
    """

    def __init__(self, environment: LiberoEnvironment) -> None:
        from libero.libero.envs import OffScreenRenderEnv

        size, file = environment.image_size, str(environment.task.bddl_file)
        self.wrapper = OffScreenRenderEnv(bddl_file_name=file, camera_heights=size, camera_widths=size)

    def start(self, seed: int, state: npt.NDArray[np.float64], settle_steps: int) -> Any:
        """What released clients do."""
        self._make_current()
        self.wrapper.seed(seed)
        self.wrapper.reset()
        values = self.wrapper.set_init_state(state)
        for _ in range(settle_steps):
            values, *_ = self.wrapper.step(STAND)
        return values

    def step(self, action: Any) -> Any:
        self._make_current()
        return self.wrapper.step(action)

    def close(self) -> None:
        self._make_current()
        self.wrapper.close()

    def _make_current(self) -> None:
        self.wrapper.sim._render_context_offscreen.gl_ctx.make_current()


def same(ours: LiberoEnvironment, theirs: Original, values: Any) -> None:
    """Pixels, measurements and the whole physical state."""
    images, measured = ours.observe()["images"], ours.proprioception()
    np.testing.assert_array_equal(images["image"], values["agentview_image"][::-1, ::-1])
    np.testing.assert_array_equal(images["wrist_image"], values["robot0_eye_in_hand_image"][::-1, ::-1])
    np.testing.assert_array_equal(measured.position, values["robot0_eef_pos"])
    np.testing.assert_array_equal(measured.quaternion, values["robot0_eef_quat"])
    np.testing.assert_array_equal(measured.fingers, values["robot0_gripper_qpos"])
    state = ours.simulation.inner.sim.get_state().flatten()
    np.testing.assert_array_equal(state, theirs.wrapper.get_sim_state())


@pytest.mark.parametrize("image_size", [100, 500])  # LIBERO's buffers have 640 x 480
def test_every_observation_is_that_of_liberos_wrapper(image_size: int) -> None:
    with (
        make("libero_object", 3, image_size=image_size) as ours,
        contextlib.closing(Original(ours)) as theirs,
    ):
        ours.restart(49, 7)
        same(ours, theirs, theirs.start(7, ours.initial_states[49], 10))  # type: ignore[index]
        for action in actions()[:3]:
            values, reward, done, _ = theirs.step(action)
            outcome = ours.advance(action)
            assert (outcome.reward, outcome.success) == (reward, done)
            same(ours, theirs, values)


def test_a_burner_that_has_just_been_lit_is_drawn_a_step_later() -> None:
    """robosuite draws inside a step, LIBERO changes the colour at its end."""
    options = CHEAP | {"image_size": 64}
    with make(*STOVE, **options) as ours, contextlib.closing(Original(ours)) as theirs:
        ours.restart(0, 0)
        theirs.start(0, ours.initial_states[0], 0)  # type: ignore[index]
        pictures = []
        for step in range(3):
            if step == 1:
                for world in (ours.simulation.inner, theirs.wrapper.env):
                    (knob,) = world.get_object("flat_stove_1").joints
                    world.sim.data.set_joint_qpos(knob, 1.0)
            values, *_ = theirs.step(STAND)
            ours.advance(STAND)
            same(ours, theirs, values)
            pictures.append(values["agentview_image"])
        assert ours.success
        assert np.abs(pictures[2].astype(int) - pictures[1]).max() > 50  # it glows


def test_where_a_cabinet_stands_depends_on_the_seed_and_on_earlier_resets() -> None:
    def cabinets(environment: LiberoEnvironment, **start: int) -> npt.NDArray[np.float64]:
        environment.restart(0, **start)
        return np.array(environment.simulation.model.body_pos)

    with make(*DRAWER, **CHEAP) as environment:
        first = cabinets(environment, seed=0)
        assert np.abs(cabinets(environment, seed=1) - first).max() > 1e-4
        assert np.abs(cabinets(environment, seed=0, loads=2) - first).max() > 1e-4
        assert np.abs(cabinets(environment, seed=0, resets=2) - first).max() > 1e-4
        np.testing.assert_array_equal(cabinets(environment, seed=0), first)


def test_nothing_is_drawn_until_somebody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    import mujoco

    drawn = []
    render = mujoco.Renderer.render

    def counted(self: Any) -> Any:
        drawn.append(self)
        return render(self)

    monkeypatch.setattr(mujoco.Renderer, "render", counted)
    with make("libero_object", 0, render_mode="rgb_array", **CHEAP) as environment:
        environment.restart(0, 0)
        for action in actions():
            environment.advance(action)
        assert drawn == []
        seen = environment.observe()["images"]["image"]
        assert len(drawn) == 2
        np.testing.assert_array_equal(environment.render(), seen)
        environment.observe()
        assert len(drawn) == 2


def test_two_environments_in_turn_have_the_pictures_of_each_alone() -> None:
    with make("libero_object", 0, **CHEAP) as one, make("libero_goal", 0, **CHEAP) as other:
        found = []
        for environments in ((one,), (other,), (one, other)):
            for environment in environments:
                environment.restart(0, 0)
            for action in actions()[:2]:
                for environment in environments:
                    environment.advance(action)
                    environment.observe()
            found += [environment.last_observation["images"] for environment in environments]
    for name in ("image", "wrist_image"):
        np.testing.assert_array_equal(found[0][name], found[2][name])
        np.testing.assert_array_equal(found[1][name], found[3][name])
        assert not np.array_equal(found[0][name], found[1][name])


def test_other_random_numbers_are_left_alone() -> None:
    with make("libero_object", 0, official_states=False, **CHEAP) as environment:
        environment.restart(None, 3)
        layout = environment.simulation.data.qpos.copy()
        np.random.seed(8)  # noqa: NPY002
        expected = np.random.random(3)  # noqa: NPY002
        np.random.seed(8)  # noqa: NPY002
        environment.restart(None, 3)
        environment.advance(STAND)
        np.testing.assert_array_equal(np.random.random(3), expected)  # noqa: NPY002
        environment.restart(None, 3)
        np.testing.assert_array_equal(environment.simulation.data.qpos, layout)
        environment.restart(None, None)
        assert np.abs(environment.simulation.data.qpos - layout).max() > 1e-3


def test_gymnasiums_checker_has_no_complaint() -> None:
    # Its instruction has an apostrophe that is not in ASCII.
    environment = gymnasium.make("saccade/libero_goal_lan-0-v0", render_mode="rgb_array", **CHEAP)
    with warnings.catch_warnings(), contextlib.closing(environment):
        warnings.simplefilter("error")
        check_env(environment.unwrapped, skip_close_check=True)


def test_a_chosen_state_and_the_limit_of_steps() -> None:
    with make("libero_object", 0, max_steps=2, **CHEAP) as environment:
        observation, info = environment.reset(seed=1, options={"state": 4})
        assert info == {"success": False, "state": 4}
        assert observation in environment.observation_space
        assert observation["state"].dtype == np.float32
        assert environment.step(STAND)[2:4] == (False, False)
        observation, _, terminated, truncated, _ = environment.step(np.zeros(7))
        assert (terminated, truncated, environment.steps) == (False, True, 2)
        with pytest.raises(InputError, match="options: given 'states', expected only 'state'"):
            environment.reset(options={"states": 1})


def test_wrong_arguments_are_named() -> None:
    with make("libero_object", 0, **CHEAP) as environment:
        for early in (environment.observe, environment.state, lambda: environment.advance(STAND)):
            with pytest.raises(RuntimeError, match="no episode has been started"):
                early()
        for start, problem in (
            ({"state": None, "seed": 0}, "state: given None, expected the number of a state"),
            ({"state": 50, "seed": 0}, "state: given 50, expected 0 to 49"),
            ({"state": -1, "seed": 0}, "state: given -1"),
            ({"state": 0, "seed": 2**32}, "seed: given 4294967296, expected 0 to 4294967295"),
            ({"state": 0, "seed": 0, "resets": 0}, "resets: given 0, expected at least 1"),
        ):
            with pytest.raises(InputError, match=problem):
                environment.restart(**start)
        environment.restart(0, 0)
        with pytest.raises(ShapeError, match=r"action: given shape \(6,\), expected \(7,\)"):
            environment.advance(np.zeros(6))
        with pytest.raises(InputError, match="action: expected finite numbers"):
            environment.advance(np.full(7, np.nan))
    environment.close()
    for call in (environment.observe, lambda: environment.advance(STAND), lambda: environment.restart(0, 0)):
        with pytest.raises(RuntimeError, match="this environment is closed"):
            call()


def test_the_horizon_of_robosuite_is_named() -> None:
    with make("libero_object", 0, **CHEAP) as environment:
        environment.restart(0, 0)
        environment.simulation.inner.timestep = HORIZON - 1
        environment.advance(STAND)
        with pytest.raises(RuntimeError, match="an episode of LIBERO ends after 1000 steps"):
            environment.advance(STAND)


def test_a_layout_without_room_is_drawn_again() -> None:
    from robosuite.utils.errors import RandomizationError

    with make("libero_object", 0, official_states=False, **CHEAP) as environment:
        inner, tried = environment.simulation.inner, []
        reset = inner.reset

        def unlucky() -> Any:
            tried.append(0)
            if len(tried) < 3:
                raise RandomizationError("no room")
            return reset()

        inner.reset = unlucky
        environment.restart(None, 0)
        assert len(tried) == 3
        assert not environment.advance(STAND).success


def test_every_suite_has_its_tasks_words_and_states() -> None:
    for suite in SUITES.values():
        for index in range(suite.num_tasks):
            task = find_task(suite.name, index)
            states = initial_states(task)
            assert states.shape[0] == 50
            assert states.ndim == 2
            assert task.name == find_task(suite.base, index).name
            if suite.name == suite.base or not suite.name.endswith(("_lan", "_task")):
                assert task.instruction == task.words_of_name
                assert task.instruction == task.instruction.lower()
            else:
                assert task.instruction == task.words_of_file != task.words_of_name
    assert (
        find_task("libero_object_task", 0).instruction == "Pick the cream cheese and place it in the basket"
    )
    assert find_task("libero_object_lan", 0).instruction == "grab alphabet soup and put it into basket"


@pytest.mark.parametrize("suite", [name for name, suite in SUITES.items() if name != suite.base])
def test_a_task_of_each_perturbed_suite_starts_steps_and_is_drawn(suite: str) -> None:
    with make(suite, 9, **CHEAP) as environment:
        environment.restart(1, 0)
        assert not environment.advance(STAND).success
        observation = environment.observe()
        assert observation in environment.observation_space
        assert observation["images"]["image"].std() > 10


def test_the_home_directory_is_left_alone_and_nothing_is_printed(tmp_path: Path) -> None:
    code = (
        "import saccade_lab.libero\n"
        "from saccade_lab.libero.environment import LiberoEnvironment\n"
        "environment = LiberoEnvironment('libero_object', 0, image_size=16, settle_steps=0)\n"
        "environment.restart(0, 0)\n"
        "environment.observe()\n"  # and not closed: the interpreter does
    )
    variables = {"HOME": str(tmp_path), "MPLCONFIGDIR": str(tmp_path / "mpl")}
    variables |= {
        name: value for name, value in os.environ.items() if name not in ("HOME", "LIBERO_CONFIG_PATH")
    }
    variables["HOME"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=variables
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not list(tmp_path.rglob("*libero*"))


def test_the_code_on_the_page_runs() -> None:
    page = (ROOT / "docs" / "libero.md").read_text()
    (block,) = re.findall(r"^```py\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    exec(block, {})
