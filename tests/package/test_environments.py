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
