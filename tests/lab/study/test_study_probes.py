"""The study of probes: known R^2 on made-up rows, controls that must fail, and the shipped policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
from sklearn.linear_model import Ridge
from sklearn.model_selection import GridSearchCV, GroupKFold

from saccade.cli import main
from saccade_lab.reference import ActionHead
from saccade_lab.sim import graphics
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.study import linear_probes
from saccade_lab.study.linear_probes import PROPRIO, VL, Frames
from saccade_lab.study.questions import probes
from saccade_lab.study.simulator import environment_of, head_of, policy_of, record_episode
from saccade_lab.study.table import read_provenance, read_table

CHECKPOINT = str(DEMO_CHECKPOINT)
TASK = "reach"


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Small matrices: more threads only wait for each other."""
    torch.set_num_threads(1)


def made_up(
    episodes: int = 60, looks: int = 5, tasks: int = 2, seed: int = 0
) -> tuple[np.random.Generator, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Random numbers, and the episode and task of every frame."""
    numbers = np.repeat(np.arange(episodes), looks)
    return np.random.default_rng(seed), numbers, numbers % tasks


def known_frames(noise: float) -> Frames:
    """A target of variance 1 within episodes and tasks, and rows that hold half of it linearly."""
    rng, episodes, tasks = made_up()
    signal, hidden = rng.standard_normal((2, len(episodes), 2))
    target = signal + noise * hidden + 5.0 * tasks[:, None]
    mixed = signal @ rng.standard_normal((2, 40)) + 0.01 * rng.standard_normal((len(episodes), 40))
    inputs = {
        PROPRIO: rng.standard_normal((len(episodes), 4)),
        VL: mixed,
        ("future", 0, "all"): np.stack([tasks, 1 - tasks], axis=1) + 0.0,
        ("future", 1, "all"): rng.standard_normal((len(episodes), 500)),
        ("future", 2, "all"): mixed,
    }
    return Frames(episodes, tasks, inputs, {"goal": target, "still": np.full((len(episodes), 1), 7.0)})


def test_known_shares_are_found_and_controls_fail() -> None:
    rows = {
        (row["rows"], row["block"]): row
        for row in linear_probes.probe(known_frames(noise=1.0), dimensions=32)
    }
    assert {row["target"] for row in rows.values()} == {"goal"}  # what never moves is left out
    # Half of the variance is in the rows; the offset between tasks does not count.
    assert rows["vl_embs", -1]["r2"] == pytest.approx(0.5, abs=0.08)
    assert rows["vl_embs", -1]["r2_low"] < 0.5 < rows["vl_embs", -1]["r2_high"]
    assert rows["vl_embs", -1]["spread"] == pytest.approx(2.0, rel=0.1)  # root of 2 coordinates of variance 2
    # What only names the task tells nothing within tasks, noise tells nothing at all.
    for source in (("future", 0), ("future", 1), PROPRIO[:2]):
        assert rows[source]["r2"] == pytest.approx(0.0, abs=0.06)
    for row in rows.values():
        assert row["shuffled"] == pytest.approx(0.0, abs=0.06)
        assert row["shuffled_low"] <= row["shuffled"] <= row["shuffled_high"]
    # Paired: the same rows under another name differ by nothing, without an interval.
    same = rows["future", 2]
    assert (same["over_vl"], same["over_vl_low"], same["over_vl_high"]) == (0.0, 0.0, 0.0)
    assert same["over_proprio_low"] > 0.3
    assert (same["episodes"], same["frames"]) == (60, 300)


def test_penalties_are_those_of_sklearn_s_search() -> None:
    rng, episodes, _ = made_up(episodes=12, seed=3)
    values = rng.standard_normal((len(episodes), 20))
    easy = values[:, :3] + 0.1 * rng.standard_normal((len(episodes), 3))
    hopeless = rng.standard_normal((len(episodes), 1))
    owners = np.array([0, 0, 0, 1])
    found = linear_probes.best_penalties(values, np.concatenate((easy, hopeless), axis=1), owners, episodes)
    for penalty, target in zip(found, (easy, hopeless), strict=True):
        search = GridSearchCV(
            Ridge(),
            {"alpha": linear_probes.PENALTIES},
            cv=GroupKFold(linear_probes.INNER_FOLDS),
            scoring="neg_mean_squared_error",
        )
        best = search.fit(values, target, groups=episodes).best_params_["alpha"]
        assert linear_probes.PENALTIES[penalty] == best
    assert found[0] < found[1]


def test_shuffled_targets_come_from_another_episode_of_the_task_look_by_look() -> None:
    lengths = [3, 1, 4, 2]
    episodes = np.repeat(np.arange(4), lengths)
    tasks = np.array([0, 0, 1, 1])[episodes]
    looks = np.concatenate([np.arange(length) for length in lengths])
    targets = {"goal": np.stack([episodes, looks], axis=1).astype(float)}
    found = linear_probes.shuffled_targets(Frames(episodes, tasks, {}, targets))["goal"]
    assert found.tolist() == [
        [1, 0], [1, 0], [1, 0],
        [0, 0],
        [3, 0], [3, 1], [3, 1], [3, 1],
        [2, 0], [2, 1],
    ]  # fmt: skip


def test_errors_are_held_out_by_episode() -> None:
    """Rows that name their episode would tell its target, had any of its frames been trained on."""
    rng, episodes, tasks = made_up(episodes=30, tasks=1)
    named = np.eye(30)[episodes]
    target = rng.standard_normal((30, 1))[episodes]
    frames = Frames(episodes, tasks, {PROPRIO: named, VL: named}, {"goal": target})
    for row in linear_probes.probe(frames, dimensions=30):
        assert row["r2"] < 0.05


def test_frames_are_the_rows_of_the_reference(tmp_path: Path) -> None:
    recorded, step = record_episode(environment_of(CHECKPOINT, TASK), policy_of(CHECKPOINT), 0), 2
    frames = probes.frames_of(head_of(CHECKPOINT), recorded, step)
    head = ActionHead.from_pretrained(CHECKPOINT, dtype=torch.float64)
    for number, look in list(enumerate(recorded.observation.rows()))[:2]:
        assert look.noise is not None
        with torch.no_grad():
            vl_embs = head.encode(look.backbone_features)
            trace = head.trace(vl_embs, look.state, 0, noise=look.noise, record=("hidden",), steps=[step])
        assert look.image_mask is not None
        images = look.image_mask[0]
        assert images.sum() == 3 * 16
        expected = {
            VL: vl_embs[0][torch.from_numpy(images)].flatten(),
            ("features", -1, "mean"): look.backbone_features[0, images].mean(axis=0),
        }
        for block in range(head.config.num_layers):
            rows = trace.hidden[step, block][0]
            expected["state", block, "all"] = rows[0]
            expected["future", block, "mean"] = rows[trace.rows["future"]].mean(dim=0)
            expected["action", block, "all"] = rows[trace.rows["action"]].flatten()
        for source, values in expected.items():
            np.testing.assert_allclose(frames.inputs[source][number], values, rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(frames.targets["goal"][number], recorded.privileged.goal[number])
    assert ("state", 0, "mean") not in frames.inputs  # one token is its own mean

    linear_probes.save_frames(frames, tmp_path / "frames.npz")
    loaded = linear_probes.load_frames(tmp_path / "frames.npz")
    assert loaded.inputs.keys() == frames.inputs.keys()
    for source, values in frames.inputs.items():
        np.testing.assert_array_equal(loaded.inputs[source], values)
    both = linear_probes.join([frames, loaded], [3, 1])
    count = len(frames.episodes)
    assert both.episodes.tolist() == [0] * count + [1] * count
    assert both.tasks.tolist() == [3] * count + [1] * count
    np.testing.assert_array_equal(both.targets["hand"][count:], frames.targets["hand"])


def test_the_study_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["study", "probes", "--tasks", TASK, "--episodes", "5", "--dimensions", "8"]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert "Position of the goal:" in capsys.readouterr().out
    table = read_table(tmp_path / "probes.csv")
    provenance = read_provenance(tmp_path / "probes.json")
    assert provenance.complete
    assert table["kind"].value_counts()["episode"] == 5
    found = table[table["kind"] == "probe"]
    own = found[(found["rows"] == PROPRIO[0]) & (found["target"] == "hand")]
    assert own["r2"].item() > 0.99  # it is one of the inputs
    section = probes.Probes.summarise(table, provenance)
    assert {figure.name for figure in section.figures} == set(found["target"])
    assert len(section.grids) == 2
    unfinished = probes.Probes.summarise(table[table["kind"] == "episode"], provenance)
    assert unfinished.concluded == ["Not measured: episodes were run, no probe is done yet."]
    without = probes.Probes.summarise(table[table["rows"] != "future"], provenance)
    assert without.concluded == ["Future rows: not measured, the checkpoint has no future tokens."]

    # What was traced is kept; without it, only that is done again.
    frames = sorted(tmp_path.glob("probes/frames-*/*.npz"))
    assert len(frames) == 5
    kept = frames[0].read_bytes()
    frames[0].unlink()
    next((tmp_path / "probes" / "cells").glob("*.json")).unlink()
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert frames[0].read_bytes() == kept
    again = read_table(tmp_path / "probes.csv")
    np.testing.assert_array_equal(again[again["kind"] == "probe"]["r2"], found["r2"])


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*arguments: str) -> str:
        assert main(["study", "probes", *arguments, "--out", str(tmp_path / "out")]) == 2
        return capsys.readouterr().err

    assert "episodes: given 4, expected at least 5, one for each fold" in refused("--episodes", "4")
    assert "step: given 4, expected 0 to 3" in refused("--step", "4")
    assert "dimensions: given 0" in refused("--dimensions", "0")
    assert "unknown name 'juggle'" in refused("--tasks", "juggle")
    assert not (tmp_path / "out").exists()
