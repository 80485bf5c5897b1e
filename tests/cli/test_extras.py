"""Missing optional packages: the message names them and a command that works in this installation."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from saccade import SaccadeError
from saccade._internal import extras
from saccade._internal.extras import SACCADE, Extras
from saccade.errors import MissingExtraError
from saccade_lab.extras import LAB

if sys.version_info >= (3, 11):
    import tomllib
else:
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).parents[2]
DISTRIBUTIONS = pytest.mark.parametrize("table", [SACCADE, LAB], ids=lambda table: str(table.distribution))


def project(distribution: str) -> dict[str, Any]:
    """The table `project` of a distribution's pyproject.toml."""
    folder = {"saccade-vla": ROOT, "saccade-vla-lab": ROOT / "lab"}[distribution]
    return dict(tomllib.loads((folder / "pyproject.toml").read_text())["project"])


def required(distribution: str, extra: str) -> set[str]:
    """What an extra requires, that of saccade's extras included."""
    found = set[str]()
    for line in project(distribution)["optional-dependencies"][extra]:
        name, extras_of = re.match(r"([\w.-]+)(?:\[(.*)\])?", line).groups()  # type: ignore[union-attr]
        if name == distribution:
            continue  # `includes` says so
        found |= required(name, extras_of) if name == "saccade-vla" else {line}
    return found


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
    monkeypatch.setattr(extras, "__file__", str(package / "_internal" / "extras.py"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@DISTRIBUTIONS
def test_the_table_is_that_of_pyproject(table: Extras) -> None:
    declared = project(table.distribution)
    assert set(table.modules) == set(declared["optional-dependencies"])
    # The lab itself requires saccade's extra cli; its table names those packages under the extra sim.
    always = required("saccade-vla", "cli") if table is LAB else set[str]()
    for extra, modules in table.modules.items():
        expected = required(table.distribution, extra) | (always if extra == "sim" else set())
        assert set(modules.values()) == expected, extra


@DISTRIBUTIONS
def test_included_extras_are_those_of_pyproject(table: Extras) -> None:
    declared = project(table.distribution)["optional-dependencies"]

    def included(extra: str) -> set[str]:
        direct = {
            name
            for requirement in declared[extra]
            if (found := re.fullmatch(rf"{table.distribution}\[(.*)\]", requirement))
            for name in found[1].split(",")
        }
        return direct.union(*map(included, direct)) if direct else set()

    for extra in table.modules:
        assert set(table.includes.get(extra, ())) == included(extra), extra


def test_the_lab_requires_the_same_version() -> None:
    version = project("saccade-vla-lab")["version"]
    cargo = tomllib.loads((ROOT / "Cargo.toml").read_text())
    assert version == cargo["workspace"]["package"]["version"]
    assert version == importlib.metadata.version("saccade-vla-lab")
    assert project("saccade-vla-lab")["dependencies"] == [f"saccade-vla[cli]=={version}"]


def test_nothing_is_raised_for_what_is_there() -> None:
    SACCADE.require("rich", "torch")


@pytest.mark.usefixtures("absent")
def test_a_missing_module_is_an_import_error_with_its_name() -> None:
    with pytest.raises(MissingExtraError, match=r"^jinja2 is not installed") as caught:
        LAB.require("pandas", "jinja2")
    assert isinstance(caught.value, SaccadeError)
    assert isinstance(caught.value, ModuleNotFoundError)
    assert caught.value.name == "jinja2"


@pytest.mark.usefixtures("absent", "checkout")
def test_all_extras_that_are_needed_are_named() -> None:
    with pytest.raises(MissingExtraError, match=re.escape("--editable '.[cli,torch]'")):
        SACCADE.require("rich", "torch")
    with pytest.raises(MissingExtraError, match=re.escape("--editable './lab[sim]'")):
        LAB.require("rich", "mujoco")
    with pytest.raises(MissingExtraError, match=re.escape("--editable './lab[study]'")):
        LAB.require("rich", "mujoco", "pandas")  # study includes sim


def test_the_path_of_the_checkout_is_relative_to_the_working_directory(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert LAB.install_command(["study"], ["jinja2"]).endswith("--editable './lab[study]'")
    monkeypatch.chdir(checkout.parent)
    assert SACCADE.install_command(["cli"], ["rich"]).endswith(f"--editable './{checkout.name}[cli]'")
    assert LAB.install_command(["study"], ["jinja2"]).endswith(f"--editable './{checkout.name}/lab[study]'")
    monkeypatch.chdir("/")
    assert str(checkout).lstrip("/") in LAB.install_command(["study"], ["jinja2"])


def test_without_a_checkout_packages_and_versions_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "lib" / "saccade" / "_internal" / "extras.py"))
    modules = ["jinja2", "imageio", "imageio_ffmpeg", "packaging", "PIL"]
    command = LAB.install_command(["study"], modules)
    expected = "'jinja2>=3.1' 'imageio>=2.31' 'imageio-ffmpeg>=0.5' packaging 'pillow>=10'"
    assert command.endswith(f"pip install {expected}")


@pytest.mark.parametrize(
    ("noted", "expected"),
    [
        ('{"dir_info": {}, "url": "file:///somewhere"}', r"'\./lab\[sim\]' \(in a clone of saccade\)"),
        (None, r"'saccade-vla-lab\[sim\]==1\.2\.3'"),
    ],
)
def test_the_lab_comes_from_where_saccade_came_from(
    noted: str | None, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "lib" / "saccade" / "_internal" / "extras.py"))

    class Installed:
        version = "1.2.3"

        def read_text(self, name: str) -> str | None:
            assert name == "direct_url.json"
            return noted

    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: Installed())
    assert re.search(f"pip install {expected}$", extras.install_lab("sim"))


def test_packages_go_to_the_environment_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("python", "pip"):
        (folder / name).touch(mode=0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setenv("PATH", "/nonexistent")
    assert extras.pip_install("rich") == "./bin/python -m pip install rich"
    monkeypatch.setenv("PATH", str(folder))
    assert extras.pip_install("rich>=13") == "pip install 'rich>=13'"
    monkeypatch.setitem(sys.modules, "pip", None)
    assert extras.pip_install("rich") == "uv pip install --python ./bin/python rich"


def test_an_import_that_failed_is_explained() -> None:
    error = LAB.explain(ModuleNotFoundError("No module named 'jinja2.ext'", name="jinja2.ext"))
    assert error is not None
    assert error.name == "jinja2"
    assert LAB.explain(ModuleNotFoundError("No module named 'x'", name="x")) is None


@pytest.mark.usefixtures("absent")
def test_a_long_list_is_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("joblib", "pandas"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"^jinja2, joblib, pandas and 2 more are not installed"):
        LAB.require("jinja2", "joblib", "pandas", "torch", "rich")
