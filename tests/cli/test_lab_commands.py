"""Commands of saccade-vla-lab where it is not installed, or lacks what a command needs."""

from __future__ import annotations

import subprocess
import sys

import pytest

#: Runs the command where the distribution of the lab is not installed, or one of its entry points is gone.
WITHOUT_THE_LAB = """
import importlib.metadata, sys
from types import SimpleNamespace
usual = importlib.metadata.distribution
def distribution(name):
    if name != "saccade-vla-lab":
        return usual(name)
    if {gone}:
        raise importlib.metadata.PackageNotFoundError(name)
    return SimpleNamespace(entry_points=importlib.metadata.EntryPoints(()))
importlib.metadata.distribution = distribution
from saccade.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("gone", [True, False])
@pytest.mark.parametrize("arguments", [["rollout"], ["study", "--help"], ["parity", "--no-such-flag"]])
def test_without_the_lab_a_command_says_what_to_install(gone: bool, arguments: list[str]) -> None:
    command = [sys.executable, "-c", WITHOUT_THE_LAB.format(gone=gone), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        f"saccade: {arguments[0]}: needs saccade-vla-lab, which is not installed. Install with: "
    )
    assert f"lab[{'sim' if arguments == ['rollout'] else 'study'}]" in line
