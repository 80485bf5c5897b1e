"""Recorded rollouts and demonstrations: the policy computes again, from what is read, what it did."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import saccade.datasets
from saccade.cli import main
from saccade_lab.sim.demos import load
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import environment_for, run_episode


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rollout of the bundled policy."""
    folder = tmp_path_factory.mktemp("recorded")
    arguments = ["--tasks", "reach", "--episodes", "1", "--seed", "3", "--out", str(folder / "out")]
    assert main(["rollout", *arguments, "--record", str(folder / "data"), "--json"]) == 0
    return folder / "data"


def test_every_chunk_is_computed_again_bit_for_bit(recorded: Path) -> None:
    data = saccade.datasets.open(recorded)
    policy = saccade.Policy.from_pretrained(saccade.demo_checkpoint())
    config = policy.head.config
    shape = (1, config.action_horizon, config.encoder_action_dim)
    assert data.fps == 80
    for episode in range(len(data)):
        places = data.column(episode, "chunk_step")[:, 0]
        starts = [
            step for step in data.episodes[episode].steps if data.noise(episode, step, shape) is not None
        ]
        assert starts == np.flatnonzero(places == 0).tolist()
        assert starts[0] == 0
        assert len(starts) > 3
        for start, end in zip(starts, [*starts[1:], len(places)], strict=True):
            noise = data.noise(episode, start, shape)
            found = policy.act(data.observation(episode, start), noise=noise)
            for key, actions in data.actions(episode, start, end - start).items():
                np.testing.assert_array_equal(found[key][0, : end - start], actions)
        seed = data.column(episode, "noise_seed")[0, :2].tolist()
        found = policy.act(data.observation(episode, 0, "isaac flat"), seed=seed)
        for key, actions in data.actions(episode, 0, starts[1]).items():
            np.testing.assert_array_equal(found[f"action.{key}"][0, : starts[1]], actions)


def test_a_recording_changes_nothing_of_the_episode(recorded: Path) -> None:
    data = saccade.datasets.open(recorded)
    policy = Policy.from_pretrained()
    environment = environment_for(policy, "reach")
    try:
        plain = run_episode(environment, policy, 3)
        assert (plain.steps, plain.success) == (data.episodes[0].length, True)
        assert plain.instruction == data.instruction(0, 0)
    finally:
        environment.close()


def test_demonstrations(tmp_path: Path) -> None:
    arguments = ["demos", "--tasks", "reach", "--episodes", "1"]
    assert main([*arguments, "--record", str(tmp_path / "data"), "--out", str(tmp_path / "npz")]) == 0
    data = saccade.datasets.open(tmp_path / "data")
    files = sorted((tmp_path / "npz" / "reach").glob("*.npz"), key=lambda path: int(path.stem))
    assert len(data) == len(files) == 1
    for episode, file in enumerate(files):
        one = load(file)
        assert data.episodes[episode].length == len(one.actions)
        np.testing.assert_array_equal(data.column(episode, "action"), one.actions)
        np.testing.assert_array_equal(data.column(episode, "observation.state"), one.proprio)
        assert one.disturbed.any()
        np.testing.assert_array_equal(data.column(episode, "disturbed")[:, 0], one.disturbed)
        for step in (0, len(one.actions) - 1):
            for place, camera in enumerate(data.cameras):
                np.testing.assert_array_equal(
                    data.frame(episode, step, camera).pixels, one.images[step, place]
                )
        assert data.noise(episode, 0, (1, 16, 4)) is None


def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "note").touch()
    assert main(["rollout", "--record", str(tmp_path)]) != 0
    assert "--record: expected a new or empty folder" in capsys.readouterr().err
    assert main(["demos", "--record", str(tmp_path)]) != 0
    assert "--record: expected a new or empty folder" in capsys.readouterr().err
    for given, message in (
        (["demos"], "expected --out or --record"),
        (["demos", "--record", str(tmp_path / "new"), "--frame-stride", "3"], "--frame-stride: expected 1"),
    ):
        assert main(given) != 0
        assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["note"]
