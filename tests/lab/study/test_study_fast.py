"""The study of fast modes by its command: in the simulator, and on features of a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade.cli import main
from saccade_lab.random_checkpoint import head as random_head
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference import random_weights
from saccade_lab.sim import graphics
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.study.questions import fast, fast_times
from saccade_lab.study.questions.fast_results import BASELINE, ONE_STEP
from saccade_lab.study.table import read_provenance, read_table
from tests.helpers.reference_cases import small_config


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random head in the released layout."""
    folder = tmp_path_factory.mktemp("checkpoint")
    random_weights.write_checkpoint(folder, small_config(), seed=1)
    return folder


def test_one_episode_in_every_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    of_size = random_head.config_of_size
    monkeypatch.setattr(random_head, "config_of_size", lambda size: of_size("small"))
    monkeypatch.setattr(fast_times, "FULL_TOKENS", 7)
    monkeypatch.setattr(fast_times, "MOST_ROUNDS", 3)
    monkeypatch.setattr(fast, "CALIBRATION_EPISODES", 1)
    modes = f"{ONE_STEP},float32-times-2,float32-euler-4-drop-50"
    arguments = ["--tasks", "reach", "--episodes", "1", "--modes", modes, "--out", str(tmp_path)]
    assert main(["study", "fast", *arguments]) == 0
    assert "No mode is judged" in capsys.readouterr().out
    table = read_table(tmp_path / "fast.csv")
    names = {*modes.split(","), BASELINE}
    for part, task in (("chunks", "reach"), ("episodes", "reach"), ("time", "own"), ("time", "n1.5")):
        assert set(table[(table["part"] == part) & (table["task"] == task)]["mode"]) == names
    chunks: Any = table[table["part"] == "chunks"].set_index("mode")
    assert chunks.loc[BASELINE, "chunk_change"] == 0.0
    assert chunks.loc[ONE_STEP, "chunk_change"] > 0.0
    assert chunks.loc[BASELINE, "chunk_error"] < chunks.loc[ONE_STEP, "chunk_error"]
    assert chunks.loc["float32-times-2", "chunk_error"] < chunks.loc[ONE_STEP, "chunk_error"]
    assert (chunks["noise_change"] > 0).all()

    # The baseline is what `saccade rollout` does.
    policy = Policy.from_pretrained(num_threads=1)
    environment = environment_for(policy, "reach")
    episode = run_episode(environment, policy, 0)
    environment.close()
    row: Any = table[table["part"] == "episodes"].set_index("mode").loc[BASELINE]
    assert (row["success"], row["steps"], row["chunks"]) == (episode.success, episode.steps, episode.chunks)
    assert len(table[(table["part"] == "calibrate") & (table["task"] == "mass")]) <= policy.num_vl_tokens()

    provenance = read_provenance(tmp_path / "fast.json")
    assert provenance.complete
    assert str(DEMO_CHECKPOINT) not in (tmp_path / "fast.json").read_text()  # tables are committed
    done = {path: path.stat().st_mtime_ns for path in (tmp_path / "fast" / "cells").iterdir()}
    more = [*arguments, "--parts", "chunks,episodes"]
    more[more.index(modes)] = f"{modes},float32-euler-2"
    assert main(["study", "fast", *more]) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in done.items())
    assert len(list((tmp_path / "fast" / "cells").iterdir())) == len(done) + 2

    assert main(["study", "report", str(tmp_path)]) == 0
    report = (tmp_path / "report.md").read_text()
    assert report.startswith("# What do faster modes cost, and what do they save?")
    assert "n-runtime" not in report
    assert (tmp_path / "figures" / "fast-errors.png").exists()


def features_file(folder: Path, **changes: Any) -> Path:
    config = saccade.HeadConfig.from_dict(small_config())
    inputs = random_weights.random_inputs(config, 2, batch=5, num_vl_tokens=6)
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in inputs.items() if name != "noise"}
    arrays |= {"embodiment_id": np.array([0, 2, 2, 2, 0]), "episode": np.array([7, 7, 3, 3, 7])} | changes
    np.savez(folder / "looks.npz", **{name: array for name, array in arrays.items() if array is not None})
    return folder / "looks.npz"


def on_features(checkpoint: Path, file: Path, out: Path, *more: str) -> int:
    return main(
        ["study", "fast", "--checkpoint", str(checkpoint), "--features", str(file), "--out", str(out), *more]
    )


def test_features_of_a_file_against_the_reference(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fast_times, "MOST_ROUNDS", 3)
    file = features_file(tmp_path)
    modes = "float32-euler-2,float32-times-2,float32-euler-4-drop-50"
    assert on_features(checkpoint, file, tmp_path / "out", "--modes", modes, "--seed", "4") == 0
    printed = capsys.readouterr().out
    assert "float32-euler-2: actions change by" in printed
    assert "times as much as with another noise" in printed
    assert "of the baseline's time (this checkpoint)" in printed
    assert "Success: not measured, a file of features has no closed loop." in printed

    table = read_table(tmp_path / "out" / "fast.csv")
    chunks: Any = table[table["part"] == "chunks"].set_index(["mode", "seed"])
    # Rows 2 and 3 are episode 3, the first in order, and calibrate; the rest measures calibrated modes.
    assert sorted(chunks.loc["float32-euler-2"].index) == [0, 1, 2, 3, 4]
    assert sorted(chunks.loc["float32-times-2"].index) == [0, 1, 4]
    assert set(table[table["part"] == "time"]["mode"]) == {BASELINE, *modes.split(",")}
    assert set(table[table["part"] == "time"]["task"]) == {"own"}

    arrays, reference = np.load(file), Reference.from_pretrained(checkpoint, dtype=torch.float64)
    for row in range(5):
        noise = np.random.default_rng([4, row]).standard_normal((1, 4, 5, 3), dtype=np.float32)

        def chunk(steps: int, draw: int, row: int = row, noise: Any = noise) -> Any:
            with torch.no_grad():
                vl_embs = reference.encode(arrays["backbone_features"][row : row + 1])
                embodiment, start = int(arrays["embodiment_id"][row]), noise[:, draw]
                state = arrays["state"][row : row + 1]
                return reference.sample(vl_embs, state, embodiment, noise=start, num_steps=steps).numpy()

        found: Any = chunks.loc[("float32-euler-2", row)]
        assert found["chunk_change"] == pytest.approx(np.abs(chunk(2, 0) - chunk(4, 0)).mean(), rel=1e-3)
        assert found["noise_change"] == pytest.approx(np.abs(chunk(4, 1) - chunk(4, 0)).mean(), rel=1e-3)
    assert "episode 3" not in printed
    assert json.loads((tmp_path / "out" / "fast.json").read_text())["settings"]["features"]["episodes"] == 2
    assert main(["study", "report", str(tmp_path / "out")]) == 0
    assert "on recorded observations" in (tmp_path / "out" / "report.md").read_text()


def test_one_episode_calibrates_nothing_and_removed_positions_stay_so(
    checkpoint: Path, tmp_path: Path
) -> None:
    dropped = np.zeros((5, 6), bool)
    dropped[:, :2] = True
    file = features_file(tmp_path, episode=np.zeros(5, np.int64), drop_vl=dropped)
    arguments = ("--parts", "chunks", "--modes", "float32-euler-2,float32-times-2")
    assert on_features(checkpoint, file, tmp_path / "out", *arguments) == 0
    table = read_table(tmp_path / "out" / "fast.csv")
    assert set(table["mode"]) == {BASELINE, "float32-euler-2"}
    shorter = np.load(file)["backbone_features"][:, 2:]
    file = features_file(tmp_path, episode=np.zeros(5, np.int64), backbone_features=shorter)
    assert on_features(checkpoint, file, tmp_path / "shorter", *arguments) == 0
    columns = ["chunk_change", "chunk_error"]
    np.testing.assert_allclose(
        table[columns], read_table(tmp_path / "shorter" / "fast.csv")[columns], atol=1e-5
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--modes", "float32-rk4-2"), "mode: given 'float32-rk4-2'"),
        (("--parts", "episodes"), "not with --features"),
        (("--parts", "loops"), "parts: unknown name 'loops', expected one of chunks, episodes, time"),
        (("--tasks", "reach"), "--tasks: not with --features"),
        (("--seed", "-1"), "--seed: given -1"),
    ],
)
def test_bad_input_is_one_line(
    checkpoint: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    assert on_features(checkpoint, features_file(tmp_path), tmp_path / "out", *arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1
    assert not (tmp_path / "out" / "fast.csv").exists()


def test_a_missing_file_is_named(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert on_features(checkpoint, tmp_path / "none.npz", tmp_path / "out") == 2
    assert "none.npz" in capsys.readouterr().err
    file = features_file(tmp_path, backbone_features=np.zeros((5, 6, 3), np.float32))
    assert on_features(checkpoint, file, tmp_path / "out") == 2
    assert "backbone_features" in capsys.readouterr().err
