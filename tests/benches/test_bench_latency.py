"""The benchmark of latency: that it runs, adds to what it has, and prints what it measured."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benches import latency

ROOT = Path(__file__).parents[2]


def run(work: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benches.latency", *arguments, "--work", str(work)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


def test_sections_run_and_loaded_adds_up(tmp_path: Path) -> None:
    arguments = ["--size", "small", "--rounds", "1", "--contenders", "saccade-float32"]
    loaded = [*arguments, "--chunks", "3", "--chunks-a-turn", "3", "--busy", "1"]
    finished = run(tmp_path, "overhead", "callers", "small", "loaded", *loaded)
    assert finished.returncode == 0, finished.stderr
    assert run(tmp_path, "loaded", *loaded).returncode == 0
    report: dict[str, Any] = json.loads((tmp_path / "results.json").read_text())
    seconds = report["loaded"]["seconds"]["saccade-float32"]
    assert (len(seconds["quiet"]), len(seconds["loaded"])) == (4, 6)
    assert all(case["wrong"] == 0 for case in report["callers"]["cases"].values())
    printed = run(tmp_path, "report").stdout
    assert "| saccade float32 |" in printed
    assert "| encode |" in printed
    assert "The bundled policy's sizes" in printed
    assert f"{latency.NUM_CALLERS} callers" in printed
    assert not [*tmp_path.glob("*.part"), *tmp_path.glob(".*")]


def test_under_load_is_compared_with_quiet_by_medians() -> None:
    seconds = {"saccade-int8": {"quiet": [1.0, 1.0, 9.0], "loaded": [2.0] * 9 + [3.0]}}
    table = latency.loaded_table({"case": {"threads": 2}, "busy": 2, "seconds": seconds})
    assert table[-1] == "| saccade int8 | 1000 | 2000 | 2.00 | 1.05 | 1.46 | 10 |"


def test_several_callers_are_compared_with_one_in_the_same_round() -> None:
    rates = {"one": [10.0, 20.0, 10.0], "several": [20.0, 20.0, 5.0]}
    table = latency.callers_table({"threads": 2, "cases": {"a head": {"rates": rates, "wrong": 0}}})
    assert table[-1] == "| a head | 10 | 20 | 1.00 (0.50, 2.00) | 0 |"


@pytest.mark.parametrize("arguments", [["cold"], ["--contenders", "jax"]])
def test_what_is_not_known_is_refused(arguments: list[str], tmp_path: Path) -> None:
    finished = run(tmp_path, *arguments)
    assert finished.returncode == 2
    assert arguments[-1] in finished.stderr


def test_nothing_to_report(tmp_path: Path) -> None:
    finished = run(tmp_path, "report")
    assert finished.returncode == 1
    assert "results.json" in finished.stderr
