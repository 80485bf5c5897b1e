"""The examples run as they are, with NumPy only."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
#: Runs the script with the rest of the arguments in an interpreter without torch.
WITHOUT_TORCH = "import runpy, sys; sys.modules['torch'] = None; sys.argv = sys.argv[1:]; "
WITHOUT_TORCH += (
    "sys.path.insert(0, sys.argv[0].rpartition('/')[0]); runpy.run_path(sys.argv[0], run_name='__main__')"
)


def run(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT_TORCH, str(EXAMPLES / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_real_time_counts_every_tick() -> None:
    finished = run("real_time.py", "--seconds", "0.5", "--rate", "40", "--backbone-ms", "1", "--threads", "2")
    assert finished.returncode == 0, finished.stderr
    counts = re.search(r"40 a second for 0.5 s, (\d+) chunks, (\d+) deadlines missed", finished.stdout)
    assert counts is not None, finished.stdout
    chunks, missed = map(int, counts.groups())
    assert chunks >= 1
    # 20 ticks are due; the last chunk may run over the end.
    assert chunks + missed >= 20
    for title in ("tick begins after it was due", "state to actions", "pictures to actions"):
        block = finished.stdout.split(f"{title}, ms:")[1].splitlines()[1:]
        shown = [re.match(r"  up to +[\d.]+ ms +(\d+)", line) for line in block]
        lengths = [int(line[1]) for line in shown[: shown.index(None) if None in shown else None] if line]
        assert sum(lengths) == chunks, title


@pytest.mark.parametrize(
    "arguments", [["--rate", "0"], ["--seconds", "-1"], ["--size", "n2"], ["--threads", "0"]]
)
def test_real_time_refuses_nonsense(arguments: list[str]) -> None:
    finished = run("real_time.py", *arguments)
    assert finished.returncode == 2
    assert "expected" in finished.stderr or "invalid choice" in finished.stderr
