"""Missing optional packages: the message names them and a command that works in this installation."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from pathlib import Path

import pytest

from saccade import SaccadeError
from saccade._internal import extras as _extras
from saccade.errors import MissingExtraError

if sys.version_info >= (3, 11):
    import tomllib
else:
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).parents[2]


@pytest.fixture
def declared() -> dict[str, list[str]]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return dict(project["optional-dependencies"])


@pytest.fixture
def absent(monkeypatch: pytest.MonkeyPatch) -> None:
    """jinja2, torch and rich cannot be imported."""
    for module in ("jinja2", "torch", "rich"):
        monkeypatch.setitem(sys.modules, module, None)


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout that saccade seems to be imported from; the working directory."""
    (tmp_path / "crates").mkdir()
    (tmp_path / "pyproject.toml").touch()
    package = tmp_path / "python" / "saccade"
    monkeypatch.setattr(_extras, "__file__", str(package / "_extras.py"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_table_is_that_of_pyproject(declared: dict[str, list[str]]) -> None:
    names = {
        extra: [re.split(r"[<>=\[ ]", requirement)[0] for requirement in requirements]
        for extra, requirements in declared.items()
    }
    for extra, modules in _extras.EXTRAS.items():
        assert set(modules.values()) == set(names[extra]) - {"saccade"}, extra


def test_included_extras_are_those_of_pyproject(declared: dict[str, list[str]]) -> None:
    def included(extra: str) -> set[str]:
        direct = {
            name
            for requirement in declared[extra]
            if (found := re.fullmatch(r"saccade\[(.*)\]", requirement))
            for name in found[1].split(",")
        }
        return direct.union(*map(included, direct)) if direct else set()

    for extra in _extras.EXTRAS:
        assert set(_extras.INCLUDES.get(extra, ())) == included(extra), extra


def test_nothing_is_raised_for_what_is_there() -> None:
    _extras.require("rich", "torch")


@pytest.mark.usefixtures("absent")
def test_a_missing_module_is_an_import_error_with_its_name() -> None:
    with pytest.raises(MissingExtraError, match=r"^jinja2 is not installed") as caught:
        _extras.require("pandas", "jinja2")
    assert isinstance(caught.value, SaccadeError)
    assert isinstance(caught.value, ModuleNotFoundError)
    assert caught.value.name == "jinja2"


@pytest.mark.usefixtures("absent")
def test_all_extras_that_are_needed_are_named(checkout: Path) -> None:
    with pytest.raises(MissingExtraError, match=re.escape("[cli,torch]'")):
        _extras.require("rich", "torch")
    with pytest.raises(MissingExtraError, match=re.escape("--editable '.[sim]'")):
        _extras.require("rich", "mujoco")  # sim includes cli
    with pytest.raises(MissingExtraError, match=re.escape("--editable '.[study]'")):
        _extras.require("rich", "mujoco", "pandas")


def test_the_path_of_the_checkout_is_relative_to_the_working_directory(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _extras.install_command(["study"], ["jinja2"]).endswith("--editable '.[study]'")
    monkeypatch.chdir(checkout.parent)
    expected = f"--editable '{checkout.name}[study]'"
    assert _extras.install_command(["study"], ["jinja2"]).endswith(expected)
    monkeypatch.chdir("/")
    command = _extras.install_command(["study"], ["jinja2"])
    assert str(checkout).lstrip("/") in command


def test_an_environment_of_make_rollout_is_extended_by_make(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = checkout / ".venv"
    environment.mkdir()
    monkeypatch.setattr(sys, "prefix", str(environment))
    (environment / ".rollout").touch()
    assert _extras.install_command(["study"], ["jinja2"]) == "make setup-test"
    assert "--editable" in _extras.install_command(["study", "ray"], ["ray"])  # make installs no ray
    monkeypatch.chdir(checkout.parent)
    assert _extras.install_command(["study"], ["jinja2"]) == f"make -C {checkout.name} setup-test"
    (environment / ".test").touch()  # make has installed everything: it would not do so again
    assert "--editable" in _extras.install_command(["study"], ["jinja2"])


def test_the_targets_of_make_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(r"^setup-test:", makefile, re.MULTILINE)
    assert "$(VENV)/.rollout" in makefile
    assert "$(VENV)/.test" in makefile


def test_a_wheel_names_packages_and_versions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_extras, "__file__", str(tmp_path / "lib" / "saccade" / "_extras.py"))
    requires = [
        "numpy>=1.24",
        "saccade[sim,torch] ; extra == 'study'",
        "jinja2>=3.1 ; extra == 'study'",
        "imageio>=2.31 ; extra == 'sim'",
        "imageio-ffmpeg>=0.5 ; extra == 'sim'",
        "packaging ; extra == 'sim'",
        "Pillow>=10,<12 ; extra == 'sim'",
    ]
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: requires)
    modules = ["jinja2", "imageio", "imageio_ffmpeg", "packaging", "PIL"]
    command = _extras.install_command(["study"], modules)
    expected = "'jinja2>=3.1' 'imageio>=2.31' 'imageio-ffmpeg>=0.5' packaging 'pillow>=10,<12'"
    assert command.endswith(f"pip install {expected}")


def test_packages_go_to_the_environment_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("python", "pip"):
        (folder / name).touch(mode=0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setenv("PATH", "/nonexistent")
    assert _extras.pip_install("rich") == "bin/python -m pip install rich"
    monkeypatch.setenv("PATH", str(folder))
    assert _extras.pip_install("rich>=13") == "pip install 'rich>=13'"
    monkeypatch.setitem(sys.modules, "pip", None)
    assert _extras.pip_install("rich") == "uv pip install --python bin/python rich"


def test_an_import_that_failed_is_explained() -> None:
    error = _extras.explain(ModuleNotFoundError("No module named 'jinja2.ext'", name="jinja2.ext"))
    assert error is not None
    assert error.name == "jinja2"
    assert _extras.explain(ModuleNotFoundError("No module named 'x'", name="x")) is None


@pytest.mark.usefixtures("absent")
def test_a_long_list_is_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("joblib", "pandas"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"^jinja2, joblib, pandas and 2 more are not installed"):
        _extras.require("jinja2", "joblib", "pandas", "torch", "rich")
