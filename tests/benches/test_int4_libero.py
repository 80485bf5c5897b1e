"""Runs of LIBERO at two precisions are paired by episode, and only if nothing else differs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benches.int4 import libero

ABOUT = {
    "checkpoint": {"name": "n17", "sha256": "c"},
    "protocol": {"name": "lerobot"},
    "noise": {"seed": 0},
    "saccade": "0.1.0",
    "instruction_set": "avx2",
    "packages": {"mujoco": "3.3.0"},
    "machine": {"cpu": "a CPU"},
}


def run(folder: Path, precision: str, episodes: dict[tuple[int, int], bool], **changes: Any) -> Path:
    rows = [
        {"suite": "libero_object", "task": task, "trial": trial, "success": success, "steps": 9}
        for (task, trial), success in episodes.items()
    ]
    options = {"precision": {"backbone": precision, "head": precision}}
    folder.mkdir()
    (folder / "results.json").write_text(json.dumps(ABOUT | {"options": options, "episodes": rows} | changes))
    return folder


def test_episodes_are_paired_by_task_and_trial(tmp_path: Path) -> None:
    exact = run(tmp_path / "a", "float32", {(0, 0): True, (0, 1): False, (1, 0): True, (1, 1): True})
    rounded = run(tmp_path / "b", "int4", {(1, 0): False, (0, 1): True, (0, 0): True})
    found = libero.measure([exact, rounded])
    assert found["success"] == {"float32": [True, False, True], "int4": [True, True, False]}
    assert found["tasks"] == ["libero_object"]
    assert found["protocol"] == "lerobot"


@pytest.mark.parametrize(
    ("name", "value"), [("checkpoint", {"name": "n17", "sha256": "d"}), ("protocol", {"name": "isaac-n17"})]
)
def test_runs_that_differ_in_more_are_refused(tmp_path: Path, name: str, value: Any) -> None:
    exact = run(tmp_path / "a", "float32", {(0, 0): True})
    rounded = run(tmp_path / "b", "int4", {(0, 0): True}, **{name: value})
    with pytest.raises(SystemExit, match=f"another {name} than in"):
        libero.measure([exact, rounded])


def test_the_first_run_is_of_float32(tmp_path: Path) -> None:
    runs = [run(tmp_path / name, name, {(0, 0): True}) for name in ("int4", "float32")]
    with pytest.raises(SystemExit, match="got int4, float32"):
        libero.measure(runs)
