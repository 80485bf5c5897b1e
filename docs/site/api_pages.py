"""The pages of the API reference: every public name of saccade, and every module of the lab."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from pathlib import Path
from typing import Any, get_origin

from sphinx.pycode import ModuleAnalyzer

import saccade
import saccade_lab

#: Packages of the lab that are commands, or what only they need.
NO_LIBRARY = ("cli", "__main__")
#: Members of a class, with those that it inherits from classes of saccade.
STOP = "Module, BaseException, Exception, ValueError, TypeError, ModuleNotFoundError, dict, tuple, object"
MEMBERS = f"   :members:\n   :inherited-members: {STOP}\n   :special-members: __call__\n"


def write_all(folder: Path) -> list[str]:
    """Writes the pages below a new folder: one of each module, and one for all of them.

    Returns:
        The public names of saccade, which must have places of their own on these pages.
    """
    folder.mkdir(parents=True)
    shown: dict[int, str] = {}
    modules = ["saccade", *(f"saccade.{name}" for name in saccade._SUBMODULES)]
    for module in modules:
        (folder / f"{module}.rst").write_text(module_page(module, shown), encoding="utf-8")
    lab = {f"saccade_lab.{info.name}": info.ispkg for info in pkgutil.iter_modules(saccade_lab.__path__)}
    packages = sorted(name for name in lab if name.rpartition(".")[2] not in NO_LIBRARY)
    for package in packages:
        (folder / f"{package}.rst").write_text(lab_page(package), encoding="utf-8")
    (folder / "index.rst").write_text(index_page(modules, packages), encoding="utf-8")
    return sorted(shown.values())


def index_page(modules: list[str], packages: list[str]) -> str:
    """The table of contents."""
    text = heading("API reference", "=")
    text += "What these pages list is public: other names may change at any time.\n\n"
    for title, names in (("saccade", modules), ("saccade_lab", packages)):
        text += f".. toctree::\n   :caption: {title}\n   :maxdepth: 1\n\n"
        text += "".join(f"   {name}\n" for name in names) + "\n"
    return text


def module_page(name: str, shown: dict[int, str]) -> str:
    """A module with all its public names.

    Args:
        name: The module.
        shown: The classes and functions that are documented, by `id`, with their names; added to.
    """
    module = importlib.import_module(name)
    entries, own = "", []
    for public in module.__all__:
        value: Any = getattr(module, public)
        path = f"{name}.{public}"
        if public == "__version__":
            entries += f".. py:data:: {path}\n   :type: str\n\n   The version of the package.\n\n"
        elif not callable(value) or not hasattr(value, "__module__") or get_origin(value):
            entries += data_entry(path, value)
        elif id(value) in shown:
            entries += f"``{path}`` is :py:obj:`{shown[id(value)]}`.\n\n"
        else:
            shown[id(value)] = path
            own.append(public)
            kind = "function"
            if inspect.isclass(value):
                kind = "exception" if issubclass(value, BaseException) else "class"
            entries += f".. auto{kind}:: {path}\n{MEMBERS if inspect.isclass(value) else ''}\n"
    text = heading(name, "=") + f".. automodule:: {name}\n   :no-index:\n\n.. currentmodule:: {name}\n\n"
    text += ".. autosummary::\n   :nosignatures:\n\n" + "".join(f"   {public}\n" for public in own) + "\n"
    return text + entries


def data_entry(path: str, value: object) -> str:
    """A constant or a type, with the comment of the module that defines it."""
    public = path.rpartition(".")[2]
    for module in sorted(name for name in sys.modules if name.startswith("saccade.")):
        if sys.modules[module].__dict__.get(public) is value:
            found = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", public))
            if found:
                text = "\n".join(f"   {line}" for line in found)
                return f".. py:data:: {path}\n\n{text}\n\n"
    raise SystemExit(f"docs: {path} has no comment that begins with #:, where it is defined")


def lab_page(package: str) -> str:
    """A package of the lab with the public classes and functions that each of its modules defines."""
    module = importlib.import_module(package)
    below = [package]
    if hasattr(module, "__path__"):
        found = pkgutil.walk_packages(module.__path__, f"{package}.")
        below += sorted(info.name for info in found if info.name.rpartition(".")[2] not in NO_LIBRARY)
    text = heading(package, "=")
    shown: set[int] = set()  # what a package lists in `__all__`, which the modules below define
    for name in below:
        module = importlib.import_module(name)
        text += heading(name, "-") if name != package else ""
        text += f".. automodule:: {name}\n   :members:\n"
        again = [public for public, value in vars(module).items() if id(value) in shown]
        text += f"   :exclude-members: {', '.join(sorted(again))}\n\n" if again else "\n"
        shown |= {id(getattr(module, public)) for public in getattr(module, "__all__", ())}
    return text


def heading(title: str, line: str) -> str:
    """A heading of reStructuredText."""
    return f"{title}\n{line * len(title)}\n\n"
