"""The version of a release is held in one place, and what repeats it is written and checked together."""

from __future__ import annotations

import datetime
import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import saccade
from tests.helpers.paths import ROOT

SCRIPT = ROOT / ".ci" / "version.py"
FILES = ("Cargo.toml", "lab/pyproject.toml", "plugins/lerobot/pyproject.toml", "CITATION.cff", "CHANGELOG.md")


@pytest.fixture(scope="module")
def program() -> ModuleType:
    """`.ci/version.py` as a module."""
    spec = importlib.util.spec_from_file_location("version", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the files that have a version."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    return tmp_path


def test_every_file_says_the_version_of_the_package() -> None:
    done = subprocess.run([sys.executable, SCRIPT, "--check"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip() == saccade.__version__


def test_a_new_version_is_written_everywhere(program: ModuleType, tree: Path) -> None:
    old = program.held(tree)
    program.write(tree, "98.7.6", datetime.date(2027, 1, 2))
    assert program.held(tree) == "98.7.6"
    assert program.problems(tree) == []
    for name in FILES[:-1]:
        text = (tree / name).read_text()
        assert "98.7.6" in text, name
        assert f'"{old}"' not in text, name


def test_the_day_of_a_release_is_written_once_beside_its_version(program: ModuleType, tree: Path) -> None:
    citation = tree / "CITATION.cff"
    for version, day in (("98.7.6", datetime.date(2027, 1, 2)), ("98.7.7", datetime.date(2027, 3, 4))):
        program.write(tree, version, day)
        assert f"\nversion: {version}\ndate-released: {day.isoformat()}\n" in citation.read_text()
    assert citation.read_text().count("date-released") == 1


@pytest.mark.parametrize("name", FILES[:-1])
def test_a_file_with_another_version_is_named(program: ModuleType, tree: Path, name: str) -> None:
    path, version = tree / name, program.held(tree)
    text = path.read_text()
    place = text.rindex(version)  # in Cargo.toml, one of those that repeat it
    path.write_text(text[:place] + "98.7.6" + text[place + len(version) :])
    (problem,) = program.problems(tree)
    assert problem == f"{name}: 98.7.6, expected {version}"


def test_a_tag_is_of_the_version_and_the_changelog_begins_with_it(program: ModuleType, tree: Path) -> None:
    version = program.held(tree)
    program.write(tree, version, datetime.date(2027, 1, 2))
    assert program.problems_of_tag(tree, f"v{version}") == []
    assert program.problems_of_tag(tree, "v98.7.6") == [f"tag v98.7.6, expected v{version}"]
    changelog = tree / "CHANGELOG.md"
    changelog.write_text("# Changelog\n\n## Unreleased\n\n" + changelog.read_text())
    assert program.problems_of_tag(tree, f"v{version}") == [
        f"CHANGELOG.md begins with Unreleased, expected {version} and its day"
    ]


def test_a_release_has_a_day(program: ModuleType, tree: Path) -> None:
    version, citation, changelog = program.held(tree), tree / "CITATION.cff", tree / "CHANGELOG.md"
    program.write(tree, version, datetime.date(2027, 1, 2))
    assert f"\n## {version} - 2027-01-02\n" in changelog.read_text()
    citation.write_text(program.DAY.sub("", citation.read_text()))
    changelog.write_text(changelog.read_text().replace(" - 2027-01-02", ""))
    first, second = program.problems_of_tag(tree, f"v{version}")
    assert first == f"CHANGELOG.md begins with {version}, expected {version} and its day"
    assert second.startswith("CITATION.cff has no date-released")


@pytest.mark.parametrize("words", [["1.2"], ["v1.2.3"], ["1.2.3rc1"], ["1.2.3-rc.1"], ["1.2.3", "--check"]])
def test_nonsense_is_refused(words: list[str]) -> None:
    done = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "expected" in done.stderr or "write nothing" in done.stderr
