"""The program that measures farms: what it runs, what it leaves out, its processes, and the page."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benches import checkpoints, farm, farm_processes, farm_report
from benches.farm_processes import Robot, Setting
from saccade_lab import random_checkpoint
from tests.helpers.descendants import all_end, descendants, usual_interrupt

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_checkpoint.write(
        tmp_path_factory.mktemp("farm") / "n15",
        backbone=random_checkpoint.small_backbone("n1.5"),
        head=random_checkpoint.small_head("n1.5"),
    )


def test_settings_use_all_cores_and_the_important_ones_come_first() -> None:
    found = list(farm.settings(farm.parse(["--cores", "4", "--batches", "1", "2"])))
    assert all(one.processes * one.threads == 4 for one in found if one.policy == "full")
    first = [one for one in found if one.policy == "demo" and one.section == "chunks"]
    assert found[: len(first)] == first
    shapes = [(one.processes, one.threads, one.batch) for one in first if one.sharing == "fork"]
    assert shapes == [(1, 1, 1), *((n, 4 // n, batch) for batch in (1, 2) for n in (4, 2, 1))]
    engines = [(one.engine, one.batch) for one in found if one.policy == "full"]
    assert engines.index(("torch", 1)) < engines.index(("saccade", 4))  # time may end before the last ones
    assert {one.section for one in found if one.policy == "full"} == {"chunks"}
    assert [one for one in found if one.sharing == "spawn" and one.engine == "saccade"] == [
        Setting("chunks", "demo", "float32", 4, 1, 1, sharing="spawn"),
        Setting("chunks", "full", "bfloat16", 4, 1, 1, sharing="spawn"),
    ]
    assert [one.least_episodes for one in found if one.least_episodes] == [20]
    none = farm.parse(["--engines", "saccade", "--sections", "episodes", "--policies", "full"])
    assert list(farm.settings(none)) == []


def test_what_does_not_fit_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    setting = Setting("chunks", "full", "bfloat16", 2, 1, 1)
    assert farm.why_not(setting, 5 * 10**9, 0.0) == "no time left"
    monkeypatch.setattr(farm, "available_memory", lambda: 8 * 10**9)
    later = time.monotonic() + 60
    assert farm.why_not(setting, 5 * 10**9, later) is None
    each = dataclasses.replace(setting, sharing="spawn")
    assert farm.why_not(each, 5 * 10**9, later) == "needs about 12 GB, 8 GB are free"


def test_processes_run_and_their_memory_is_read(checkpoint: Path, tmp_path: Path) -> None:
    few = ["--policies", "full", "--engines", "saccade", "--cores", "2", "--full-batches", "2"]
    own = ["--checkpoint", str(checkpoint), "--seconds", "0.05", "--work", str(tmp_path)]
    assert farm.main([*few, *own]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["left_out"] == []
    rows = results["rows"]
    assert [(row["processes"], row["threads"], row["batch"], row["sharing"]) for row in rows] == [
        (2, 1, 2, "fork"),
        (1, 2, 2, "fork"),
        (2, 1, 2, "spawn"),
    ]
    for row in rows:
        assert len(row["chunks"]) == row["processes"]
        assert min(row["chunks"]) >= row["batch"]
        assert len(row["memory"]) == row["processes"] + (row["sharing"] == "fork")
        assert all(0 < one["private"] <= one["pss"] for one in row["memory"])
    assert farm.main(["report", "--work", str(tmp_path)]) == 0


def measured_by_nobody(setting: Setting, checkpoint: Path, seconds: float) -> dict[str, Any]:
    """What `measure` returns, at once."""
    count = setting.processes
    numbers = {"chunks": 7, "seconds": 2.0, "episodes": 3, "successes": 2, "lengths": 30}
    memory = [{"pss": 10**9, "private": 10**8}] * (count + (setting.sharing == "fork"))
    return {name: [value] * count for name, value in numbers.items()} | {"memory": memory}


def test_a_run_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begun: list[Setting] = []

    def stopped(setting: Setting, checkpoint: Path, seconds: float) -> dict[str, Any]:
        begun.append(setting)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return measured_by_nobody(setting, checkpoint, seconds)

    monkeypatch.setattr(farm, "measure", stopped)
    arguments = ["--policies", "demo", "--cores", "2", "--work", str(tmp_path), "--seconds", "1"]
    with pytest.raises(KeyboardInterrupt):
        farm.main(arguments)
    assert len(json.loads((tmp_path / "results.json").read_text())["rows"]) == 2
    assert farm.main(arguments) == 0
    assert begun[2] == begun[3]  # it was interrupted
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert len(rows) == len(list(farm.settings(farm.parse(arguments)))) == len(begun) - 1
    assert farm.main(arguments) == 0
    assert len(begun) == len(rows) + 1  # nothing was left to do

    # Other settings are added; other seconds are another measurement.
    capsys.readouterr()
    assert farm.main([*arguments, "--batches", "3"]) == 0
    assert len(json.loads((tmp_path / "results.json").read_text())["rows"]) > len(rows)
    assert farm.main([*arguments[:-1], "2"]) == 0
    assert "it is now" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "results.json").read_text())["rows"]) == len(rows)
    assert len(list(tmp_path.glob("results-*.json"))) == 1


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_run_leaves_no_process(checkpoint: Path, tmp_path: Path, sign: signal.Signals) -> None:
    few = ["--policies", "full", "--engines", "saccade", "--cores", "2", "--full-batches", "1"]
    own = ["--checkpoint", str(checkpoint), "--seconds", "600", "--work", str(tmp_path)]
    command = [sys.executable, "-m", "benches.farm", *few, *own]
    program = subprocess.Popen(command, cwd=ROOT, preexec_fn=usual_interrupt)
    try:
        # The holder, its two forked processes, and multiprocessing's own.
        while len(found := descendants(program.pid)) < 4:
            assert program.poll() is None
            time.sleep(0.02)
        program.send_signal(sign)
        assert program.wait(60) == {signal.SIGTERM: 143, signal.SIGINT: 130}[sign]
    finally:
        program.kill()
        program.wait()
    assert all_end(found, seconds=60)


def test_a_mistyped_checkpoint_is_refused_and_stays_empty(tmp_path: Path) -> None:
    for flag in ("--checkpoint", "--demo"):
        with pytest.raises(SystemExit, match="expected the directory of a checkpoint"):
            farm.main([flag, str(tmp_path / "typo"), "--work", str(tmp_path / "work"), "--small"])
    assert not (tmp_path / "typo").exists()


def test_a_random_checkpoint_is_written_once_and_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "n15-small.part").mkdir()
    (tmp_path / "n15-small.part" / "half").touch()  # of a run that was killed
    folder = checkpoints.n15(tmp_path, small=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["n15-small"]
    assert not (folder / "half").exists()
    monkeypatch.setattr(random_checkpoint, "write", None)
    assert checkpoints.n15(tmp_path, small=True) == folder
    assert checkpoints.n15(tmp_path, small=False, given=folder) == folder
    (folder / "config.json").unlink()
    with pytest.raises(SystemExit, match="expected a checkpoint or an empty directory"):
        checkpoints.n15(tmp_path, small=True)


def test_a_process_that_fails_is_reported(tmp_path: Path) -> None:
    found = farm_processes.measure(Setting("chunks", "full", "float32", 1, 1, 1), tmp_path, 0.1)
    assert "Error" in found["failed"]


class Task:
    max_steps = 5


class Simulation:
    """Succeeds at its fourth step."""

    task = Task()

    def __init__(self, succeeds_at: int) -> None:
        self.step, self.succeeds_at = 0, succeeds_at

    def advance(self, action: Any) -> Any:
        self.step += 1
        return type("Outcome", (), {"success": self.step == self.succeeds_at})


def test_an_episode_ends_with_success_or_its_last_step() -> None:
    robot = Robot(Simulation(4))
    assert not robot.advance(np.zeros((3, 4)))
    assert robot.advance(np.zeros((3, 4)))
    assert (robot.success, robot.steps, robot.chunks) == (True, 4, 2)
    robot = Robot(Simulation(9))
    assert not robot.advance(np.zeros((3, 4)))
    assert robot.advance(np.zeros((3, 4)))
    assert (robot.success, robot.steps, robot.chunks) == (False, 5, 2)


@pytest.fixture
def results() -> dict[str, Any]:
    """Measurements of two cores."""

    def row(setting: Setting, *chunks: int, pss: int = 10**9, whole: bool = False) -> dict[str, Any]:
        counts = {"chunks": list(chunks), "seconds": [2.0] * len(chunks)}
        memory = [{"pss": pss, "private": pss // 2}] * (len(chunks) + (setting.sharing == "fork"))
        ended = {"episodes": [20], "successes": [18], "lengths": [200]} if whole else {"episodes": [0]}
        return dataclasses.asdict(setting) | counts | ended | {"memory": memory}

    return {
        "machine": {
            "cpu": "A CPU",
            "family": "family 1",
            "isa": "avx512",
            "cores": 2,
            "memory_gb": 8,
            "kernel": "6",
            "versions": {"saccade": "1", "torch": "2"},
            "commit": "abc",
        },
        "names": {"demo": "bundled policy", "full": "random N1.5"},
        "rows": [
            row(Setting("chunks", "demo", "float32", 2, 1, 1), 100, 140),
            row(Setting("chunks", "demo", "float32", 2, 1, 4), 400, 400),
            row(Setting("chunks", "demo", "float32", 2, 1, 1, sharing="spawn"), 120, 120, pss=3 * 10**9),
            row(Setting("chunks", "demo", "float32", 2, 1, 1, "torch", "spawn"), 20, 20),
            row(Setting("episodes", "demo", "float32", 1, 1, 1, least_episodes=20), 20, whole=True),
            row(Setting("episodes", "demo", "float32", 2, 1, 1), 15, 15),
        ],
        "left_out": [
            {
                "setting": dataclasses.asdict(Setting("chunks", "full", "bfloat16", 2, 1, 4)),
                "reason": "no time left",
            }
        ],
    }


def test_the_page(
    results: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    page = farm_report.document(results)
    choice = "| bundled policy, float32: chunks a second | most in all | 2 x 1 | 4 | 400 | 20.0 | 3.0 |"
    assert choice in page
    assert "most, one observation at a time | 2 x 1 | 1 | 120 | 6.0 | 3.0 |" in page
    # 15 chunks a second, and 10 chunks an episode.
    assert "episodes an hour | most in all | 2 x 1 | 1 | 5400 |" in page
    assert "An episode takes 10.0 chunks in the mean of 20, of which 18 succeeded." in page
    assert "| bundled policy, float32 | 2 | fork: one copy of the weights | 3.00 | 0.50 | 120 |" in page
    assert "| bundled policy, float32 | 2 | spawn: one copy each | 6.00 | 1.50 | 120 |" in page
    assert "- random N1.5, chunks a second, saccade, 2 x 1, batch 4, fork: no time left" in page

    (tmp_path / "results.json").write_text(json.dumps(results))
    written = tmp_path / "farm.md"
    monkeypatch.setattr(farm_report, "PAGE", written)
    monkeypatch.setattr(farm_report, "COMMITTED", tmp_path / "farm.json")
    for _ in range(2):
        assert farm.main(["report", "--write", "--work", str(tmp_path)]) == 0
    assert written.read_text().count(choice) == 1
    assert written.read_text().startswith("# Many processes")
    assert (tmp_path / "farm.json").exists()
    assert str(written) in capsys.readouterr().out


def test_arguments_are_checked() -> None:
    wrong = (["--batches", "0"], ["--seconds", "0"], ["--policies", "other"], ["--cores", "0"])
    for arguments in (*wrong, ["report", "--small", "--write"]):
        with pytest.raises(SystemExit):
            farm.parse(arguments)
