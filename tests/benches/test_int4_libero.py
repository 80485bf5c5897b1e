"""Runs of LIBERO at two precisions are paired by episode, and only if nothing else differs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benches.int4 import libero

ABOUT = {
    "checkpoint": {"name": "n17", "sha256": "c"},
    "protocol": {"name": "lerobot", "start": "official states"},
    "option_files": {},
    "noise": {"seed": 0},
    "saccade": "0.1.0",
    "instruction_set": "avx2",
    "packages": {"mujoco": "3.3.0"},
    "machine": {"cpu": "a CPU"},
}


def run(
    folder: Path,
    precision: str,
    episodes: dict[tuple[int, int], bool],
    embodiment: str | None = None,
    **changes: Any,
) -> Path:
    rows = [
        {"suite": "libero_object", "task": task, "trial": trial, "success": success, "steps": 9}
        for (task, trial), success in episodes.items()
    ]
    backbone, _, head = precision.partition(" ")
    options = {"precision": {"backbone": backbone, "head": head or backbone}, "embodiment": embodiment}
    folder.mkdir()
    (folder / "results.json").write_text(json.dumps(ABOUT | {"options": options, "episodes": rows} | changes))
    return folder


def test_episodes_are_paired_by_task_and_trial(tmp_path: Path) -> None:
    exact = run(tmp_path / "a", "float32", {(0, 0): True, (0, 1): False, (1, 0): True, (1, 1): True})
    rounded = run(tmp_path / "b", "int4", {(1, 0): False, (0, 1): True, (0, 0): True})
    (found,) = libero.measure([exact, rounded])
    assert found["runs"] == {
        "int4": {
            "tasks": ["libero_object"],
            "success": {"float32": [True, False, True], "int4": [True, True, False]},
        }
    }
    assert found["protocol"] == {"name": "lerobot", "start": "official states"}


def test_other_checkpoints_and_mixed_precisions_are_named(tmp_path: Path) -> None:
    exact = run(tmp_path / "a", "float32", {(0, 0): True})
    plain = run(tmp_path / "b", "int4", {(0, 0): False})
    rounded = run(tmp_path / "c", "int4", {(0, 0): True}, checkpoint={"name": "n17-int4", "sha256": "d"})
    mixed = run(tmp_path / "d", "int4 int8", {(0, 0): True})
    (found,) = libero.measure([exact, plain, rounded, mixed])
    assert {name: one["success"][name] for name, one in found["runs"].items()} == {
        "int4": [False],
        "int4: n17-int4": [True],
        "backbone int4, head int8": [True],
    }


def test_each_run_of_float32_begins_with_a_policy(tmp_path: Path) -> None:
    other: dict[str, Any] = {"checkpoint": {"name": "n17-spatial", "sha256": "e"}}
    runs = [
        run(tmp_path / "a", "float32", {(0, 0): True}),
        run(tmp_path / "b", "int4", {(0, 0): False}),
        run(tmp_path / "c", "float32", {(0, 0): False}, **other),
        run(tmp_path / "d", "int8", {(0, 0): True}, **other),
    ]
    found = libero.measure(runs)
    assert [(one["checkpoint"]["name"], list(one["runs"])) for one in found] == [
        ("n17", ["int4"]),
        ("n17-spatial", ["int8"]),
    ]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("protocol", {"name": "isaac-n17"}),
        ("option_files", {"x.json": "e"}),
        ("embodiment", "libero_sim"),
        ("machine", {"cpu": "another"}),
    ],
)
def test_runs_that_differ_in_more_are_refused(tmp_path: Path, name: str, value: Any) -> None:
    exact = run(tmp_path / "a", "float32", {(0, 0): True})
    rounded = run(tmp_path / "b", "int4", {(0, 0): True}, **{name: value})
    with pytest.raises(SystemExit, match=f"another {name} than in"):
        libero.measure([exact, rounded])


@pytest.mark.parametrize("others", [[], [{(1, 0): True}]])
def test_there_is_something_to_compare(tmp_path: Path, others: list[dict[tuple[int, int], bool]]) -> None:
    runs = [run(tmp_path / "a", "float32", {(0, 0): True})]
    runs += [run(tmp_path / "b", "int4", episodes) for episodes in others]
    with pytest.raises(SystemExit, match=r"expected (runs|episodes) of"):
        libero.measure(runs)


def test_the_first_run_is_of_float32(tmp_path: Path) -> None:
    runs = [run(tmp_path / name, name, {(0, 0): True}) for name in ("int4", "float32")]
    with pytest.raises(SystemExit, match=r"got int4$"):
        libero.measure(runs)
