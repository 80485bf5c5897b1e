"""The benchmark of peers as a program: it goes on where it stopped, and contenders may fail or be killed."""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
from multiprocessing.context import SpawnProcess
from pathlib import Path

import pytest

from benches.peers import __main__ as command
from benches.peers import processes
from benches.peers.cases import Case

ROOT = Path(__file__).resolve().parents[2]


def small(folder: Path) -> list[str]:
    """Options of a run at a small size."""
    return ["--size", "small", "--threads", "1", "--work", str(folder)]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """`python -m benches.peers` at a small size."""
    whole = [sys.executable, "-m", "benches.peers", *small(folder), *arguments]
    return subprocess.run(whole, cwd=ROOT, capture_output=True, text=True)


def test_a_contender_that_is_killed_in_a_round_leaves_the_others(tmp_path: Path) -> None:
    case = Case("head", 1, 7, 5, steps=1, size="small")
    processes.prepare(case, tmp_path)
    names = ["saccade-float32", "saccade-int8"]
    with processes.contenders(names, case, tmp_path) as (pipes, said):
        assert sorted(pipes) == sorted(names), said
        doomed = next(each for each in multiprocessing.active_children() if each.name == "saccade-int8")
        doomed.kill()
        doomed.join()
        seconds = processes.round_of(pipes, said, case.works, 0)
    assert list(seconds) == list(pipes) == ["saccade-float32"]
    assert set(seconds["saccade-float32"]) == set(case.works)


def test_it_runs_and_goes_on_where_it_stopped(tmp_path: Path, known_peaks: None) -> None:
    chosen = ["--only", "head", "--contenders", "saccade-float32", "torch-float32", "saccade-bfloat16"]
    chosen += ["--num-vl-tokens", "7", "--rounds", "1"]
    done = run(tmp_path, *chosen)
    assert done.returncode == 0, done.stderr
    first = json.loads((tmp_path / "results.json").read_text())
    assert [list(record["contenders"]) for record in first["records"]] == [
        ["saccade-float32"],
        ["saccade-bfloat16"],
        ["saccade-float32", "torch-float32"],
    ]
    assert first["peaks"][0]["macs_per_second"]["portable"]["float32"] > 0
    entry = first["records"][2]["contenders"]["torch-float32"]
    assert entry["error"] < 1e-4
    works = Case("head", 1).works
    assert {work: len(seconds) for work, seconds in entry["seconds"].items()} == dict.fromkeys(works, 1)
    assert (tmp_path / "report.md").exists()

    assert command.main([*small(tmp_path), *chosen]) == 0
    again = json.loads((tmp_path / "results.json").read_text())
    assert again["records"] == first["records"]


def test_a_contender_that_cannot_run_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_peaks: None
) -> None:
    monkeypatch.setenv("SACCADE_PEERS_GGML", str(tmp_path / "nowhere"))
    statuses = []
    kill = SpawnProcess.kill

    def killed(process: SpawnProcess) -> None:
        statuses.append(process.exitcode)
        kill(process)

    monkeypatch.setattr(SpawnProcess, "kill", killed)
    chosen = ["--only", "linear", "--contenders", "ggml-int8", "--linear-rounds", "0"]
    assert command.main([*small(tmp_path), *chosen]) == 0
    (record,) = json.loads((tmp_path / "results.json").read_text())["records"]
    assert "libggml-base.so" in record["contenders"]["ggml-int8"]["failed"]
    assert statuses == [0]  # its process was told to end, and had not to be waited for
