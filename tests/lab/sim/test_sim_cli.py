"""`saccade rollout`, `demos` and `train` as a user calls them."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image

import saccade_lab.sim.rollout
from saccade.cli import main
from saccade_lab.intervals import wilson
from saccade_lab.sim import graphics, report
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.sim.rollout import Episode
from tests.helpers.descendants import all_end, descendants, usual_interrupt

run_episode = saccade_lab.sim.rollout.run_episode


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


def read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text()))


def test_rollout_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["--tasks", "button-press-topdown", "--episodes", "2", "--num-threads", "1", "--video"]
    assert main(["rollout", *arguments, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "2/2" in printed
    assert str(out / "results.json") in printed
    assert str(out / "videos") in printed

    results = read(out / "results.json")
    assert results["complete"] is True
    assert results["seeds"] == [0, 1]
    assert results["success_rate"] == 1.0
    assert len(results["checkpoint"]["sha256"]) == 64
    assert results["engine"]["name"] == "rust"
    assert results["engine"]["num_threads"] == 1
    assert results["machine"]["cpu"]
    assert results["packages"].keys() >= {"saccade", "numpy", "mujoco", "metaworld"}
    assert [episode["seed"] for episode in results["episodes"]] == [0, 1]
    assert all(0 < episode["steps"] <= 200 for episode in results["episodes"])
    names = ["button-press-topdown-0.mp4", "button-press-topdown-1.mp4"]
    assert [episode["video"] for episode in results["episodes"]] == [f"videos/{name}" for name in names]
    assert results["summary"][0]["milliseconds"].keys() == {"render", "backbone", "encode", "sample"}

    with Image.open(out / "contact-sheet.png") as sheet:
        assert sheet.size == (2 * report.TILE, report.TILE + report.LABEL_HEIGHT)
    videos = sorted((out / "videos").iterdir())
    assert [video.name for video in videos] == names
    pictures = [np.asarray(picture) for picture in imageio.mimread(videos[0])]
    assert len(pictures) > 20
    assert pictures[0].shape == (400, 480, 3)
    assert pictures[0][:40].max() > 200  # the instruction is written there


def test_the_same_seeds_give_the_same_episodes_with_torch(tmp_path: Path) -> None:
    outcomes = []
    for engine in ("rust", "torch"):
        out = tmp_path / engine
        arguments = [
            "--engine",
            engine,
            "--tasks",
            "reach",
            "--episodes",
            "1",
            "--seed",
            "3",
            "--num-threads",
            "1",
        ]
        assert main(["rollout", *arguments, "--out", str(out)]) == 0
        outcomes.append(read(out / "results.json")["episodes"][0])
    assert outcomes[0]["success"] == outcomes[1]["success"]
    assert abs(outcomes[0]["steps"] - outcomes[1]["steps"]) <= 1


def test_ctrl_c_keeps_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def second_is_interrupted(*args: Any, on_step: Any, **options: Any) -> Episode:
        seed = args[2]

        def interrupt(environment: Any, episode: Episode) -> None:
            on_step(environment, episode)
            if seed == 1 and episode.steps == 5:
                raise KeyboardInterrupt

        return run_episode(*args, on_step=interrupt, **options)

    monkeypatch.setattr(saccade_lab.sim.rollout, "run_episode", second_is_interrupted)
    arguments = [
        "--tasks",
        "reach,push",
        "--episodes",
        "3",
        "--num-threads",
        "1",
        "--video",
        "--out",
        str(tmp_path),
    ]
    assert main(["rollout", *arguments]) == 130
    results = read(tmp_path / "results.json")
    assert results["complete"] is False
    assert [(episode["task"], episode["seed"]) for episode in results["episodes"]] == [("reach", 0)]
    assert {path.name for path in tmp_path.rglob("*")} == {
        "results.json",
        "contact-sheet.png",
        "videos",
        "reach-0.mp4",
    }
    assert "1/1" in capsys.readouterr().out


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGINT])
def test_a_command_that_is_ended_ends_its_processes(tmp_path: Path, sign: signal.Signals) -> None:
    arguments = ["demos", "--tasks", "reach", "--episodes", "5000", "--jobs", "2", "--out", str(tmp_path)]
    program = subprocess.Popen([sys.executable, "-m", "saccade", *arguments], preexec_fn=usual_interrupt)
    try:
        # One of loky's own, and two that record.
        while len(found := descendants(program.pid)) < 3 or not list(tmp_path.glob("reach/[0-9]*.npz")):
            assert program.poll() is None
            time.sleep(0.02)
        program.send_signal(sign)
        assert program.wait(60) == {signal.SIGTERM: 143, signal.SIGINT: 130}[sign]
    finally:
        program.kill()
        program.wait()
    assert all_end(found, seconds=60)


def test_json_prints_the_result_file_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "--tasks",
        "reach",
        "--episodes",
        "1",
        "--json",
        "--num-threads",
        "1",
        "--out",
        str(tmp_path),
    ]
    assert main(["rollout", *arguments, "--instruction-from", "window-open"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == read(tmp_path / "results.json")
    assert printed["instruction_from"] == "window-open"
    assert "window" in printed["episodes"][0]["instruction"]


CASES: list[tuple[Sequence[str], str]] = [
    (["rollout", "--tasks", "reach,fly"], "unknown name 'fly'"),
    (["rollout", "--tasks", ","], "expected at least one name"),
    (["rollout", "--episodes", "0"], "--episodes: given 0, expected at least 1"),
    (["rollout", "--episodes", "-3"], "episodes: given -3"),
    (["rollout", "--seed", "1000000"], "evaluation seeds"),
    (["rollout", "--num-threads", "0"], "--num-threads: given 0"),
    (["rollout", "--instruction-from", "fly"], "unknown name 'fly'"),
    (["rollout", "--checkpoint", "nowhere"], "nowhere: no such checkpoint"),
    (["demos", "--tasks", "fly"], "unknown name 'fly'"),
    (["demos", "--episodes", "0"], "--episodes: given 0"),
    (["demos", "--image-size", "2"], "--image-size: given 2"),
    (["demos", "--frame-stride", "0"], "--frame-stride: given 0"),
    (["train", "--demos", "nowhere"], "nowhere: no demonstrations found"),
    (["train", "--demos", "nowhere", "--training-steps", "0"], "--training-steps: given 0"),
    (["train", "--demos", "nowhere", "--num-future-tokens", "-1"], "--num-future-tokens: given -1"),
    (["train", "--demos", "nowhere", "--learning-rate", "nan"], "--learning-rate: given nan"),
    (["train", "--demos", "nowhere", "--absent-share", "1"], "--absent-share: given 1.0"),
    (["train", "--demos", "nowhere", "--language-dropout", "-1"], "--language-dropout: given -1"),
    (["train", "--demos", "nowhere", "--start-from", "missing"], "missing: no policy there"),
    (["train", "--demos", "nowhere", "--num-threads", "0"], "--num-threads: given 0"),
]


@pytest.mark.parametrize(("arguments", "message"), CASES)
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: Sequence[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*arguments, "--out", "out"]) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["rollout", "demos"])
def test_an_output_that_cannot_be_written_is_named(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main([command, "--tasks", "reach", "--out", str(tmp_path / "file" / "out")]) == 2
    assert "file" in capsys.readouterr().err
    assert main([command, "--tasks", "reach", "--out", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err == f"saccade: {tmp_path / 'file'}: exists and is not a directory\n"


def test_missing_opengl_is_found_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> None:
        raise graphics.GraphicsError(graphics.advice("no driver"))

    monkeypatch.setattr(graphics, "check", broken)
    for command in ("rollout", "demos"):
        assert main([command, "--out", str(tmp_path / "out")]) == 2
        assert "apt-get install libegl1" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_broken_checkpoint_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = Path(shutil.copytree(DEMO_CHECKPOINT, tmp_path / "broken"))
    (broken / "model.safetensors").write_bytes(b"\xff" * 64)
    assert main(["rollout", "--checkpoint", str(broken), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_demos_then_train_as_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, policy = str(tmp_path / "demos"), str(tmp_path / "policy")
    sizes = ["--image-size", "16", "--frame-stride", "8"]
    assert main(["demos", "--out", recording, "--tasks", "reach", "--episodes", "1", *sizes]) == 0
    settings = [
        "--training-steps",
        "2",
        "--batch-size",
        "2",
        "--width",
        "16",
        "--num-layers",
        "2",
        "--patch-size",
        "8",
    ]
    assert main(["train", "--demos", recording, "--out", policy, *settings]) == 0
    assert "saccade rollout --checkpoint" in capsys.readouterr().out
    assert main(["train", "--demos", recording, "--out", policy, *settings, "--seed", "1"]) == 2
    assert "other settings (seed)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    # From statsmodels 0.14, proportion_confint(method="wilson").
    [
        (0, 20, 0.0, 0.161125),
        (18, 20, 0.698966, 0.972131),
        (20, 20, 0.838875, 1.0),
        (92, 100, 0.850022, 0.958907),
    ],
)
def test_wilson_interval(successes: int, trials: int, low: float, high: float) -> None:
    np.testing.assert_allclose(wilson(successes, trials), (low, high), atol=1e-5)


def test_wilson_interval_of_nothing_is_everything() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
