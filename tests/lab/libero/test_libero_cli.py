"""``saccade demos --env`` and ``saccade train`` on recordings of LIBERO, as a user calls them."""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade.cli import main
from saccade_lab.cli import demos as command
from saccade_lab.cli.demos import task_numbers
from saccade_lab.libero.demos import EXPERTS
from tests.helpers.libero_cases import write_recording

SMALL = [
    *("--batch-size", "2", "--width", "32", "--num-layers", "2", "--view-size", "32"),
    *("--training-steps", "1"),
]


def test_a_policy_is_trained_and_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("saccade_lab.training.train.VALIDATION_FRAMES", 3)
    demos, out = write_recording(tmp_path / "demos"), tmp_path / "policy"
    assert main(["train", "--demos", str(demos), "--out", str(out), *SMALL]) == 0
    assert f"saccade libero {out}" in capsys.readouterr().out
    settings = json.loads((out / "settings.json").read_text())
    assert settings["steps"] == 1
    assert settings["version"] == "n1.7"
    assert settings["execute_steps"] == 8
    assert settings["absent_share"] == 0
    assert settings["demonstrations"]["tasks"] == {"libero_object-0": 2, "libero_object-1": 2}
    assert saccade.Policy.from_pretrained(out).head.config.version == "n1.7"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--start-from", "."], "--start-from: not with demonstrations of LIBERO"),
        (["--absent-share", "0.1"], "absent_share: given 0.1, expected 0"),
        (["--view-size", "40"], "view_size: given 40, expected a multiple of 32"),
    ],
)
def test_what_training_on_libero_does_not_have_is_refused(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demos = write_recording(tmp_path / "demos")
    (demos / "model.safetensors").touch()
    arguments = [str(demos) if word == "." else word for word in arguments]
    assert main(["train", "--demos", str(demos), "--out", str(tmp_path / "out"), *arguments]) != 0
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--version", "n1.7"], ["--view-size", "64"]])
def test_flags_of_libero_are_refused_on_other_demonstrations(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--demos", str(tmp_path), "--out", str(tmp_path / "out"), *arguments]) != 0
    assert "only with demonstrations of LIBERO" in capsys.readouterr().err


def test_without_the_packages_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_spec = importlib.util.find_spec

    def without_libero(name: str, *rest: Any) -> Any:
        return None if name in ("libero", "robosuite") else find_spec(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", without_libero)
    assert main(["demos", "--env", "libero_object", "--out", str(tmp_path)]) != 0
    printed = capsys.readouterr().err
    assert "libero and robosuite are not installed. Install with:" in printed
    assert printed.count("\n") == 1


def test_the_numbers_of_tasks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert task_numbers(None) is None
    assert task_numbers(["3", "0", "3"]) == [0, 3]
    for word in ("reach", "-1", "1.5", "²"):
        arguments = ["demos", "--env", "libero_object", f"--tasks={word}", "--out", str(tmp_path)]
        assert main(arguments) != 0
        assert f"--tasks: expected numbers of LIBERO's tasks, got {word}" in capsys.readouterr().err


def test_the_suites_that_can_be_recorded_are_those_with_an_expert() -> None:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    (env,) = (action for action in parser._actions if action.dest == "env")
    assert tuple(env.choices or ()) == tuple(EXPERTS)
