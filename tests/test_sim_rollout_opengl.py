"""Commands that draw, on a machine whose OpenGL cannot even be loaded."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from saccade.cli import main


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
@pytest.mark.parametrize("command", ["rollout", "demos"])
def test_missing_libraries_are_one_line_with_the_packages(command: str, backend: str, tmp_path: Path) -> None:
    # PyOpenGL looks for the libraries while it is imported, which `import mujoco` does: so a machine without
    # them fails there already. A package that raises stands in for such a machine.
    (tmp_path / "OpenGL").mkdir()
    (tmp_path / "OpenGL" / "__init__.py").write_text("raise ImportError('Unable to load the library')")
    out = tmp_path / "out"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "MUJOCO_GL": backend}
    environment.pop("PYOPENGL_PLATFORM", None)  # set by an earlier `import mujoco` in this process
    done = subprocess.run(
        [sys.executable, "-m", "saccade", command, "--out", str(out)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert "ImportError: Unable to load the library" in done.stderr
    assert ("libosmesa6" if backend == "osmesa" else "libegl1 libegl-mesa0 libgl1-mesa-dri") in done.stderr
    assert done.stdout == ""
    assert not out.exists()


def test_a_missing_mujoco_is_not_taken_for_a_missing_opengl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["rollout", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == "saccade: mujoco is not installed: pip install 'saccade[sim]'\n"
    assert not (tmp_path / "out").exists()
