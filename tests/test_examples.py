"""The examples run as they are."""

from __future__ import annotations

import json
import re
import runpy
import subprocess
import sys
from collections.abc import Callable
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
    finished = run(
        "real_time.py", "--seconds", "0.5", "--rate", "40", "--backbone-ms", "1", "--num-threads", "2"
    )
    assert finished.returncode == 0, finished.stderr
    counts = re.search(r"40 per second for 0.5 s, (\d+) chunks, (\d+) deadlines missed", finished.stdout)
    assert counts is not None, finished.stdout
    chunks, missed = map(int, counts.groups())
    assert chunks >= 1
    # 20 ticks are due; the last chunk may run over the end.
    assert chunks + missed >= 20
    for title in ("start of a tick after its due time", "state to actions", "images to actions"):
        block = finished.stdout.split(f"{title}, ms:")[1].splitlines()[1:]
        shown = [re.match(r"  up to +[\d.]+ ms +(\d+)", line) for line in block]
        lengths = [int(line[1]) for line in shown[: shown.index(None) if None in shown else None] if line]
        assert sum(lengths) == chunks, title


@pytest.mark.parametrize(
    "arguments", [["--rate", "0"], ["--seconds", "-1"], ["--size", "n2"], ["--num-threads", "0"]]
)
def test_real_time_refuses_nonsense(arguments: list[str]) -> None:
    finished = run("real_time.py", *arguments)
    assert finished.returncode == 2
    assert "expected" in finished.stderr or "invalid choice" in finished.stderr


@pytest.fixture
def asynchronous(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Runs the example in this process: it imports much, and only the first time takes long."""

    def run(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["asynchronous.py", *arguments])
        try:
            runpy.run_path(str(EXAMPLES / "asynchronous.py"), run_name="__main__")
        except SystemExit as stopped:
            return stopped.code if isinstance(stopped.code, int) else 1
        return 0

    return run


def test_asynchronous_goes_on_where_it_was_and_reports(
    asynchronous: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--tasks", "reach", "push", "--max-steps", "20", "--out", str(tmp_path)]
    assert asynchronous("--episodes", "1", "--delays", "0", "8", *few, "--video") == 0
    record = json.loads((tmp_path / "results.json").read_text())
    rows = {(row["delay"], row["arm"], row["task"]): row for row in record["episodes"]}
    assert len(rows) == len(record["episodes"]) == 8
    assert len(list((tmp_path / "videos").glob("*.mp4"))) == 8
    for (delay, arm, task), row in rows.items():
        # 20 steps: looks at 8 and 16, whose chunks come `delay` later.
        assert row["num_seams"] == {0: 2, 8: 1}[delay], (arm, task)
        assert row["seam"] > 0
        assert row["within"] > 0
        assert row["bend"] > 0
    # What is frozen is carried out as it was planned: the arms part at the first seam, and not before.
    assert rows[8, "plain", "push"] != rows[8, "chunked", "push"]
    capsys.readouterr()
    assert asynchronous("--episodes", "1", "--delays", "0", "8", "4", *few) == 0
    again = json.loads((tmp_path / "results.json").read_text())["episodes"]
    assert again[:8] == record["episodes"]
    assert len(again) == 12
    assert (tmp_path / "asynchronous.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert printed.count("\n| 4 | chunked | 0/2 |") == 1, printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--delays", "9"], "expected 0 to 8"),
        (["--episodes", "0"], "episodes"),
        (["--seed", "1000000"], "seed"),
        (["--max-steps", "0"], "at least 1"),
        (["--tasks", "fork"], "invalid choice"),
        (["report"], "results.json"),
    ],
)
def test_asynchronous_refuses_nonsense(
    asynchronous: Callable[..., int],
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert asynchronous(*arguments, "--out", str(tmp_path)) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
