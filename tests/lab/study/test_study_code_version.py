"""The version of saccade that tables name: in a clone with its commit."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import saccade
from saccade_lab.study import code_version
from saccade_lab.study.code_version import git


def version_of(package: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(saccade, "__file__", str(package / "__init__.py"))
    code_version.code_version.cache_clear()
    try:
        return code_version.code_version()
    finally:
        code_version.code_version.cache_clear()


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_the_commit_of_a_clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "python" / "saccade"
    package.mkdir(parents=True)
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    assert version_of(package, monkeypatch) == saccade.__version__  # no clone
    (package / "code.py").write_text("first")
    (tmp_path / "notes").write_text("any")
    identity = ("-c", "user.name=a", "-c", "user.email=a@b")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, *identity, "commit", "-q", "-m", "first")
    commit = git(tmp_path, "rev-parse", "HEAD")[:12]
    assert version_of(package, monkeypatch) == f"{saccade.__version__}+g{commit}"
    (tmp_path / "notes").write_text("other")  # is not code
    assert version_of(package, monkeypatch) == f"{saccade.__version__}+g{commit}"
    (package / "code.py").write_text("second")
    assert version_of(package, monkeypatch) == f"{saccade.__version__}+g{commit}.changed"
    installed = tmp_path / "environment" / "site-packages" / "saccade"
    installed.mkdir(parents=True)
    assert version_of(installed, monkeypatch) == saccade.__version__


def test_without_git(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert version_of(tmp_path, monkeypatch) == saccade.__version__


def test_a_command_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def late(*arguments: object, **options: object) -> None:
        raise subprocess.TimeoutExpired("git", 1)

    monkeypatch.setattr(subprocess, "run", late)
    assert version_of(Path(sys.prefix), monkeypatch) == saccade.__version__
