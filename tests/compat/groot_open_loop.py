"""`saccade.evaluate` against Isaac-GR00T's released open loop, on the same actions; `groot` runs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SOURCES = Path(os.environ["SACCADE_GROOT_SOURCES"])
RELEASES = os.environ["SACCADE_GROOT_RELEASES"].split()
#: Those whose open loop `docs/evaluate.md` names; before N1.5 it was another.
NAMED = ("n1.5", "n1.6", "n1.7")


@pytest.mark.parametrize("release", [release for release in RELEASES if release in NAMED])
def test_the_errors_are_those_of_the_released_function_to_the_last_digit(
    release: str, tmp_path: Path
) -> None:
    program = Path(__file__).with_name("groot_loops.py")
    paths = f"{SOURCES / release}{os.pathsep}{os.environ['PYTHONPATH']}"
    done = subprocess.run(
        [sys.executable, str(program), release, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=600,
        env=os.environ | {"PYTHONPATH": paths, "MPLBACKEND": "Agg"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    cases = json.loads(done.stdout.splitlines()[-1])
    assert [one["recorded"] for one in cases] == ["float32", "float32", "float64", "float64"]
    for one in cases:
        assert one["computed"] == [one["recorded"]]
        assert one["saccade"] == one["released"]
        assert min(one["released"]) > 0
