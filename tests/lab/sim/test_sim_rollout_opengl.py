"""Commands that draw, on a machine whose OpenGL cannot even be loaded."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from saccade.cli import main


def run_without_opengl(folder: Path, *command: str, backend: str = "egl") -> subprocess.CompletedProcess[str]:
    """Runs Python where OpenGL cannot be loaded.

    PyOpenGL looks for the libraries while it is imported, which `import mujoco` does: a machine without them
    fails there. A package that raises simulates such a machine.
    """
    (folder / "OpenGL").mkdir(exist_ok=True)
    (folder / "OpenGL" / "__init__.py").write_text("raise ImportError('Unable to load the library')")
    path = os.pathsep.join([str(folder), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path, "MUJOCO_GL": backend}
    environment.pop("PYOPENGL_PLATFORM", None)  # set by an earlier `import mujoco` in this process
    return subprocess.run(
        [sys.executable, *command], env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
@pytest.mark.parametrize("command", ["rollout", "demos", "attention"])
def test_missing_libraries_are_one_line_with_the_packages(command: str, backend: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = run_without_opengl(tmp_path, "-m", "saccade", command, "--out", str(out), backend=backend)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert "ImportError: Unable to load the library" in done.stderr
    assert ("libosmesa6" if backend == "osmesa" else "libegl1 libegl-mesa0 libgl1-mesa-dri") in done.stderr
    assert done.stdout == ""
    assert not out.exists()


def test_a_missing_mujoco_is_not_taken_for_a_missing_opengl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "mujoco" else find_spec(name)
    )
    assert main(["rollout", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("saccade: mujoco is not installed. Install with: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_training_needs_neither_opengl_nor_the_simulator(tmp_path: Path) -> None:
    recording, out = str(tmp_path / "demos"), str(tmp_path / "policy")
    sizes = ["--image-size", "16", "--frame-stride", "8"]
    assert main(["demos", "--out", recording, "--tasks", "reach", "--episodes", "1", *sizes]) == 0
    options = ["--training-steps", "2", "--batch-size", "2", "--width", "16", "--num-layers", "2"]
    code = (
        "import sys\n"
        "for name in ('mujoco', 'metaworld', 'gymnasium'): sys.modules[name] = None\n"
        "from saccade.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    train = ["train", "--demos", recording, "--out", out, "--patch-size", "8", *options]
    done = run_without_opengl(tmp_path, "-c", code, *train)
    assert (done.returncode, done.stderr) == (0, "")
    assert (Path(out) / "model.safetensors").is_file()


def test_modules_of_the_simulator_load_without_opengl(tmp_path: Path) -> None:
    """What only reads recordings, policies or tables imports them."""
    code = (
        "import saccade_lab.sim.environment, saccade_lab.sim.rollout, saccade_lab.sim.report\n"
        "import saccade_lab.sim.demos\n"
        "try: saccade_lab.sim.environment.TaskEnvironment('reach')\n"
        "except saccade_lab.sim.graphics.GraphicsError as error: print(error)"
    )
    done = run_without_opengl(tmp_path, "-c", code)
    assert (done.returncode, done.stderr) == (0, "")
    assert "ImportError: Unable to load the library" in done.stdout
    assert "apt-get install" in done.stdout


def test_a_forgotten_environment_is_silent_at_exit() -> None:
    code = (
        "import gymnasium, saccade_lab.sim\n"
        "environment = gymnasium.make('saccade/reach-v0', render_mode='rgb_array')\n"
        "environment.reset(seed=0); environment.render()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("interrupted", ["MjrContext", "GLContext"])
def test_a_renderer_whose_construction_is_interrupted_is_silent(interrupted: str) -> None:
    code = (
        "import sys, gymnasium, saccade_lab.sim\n"
        "from saccade_lab.sim import graphics\n"
        "mujoco = graphics.load_mujoco()\n"
        "def interrupt(*args): raise KeyboardInterrupt\n"
        "if sys.argv[1] == 'MjrContext': mujoco.renderer._render.MjrContext = interrupt\n"
        "else:\n"
        "    import mujoco.egl\n"
        "    mujoco.egl.EGL.eglChooseConfig = interrupt\n"
        "environment = gymnasium.make('saccade/reach-v0')\n"
        "try: environment.reset(seed=0)\n"
        "except KeyboardInterrupt: print('interrupted')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, interrupted], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_a_fork_of_a_process_with_an_open_renderer_ends() -> None:
    """It has no threads of Mesa's: closing its copy of the context would wait for them."""
    code = (
        "import os, sys, gymnasium, saccade_lab.sim\n"
        "environment = gymnasium.make('saccade/reach-v0')\n"
        "environment.reset(seed=0)\n"
        "child = os.fork()\n"
        "if child == 0: sys.exit(3)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
        "environment.close()"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120
        )
    except subprocess.TimeoutExpired:
        pytest.fail("the fork did not end")
    assert (done.returncode, done.stdout) == (0, "3\n")
