"""Optional dependencies: which are missing, and a command that installs them here."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

from saccade.errors import MissingExtraError

#: The extras of pyproject.toml: the modules that each one adds, and the distribution that contains each
#: module. A test compares them with pyproject.toml.
EXTRAS: dict[str, dict[str, str]] = {
    "cli": {"rich": "rich", "PIL": "pillow"},
    "torch": {"torch": "torch", "safetensors": "safetensors"},
    "sim": {
        "gymnasium": "gymnasium",
        "metaworld": "metaworld",
        "mujoco": "mujoco",
        "packaging": "packaging",
        "imageio": "imageio",
        "imageio_ffmpeg": "imageio-ffmpeg",
        "matplotlib": "matplotlib",
        "jinja2": "jinja2",
        "scipy": "scipy",
        "joblib": "joblib",
    },
    "study": {
        "markdown_it": "markdown-it-py",
        "pandas": "pandas",
        "sklearn": "scikit-learn",
        "threadpoolctl": "threadpoolctl",
    },
    "serve": {"zmq": "pyzmq", "msgpack": "msgpack"},
    "ray": {"ray": "ray"},
}
#: The extras that an extra includes.
INCLUDES: dict[str, tuple[str, ...]] = {
    "serve": ("cli",),
    "sim": ("cli",),
    "study": ("sim", "cli", "torch"),
    "ray": ("study", "sim", "cli", "torch"),
}

#: Number of missing modules that a message names.
SHOWN = 3


def require(*modules: str) -> None:
    """Checks that optional modules are installed, without importing them.

    Call it once with everything that a command or a module needs. The message then names every extra that is
    needed, and not only the extra of the first missing module.

    Args:
        modules: Names of modules in `EXTRAS`, such as ``"jinja2"`` or ``"PIL"``.

    Raises:
        MissingExtraError: At least one of them is not installed. The message contains a command that installs
            them. ``error.name`` is the first missing module.

    Example:
        >>> require()
        >>> require("rich", "no_such_module")
        Traceback (most recent call last):
        KeyError: 'no_such_module'
    """
    extras = sorted({_extra_of(module) for module in modules})
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if missing:
        raise _missing(missing, extras)


def explain(error: ModuleNotFoundError) -> MissingExtraError | None:
    """The error that :func:`require` would have raised for a module that an import did not find.

    Returns:
        None if the module belongs to no extra.
    """
    module = (error.name or "").partition(".")[0]
    if not any(module in modules for modules in EXTRAS.values()):
        return None
    return _missing([module], [_extra_of(module)])


def pip_install(*arguments: str) -> str:
    """The shell command ``pip install ARGUMENTS`` for the Python that is running.

    This is plain ``pip`` only if the first ``pip`` on ``PATH`` belongs to this Python. Otherwise packages
    would go to another environment.
    """
    import shutil  # not at the top: `import saccade` should stay cheap

    folder = Path(sys.executable).parent
    found = shutil.which("pip")
    if importlib.util.find_spec("pip") is None:  # environments that uv creates have no pip
        command = ["uv", "pip", "install", "--python", _shown(Path(sys.executable))]
    elif found is not None and Path(found).parent == folder:
        command = ["pip", "install"]
    else:
        command = [_shown(Path(sys.executable)), "-m", "pip", "install"]
    return " ".join(map(shlex.quote, [*command, *arguments]))


def install_command(extras: Iterable[str], modules: Iterable[str]) -> str:
    """A shell command that installs extras of saccade, or what is missing of them.

    saccade is on no package index, so ``pip install 'saccade[study]'`` cannot work. In a checkout the
    command installs from the checkout: by ``make`` in the environment that ``make rollout`` created, by pip
    elsewhere. If saccade was installed from a wheel or without ``--editable``, the command names the missing
    packages with the versions that saccade's metadata asks for.

    Args:
        extras: Names of extras.
        modules: The missing modules.
    """
    extras = list(extras)
    included = {name for extra in extras for name in INCLUDES.get(extra, ())}
    wanted = [extra for extra in extras if extra not in included]
    checkout = _checkout()
    if checkout is None:
        return pip_install(*map(_requirement, modules))
    environment = Path(sys.prefix)
    # What `make setup-test` would do: it installs every extra but ray, unless it has run already.
    is_made = environment == checkout / ".venv" and (environment / ".rollout").exists()
    if is_made and "ray" not in extras and not (environment / ".test").exists():
        folder = "" if Path.cwd() == checkout else f"-C {shlex.quote(_shown(checkout))} "
        return f"make {folder}setup-test"
    folder = "." if Path.cwd() == checkout else _shown(checkout)
    return pip_install("--editable", f"{folder}[{','.join(wanted)}]")


def _missing(modules: list[str], extras: list[str]) -> MissingExtraError:
    """The error for these missing modules of these extras."""
    more = len(modules) - SHOWN
    names = [*modules[:SHOWN], f"{more} more"] if more > 0 else modules
    listed = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    verb = "is" if len(modules) == 1 else "are"
    command = install_command(extras, modules)
    return MissingExtraError(f"{listed} {verb} not installed. Install with: {command}", name=modules[0])


def _extra_of(module: str) -> str:
    for extra, modules in EXTRAS.items():
        if module in modules:
            return extra
    raise KeyError(module)


def _requirement(module: str) -> str:
    """The distribution of a module with the versions that saccade accepts, such as ``"jinja2>=3.1"``."""
    import importlib.metadata  # not at the top: `import saccade` should stay cheap

    distribution = EXTRAS[_extra_of(module)][module]
    try:
        required = importlib.metadata.requires("saccade") or []
    except importlib.metadata.PackageNotFoundError:
        required = []
    for line in required:
        found = re.match(rf"{re.escape(distribution)}\s*([^\w\s;\[-][^;]*)?(;|$)", line, re.IGNORECASE)
        if found is not None:
            return distribution + (found[1] or "").strip()
    return distribution


def _checkout() -> Path | None:
    """The checkout that this package is imported from; None if it was installed from a wheel or a copy."""
    folder = Path(__file__).resolve().parents[2]
    return folder if (folder / "pyproject.toml").is_file() and (folder / "crates").is_dir() else None


def _shown(path: Path) -> str:
    """A path for a command: relative if it is below the working directory."""
    below = os.path.relpath(path)
    return str(path) if below.startswith(os.pardir) else below
