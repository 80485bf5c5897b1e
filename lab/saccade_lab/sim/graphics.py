"""OpenGL without a window: the backend that MuJoCo draws with, and whether it works on this machine.

MuJoCo loads OpenGL when it is imported. Modules of this package therefore import MuJoCo when they first need
it, through ``load_mujoco``: what draws nothing (training, reports, reading recordings) runs without OpenGL.
"""

import functools
import importlib
import importlib.util
import os
import re
import subprocess
import sys
from types import ModuleType

from saccade.errors import SaccadeError

# Draws one picture of an empty scene and prints one line. It runs in a process of its own, because a missing
# or broken OpenGL may abort the process.
PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 16, 16)
renderer.update_scene(data)
renderer.render()
renderer.close()
print("drawn")
"""
PROBE_SECONDS = 60  # a second is typical; a cold disk takes longer

PACKAGES = {
    "egl": "libegl1 libegl-mesa0 libgl1-mesa-dri",
    "osmesa": "libosmesa6",
    "glfw": "libglfw3 and a display",
}


class GraphicsError(SaccadeError):
    """OpenGL cannot draw on this machine; the message names the packages that provide it."""


def choose_backend() -> None:
    """Selects EGL unless the user chose a backend, and keeps Mesa's software renderer on the calling thread.

    Sets the environment variables ``MUJOCO_GL``, which is read when mujoco is imported, and
    ``LP_NUM_THREADS``, which is read when the first OpenGL context is created. At 64 pixels additional
    drawing threads cost more time than they save.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("LP_NUM_THREADS", "0")


@functools.cache
def load_mujoco() -> ModuleType:
    """Imports MuJoCo, which loads OpenGL.

    Raises:
        GraphicsError: OpenGL cannot be loaded.
        ModuleNotFoundError: Mujoco is not installed.
    """
    choose_backend()
    try:
        mujoco = importlib.import_module("mujoco")
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        if isinstance(error, ModuleNotFoundError):
            raise
        raise GraphicsError(advice(f"{type(error).__name__}: {error}")) from error
    # Both classes free these in `__del__`, but set them late in `__init__`. If Ctrl-C interrupts `__init__`,
    # `__del__` would print an AttributeError.
    mujoco.Renderer._gl_context = mujoco.Renderer._mjr_context = None
    if mujoco.gl_context.GLContext is not None:
        mujoco.gl_context.GLContext._context = None
    return mujoco


def load_triton_first() -> None:
    """Imports torch's compiler, if it is installed, before OpenGL is used.

    Both contain a copy of LLVM. Mesa's may be loaded second. Loading triton after Mesa's ends the process,
    and torch loads triton by itself in some later call. The import takes a fifth of a second.
    """
    if importlib.util.find_spec("triton") is not None:
        importlib.import_module("triton")


def check() -> None:
    """Draws one picture in another process.

    Raises:
        GraphicsError: Drawing failed; names the Debian packages and the cause.
        ModuleNotFoundError: Mujoco is not installed.
    """
    if importlib.util.find_spec("mujoco") is None:
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")
    choose_backend()
    try:
        outcome = subprocess.run(
            [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise GraphicsError(advice(f"no answer within {PROBE_SECONDS} seconds")) from None
    if outcome.returncode != 0 or "drawn" not in outcome.stdout:
        errors = outcome.stderr.strip().splitlines() or [
            f"the process ended with status {outcome.returncode}"
        ]
        # The interpreter may print errors of clean-up after the first exception, which says the most.
        reasons = [line for line in errors if re.match(r"[\w.]*Error\b", line)]
        raise GraphicsError(advice((reasons or errors)[0].strip()))


def advice(reason: str) -> str:
    """What failed, and which packages to install."""
    backend = os.environ.get("MUJOCO_GL", "egl")
    packages = PACKAGES.get(backend, PACKAGES["egl"])
    other = "" if backend == "osmesa" else f" (or {PACKAGES['osmesa']} and MUJOCO_GL=osmesa)"
    return (
        f"OpenGL cannot draw with MUJOCO_GL={backend}: {reason}. "
        f"On Debian or Ubuntu: apt-get install {packages}{other}"
    )
