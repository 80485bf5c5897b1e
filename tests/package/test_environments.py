"""The environments of `noxfile.py` need nothing that happens to be installed on the machine."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from unittest import mock

import nox

from tests.helpers.paths import ROOT


def test_a_build_finds_the_programs_of_its_environment_first(tmp_path: Path) -> None:
    # Without build isolation a package's build calls `maturin` by name: a fresh machine has no other one.
    spec = importlib.util.spec_from_file_location("environments", ROOT / ".ci" / "environments.py")
    assert spec is not None
    assert spec.loader is not None
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    session = mock.create_autospec(nox.Session, instance=True)
    environment = program.Environment(session, tmp_path)
    environment.pip("--editable", ".")
    path = session.run.call_args.kwargs["env"]["PATH"]
    assert path.split(os.pathsep) == [str(environment.python.parent), *os.environ["PATH"].split(os.pathsep)]
