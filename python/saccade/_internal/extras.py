"""Optional dependencies: which are missing, and a command that installs them here."""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from saccade.errors import MissingExtraError

#: Number of missing modules that a message names.
SHOWN = 3


@dataclass(frozen=True)
class Extras:
    """The extras of a distribution. A test compares them with its pyproject.toml.

    Attributes:
        distribution: Name of the distribution.
        folder: Its folder in a checkout.
        modules: The modules that each extra adds, and the requirement of each, as in pyproject.toml.
        includes: The extras that an extra includes, of this distribution.
    """

    distribution: str
    folder: str
    modules: Mapping[str, Mapping[str, str]]
    includes: Mapping[str, tuple[str, ...]]

    def require(self, *modules: str) -> None:
        """Checks that optional modules are installed, without importing them.

        Call it once with everything that a command or a module needs. The message then names every extra that
        is needed, and not only the extra of the first missing module.

        Args:
            modules: Names of modules in :attr:`modules`, such as ``"jinja2"`` or ``"PIL"``.

        Raises:
            MissingExtraError: At least one of them is not installed. The message contains a command that
                installs them. ``error.name`` is the first missing module.

        Example:
            >>> SACCADE.require()
            >>> SACCADE.require("rich", "no_such_module")
            Traceback (most recent call last):
            KeyError: 'no_such_module'
        """
        extras = sorted({self._extra_of(module) for module in modules})
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        if missing:
            raise self._missing(missing, extras)

    def explain(self, error: ModuleNotFoundError) -> MissingExtraError | None:
        """The error that :meth:`require` would have raised for a module that an import did not find.

        Returns:
            None if the module belongs to no extra.
        """
        module = (error.name or "").partition(".")[0]
        if not any(module in modules for modules in self.modules.values()):
            return None
        return self._missing([module], [self._extra_of(module)])

    def install_command(self, extras: Sequence[str], modules: Sequence[str]) -> str:
        """A shell command that installs extras; without a checkout, the packages of the missing modules."""
        included = {name for extra in extras for name in self.includes.get(extra, ())}
        wanted = ",".join(extra for extra in extras if extra not in included)
        packages = [self.modules[self._extra_of(module)][module] for module in modules]
        return _install(self.folder, wanted) or pip_install(*packages)

    def _missing(self, modules: list[str], extras: list[str]) -> MissingExtraError:
        """The error for these missing modules of these extras."""
        more = len(modules) - SHOWN
        names = [*modules[:SHOWN], f"{more} more"] if more > 0 else modules
        listed = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
        verb = "is" if len(modules) == 1 else "are"
        command = self.install_command(extras, modules)
        return MissingExtraError(f"{listed} {verb} not installed. Install with: {command}", name=modules[0])

    def _extra_of(self, module: str) -> str:
        for extra, modules in self.modules.items():
            if module in modules:
                return extra
        raise KeyError(module)


#: The extras of saccade-vla.
SACCADE = Extras(
    "saccade-vla",
    ".",
    {
        "cli": {"rich": "rich>=13", "PIL": "pillow>=10"},
        "torch": {"torch": "torch>=2.4", "safetensors": "safetensors>=0.4"},
        "serve": {"zmq": "pyzmq>=25", "msgpack": "msgpack>=1.0"},
        "data": {"pyarrow": "pyarrow>=17", "av": "av>=14"},
        "hub": {"huggingface_hub": "huggingface_hub>=0.25"},
    },
    {"serve": ("cli",), "data": ("cli",)},
)


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


def install_lab(extra: str) -> str:
    """How to install saccade-vla-lab with an extra: from where saccade itself was installed."""
    from importlib.metadata import version  # not at the top, as above

    if (command := _install("lab", extra)) is not None:
        return command
    if _is_from_an_index():
        return pip_install(f"saccade-vla-lab[{extra}]=={version('saccade-vla')}")
    return f"{pip_install(f'./lab[{extra}]')} (in a clone of saccade)"


def _is_from_an_index() -> bool:
    """Whether saccade-vla was installed by its name, and not from a folder, a file or a repository.

    Installers note the address of everything else beside the package's metadata (PEP 610).
    """
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        return distribution("saccade-vla").read_text("direct_url.json") is None
    except PackageNotFoundError:  # a folder on the path of modules
        return False


def _install(folder: str, extras: str) -> str | None:
    """A command that installs extras of a folder of the checkout; None without a checkout."""
    checkout = Path(__file__).resolve().parents[3]
    if not ((checkout / "pyproject.toml").is_file() and (checkout / "crates").is_dir()):
        return None
    return pip_install("--editable", f"{_shown(checkout / folder)}[{extras}]")


def _shown(path: Path) -> str:
    """A path for a command: relative if it is below the working directory, with a leading dot."""
    below = os.path.relpath(path)
    if below.startswith(os.pardir):
        return str(path)
    return below if below == os.curdir else f"{os.curdir}{os.sep}{below}"
