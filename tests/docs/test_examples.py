"""The examples run as they are."""

from __future__ import annotations

import importlib
import json
import os
import re
import runpy
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import saccade
from saccade_lab import random_checkpoint

EXAMPLES = Path(__file__).parents[2] / "examples"
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


def test_the_control_loop_reports_every_tick_quiet_and_busy() -> None:
    finished = run(
        "control_loop.py", "--small", "--seconds", "0.5", "--rate", "20", "--num-threads", "1", "--busy"
    )
    assert finished.returncode == 0, finished.stderr
    found = re.findall(
        r"(quiet|busy processes), \S+ priority: (\d+) ticks of 50 ms in 0.5 s, (\d+) missed, "
        r"(\d+) without an action, (\d+) chunks",
        finished.stdout,
    )
    assert [title for title, *_ in found] == ["quiet", "busy processes"]
    for _, *counts in found:
        ticks, missed, held, chunks = map(int, counts)
        assert ticks >= 1
        assert ticks + missed >= 10
        assert held <= ticks
        assert chunks >= 1
    assert finished.stdout.count("age of the frames behind an action, ms: min") == 2
    rows = [line.split(" | ") for line in finished.stdout.splitlines()[-2:]]
    assert [row[0] for row in rows] == ["| quiet", f"| {os.cpu_count()} busy processes"]
    assert [tuple(map(int, row[1:5])) for row in rows] == [tuple(map(int, counts)) for _, *counts in found]
    assert run("control_loop.py", "--small", "--cameras", "none").returncode == 2


def test_the_control_loop_holds_where_a_chunk_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    loop = importlib.import_module("control_loop")
    plan = loop.Plan({"arm": np.arange(8.0).reshape(1, 4, 2)}, 0, time.perf_counter())
    thinker, sent = SimpleNamespace(plan=plan, tick=-1, is_stopping=False), []
    robot = SimpleNamespace(send=lambda action: sent.append((thinker.tick, *action["arm"])))
    record = loop.control(thinker, robot, rate=100, seconds=0.12)
    assert record.held >= 1
    assert sent == [(tick, 2.0 * tick, 2.0 * tick + 1) for tick, *_ in sent]
    assert len(sent) + record.held == len(record.late) == len(record.age)
    assert len(record.late) + record.missed >= 12


def small_policy(folder: Path) -> saccade.Policy:
    """A small random policy, written below a folder."""
    written = random_checkpoint.write(
        folder / "small",
        backbone=random_checkpoint.small_backbone("n1.5"),
        head=random_checkpoint.small_head("n1.5"),
    )
    return saccade.Policy.from_pretrained(written, num_threads=1)


def test_the_control_loop_continues_the_last_chunk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    loop = importlib.import_module("control_loop")
    policy = small_policy(tmp_path)
    thinker = loop.Thinker(policy, loop.Robot(policy, "open the drawer"), rate=10)
    thinker.tick = 4  # the next action is that of tick 5
    thinker.recent.append(0.25)
    plan = thinker.next_plan(thinker.plan)
    assert (thinker.plan.tick, plan.tick, thinker.delay) == (0, 5, 3)
    for part, values in plan.chunk.items():
        np.testing.assert_allclose(values[0, :3], thinker.plan.chunk[part][0, 5:8], rtol=1e-4, atol=1e-5)
        assert np.abs(values[0, 3:11] - thinker.plan.chunk[part][0, 8:]).max() > 1e-3
    assert plan.action(5)["gripper"] == plan.chunk["gripper"][0, 0]
    assert plan.action(21) is None
    # After the chunk has ended the robot stands still, so the next one begins with its first action.
    thinker.tick = 30
    later = thinker.next_plan(plan)
    assert later.tick == 31


def test_the_control_loop_ends_with_what_ended_the_policy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    loop = importlib.import_module("control_loop")
    policy = small_policy(tmp_path)
    robot = loop.Robot(policy, "open the drawer")
    thinker = loop.Thinker(policy, robot, rate=10)
    monkeypatch.setattr(robot, "observe", dict)
    thinker.start()
    record = loop.control(thinker, robot, rate=100, seconds=60)
    assert len(record.late) < 1000
    with pytest.raises(saccade.InputError):
        thinker.stop()


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
        # 20 steps: observations at 8 and 16, whose chunks come `delay` later.
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
