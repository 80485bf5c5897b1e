"""OpenGL without a window: which way MuJoCo draws, and whether it works on this machine.

A missing or broken OpenGL may end the process (MuJoCo aborts), so the question is asked in a process of its
own.
"""

import importlib
import importlib.util
import os
import re
import subprocess
import sys

from saccade.errors import SaccadeError

# One line in, one line out: draws one picture of an empty scene.
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
PROBE_SECONDS = 60  # a healthy machine takes one; a cold disk takes longer

PACKAGES = {
    "egl": "libegl1 libegl-mesa0 libgl1-mesa-dri",
    "osmesa": "libosmesa6",
    "glfw": "libglfw3 and a display",
}


class GraphicsError(SaccadeError):
    """OpenGL cannot draw here; the message says which packages bring it."""


def choose_backend() -> None:
    """Picks EGL unless the user chose otherwise, and keeps Mesa's software renderer on the calling thread.

    Both are environment variables that are read once: `MUJOCO_GL` when mujoco is imported, `LP_NUM_THREADS`
    when the first OpenGL context is made. At 64 px more drawing threads cost more than they bring.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("LP_NUM_THREADS", "0")


def load_triton_first() -> None:
    """Loads torch's compiler, where it is installed, before OpenGL is.

    Both bring an LLVM of their own. Mesa's may come second; loading triton after it ends the process, and
    torch does that on its own at some later call. Costs a fifth of a second, and nothing where there is no
    triton.
    """
    if importlib.util.find_spec("triton") is not None:
        importlib.import_module("triton")


def check() -> None:
    """Draws one picture in a process of its own.

    Raises:
        GraphicsError: it did not work; names the Debian packages and the last line of what went wrong.
        ModuleNotFoundError: mujoco is not installed.
    """
    if importlib.util.find_spec("mujoco") is None:
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")
    try:
        outcome = subprocess.run(
            [sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise GraphicsError(advice("it did not answer")) from None
    if outcome.returncode != 0 or "drawn" not in outcome.stdout:
        errors = outcome.stderr.strip().splitlines() or [f"it ended with status {outcome.returncode}"]
        # The interpreter may add errors of clean-up after the first exception; that one says the most.
        reasons = [line for line in errors if re.match(r"[\w.]*Error\b", line)]
        raise GraphicsError(advice((reasons or errors)[0].strip()))


def advice(reason: str) -> str:
    """What to install, and why we think so."""
    backend = os.environ.get("MUJOCO_GL", "egl")
    packages = PACKAGES.get(backend, PACKAGES["egl"])
    other = "" if backend == "osmesa" else f" (or {PACKAGES['osmesa']} and MUJOCO_GL=osmesa)"
    return (
        f"OpenGL cannot draw with MUJOCO_GL={backend}: {reason}. "
        f"On Debian or Ubuntu: apt-get install {packages}{other}"
    )
