"""The environments of `noxfile.py` need nothing that happens to be installed on the machine."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from unittest import mock

import nox
import pytest

from tests.helpers.paths import ROOT


def test_a_build_finds_the_programs_of_its_environment_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without build isolation a package's build calls `maturin` by name: a fresh machine has no other one.
    monkeypatch.syspath_prepend(ROOT / ".ci")
    program = importlib.import_module("environments")
    session = mock.create_autospec(nox.Session, instance=True)
    environment = program.Environment(session, tmp_path)
    environment.pip("--editable", ".")
    path = session.run.call_args.kwargs["env"]["PATH"]
    assert path.split(os.pathsep) == [str(environment.python.parent), *os.environ["PATH"].split(os.pathsep)]


@pytest.mark.parametrize(
    ("options", "releases"),
    [
        ([], ["n1.5"]),
        (["--only", "head", "blocks"], ["n1.5"]),
        (["--only", "policy", "--rounds", "3"], ["n1.5", "n1.7"]),
        (["--only=policy"], ["n1.5", "n1.7"]),
        (["report", "--only", "policy", "--release=n1.7"], ["n1.7"]),
    ],
)
def test_a_comparison_of_whole_policies_measures_both_releases(
    options: list[str], releases: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / ".ci")
    assert importlib.import_module("peers").releases(options) == releases


def test_libraries_are_built_again_when_their_sources_change_or_the_build_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / ".ci")
    program = importlib.import_module("peers")
    monkeypatch.setattr(program, "LIBRARIES", tmp_path)
    environment = mock.Mock(folder=tmp_path)
    for made_from in ("first", "first"):  # an optional build that leaves nothing is not done
        program.build(environment, "ggml", made_from, optional=True)
    assert environment.session.run.call_count == 2
    (tmp_path / "ggml" / program.MADE["ggml"]).parent.mkdir(parents=True)
    (tmp_path / "ggml" / program.MADE["ggml"]).touch()
    for made_from in ("first", "first", "second"):
        program.build(environment, "ggml", made_from, optional=True)
    assert environment.session.run.call_count == 3
