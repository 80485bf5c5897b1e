"""Demonstrations and training on tiny settings: resumable, and the same as if never stopped."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from saccade import CheckpointError, InputError
from saccade.sim import demos, train
from saccade.sim.cameras import DEFAULT_CAMERAS
from saccade.sim.dataset import chunks, load_samples
from saccade.sim.policy import DEMO_CHECKPOINT, Policy
from saccade.sim.tasks import DEMONSTRATION_SEEDS

RECORDING = demos.RecordingSettings(image_size=16, frame_stride=6, cameras=DEFAULT_CAMERAS[:2])
TINY = train.TrainingSettings(
    steps=6,
    batch_size=2,
    width=16,
    num_layers=2,
    num_heads=2,
    backbone_layers=1,
    num_future_tokens=3,
    patch_size=8,
)
TASKS = ["reach", "button-press-topdown"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations of two tasks."""
    out = tmp_path_factory.mktemp("demos")
    for task in TASKS:
        demos.record_task(task, 2, out, RECORDING, lambda: None)
    return out


def ignore(progress: train.Progress) -> None:
    """Shows no progress."""


def test_recording_holds_what_it_says(recording: Path) -> None:
    for task in TASKS:
        found = list(demos.episodes(recording, task))
        assert [seed for seed, _ in found] == sorted(seed for seed, _ in found)
        for seed, demonstration in found:
            assert seed in DEMONSTRATION_SEEDS
            frames, steps = len(demonstration.images), len(demonstration.actions)
            assert demonstration.images.shape == (frames, 2, 16, 16, 3)
            assert demonstration.images.dtype == np.uint8
            assert demonstration.proprio.shape == (frames, 4)
            assert demonstration.targets.shape == (frames, 6)
            assert demonstration.disturbed.shape == (steps,)
            assert np.abs(demonstration.actions).max() <= 1.0
            np.testing.assert_array_equal(demonstration.frame_steps, np.arange(0, steps, 6))


def test_recording_goes_on_where_it_stopped(recording: Path, tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    def stop() -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        demos.record_task("reach", 2, tmp_path, RECORDING, stop)
    first = sorted((tmp_path / "reach").glob("*.npz"))
    written = first[0].stat().st_mtime_ns
    assert len(first) == 1
    episodes = []
    demos.record_task("reach", 2, tmp_path, RECORDING, lambda: episodes.append(1))
    assert len(episodes) == 2
    assert first[0].stat().st_mtime_ns == written
    both = zip(demos.episodes(recording, "reach"), demos.episodes(tmp_path, "reach"), strict=True)
    for (seed, whole), (other_seed, resumed) in both:
        assert seed == other_seed
        np.testing.assert_array_equal(whole.images, resumed.images)
        np.testing.assert_array_equal(whole.actions, resumed.actions)
    assert not list(tmp_path.rglob(".*"))


def test_recording_with_other_settings_is_refused(recording: Path) -> None:
    other = demos.RecordingSettings(image_size=24, cameras=RECORDING.cameras)
    with pytest.raises(InputError, match="other settings"):
        demos.record_task("reach", 3, recording, other, lambda: None)


def test_chunks_stop_counting_after_a_disturbance_and_at_the_end() -> None:
    steps = 8
    disturbed = np.zeros(steps, dtype=np.bool_)
    disturbed[3] = True
    demonstration = demos.Demonstration(
        images=np.zeros((3, 1, 8, 8, 3), np.uint8),
        proprio=np.zeros((3, 4), np.float32),
        targets=np.zeros((3, 6), np.float32),
        frame_steps=np.array([0, 3, 6], np.int32),
        actions=np.arange(1, 4 * steps + 1, dtype=np.float32).reshape(steps, 4),
        disturbed=disturbed,
    )
    actions, mask = chunks(demonstration, 5)
    assert mask[..., 0].astype(int).tolist() == [[1, 1, 1, 1, 0], [1, 0, 0, 0, 0], [1, 1, 0, 0, 0]]
    np.testing.assert_array_equal(actions[0, :4], demonstration.actions[:4])
    np.testing.assert_array_equal(actions * (1 - mask), 0.0)


def test_held_out_samples_come_from_demonstrations_of_their_own(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("saccade.sim.dataset.VALIDATION_EVERY", 2)
    training, held_out = load_samples(recording, TASKS, 4)
    seeds = [demonstration.proprio[0] for _, demonstration in demos.episodes(recording, "reach")]
    assert len(seeds) == 2
    assert set(map(tuple, training.targets)).isdisjoint(map(tuple, held_out.targets))
    assert set(training.tasks) == set(held_out.tasks)


def test_training_resumes_to_the_same_weights(recording: Path, tmp_path: Path) -> None:
    def interrupt(progress: train.Progress) -> None:
        if progress.step == 3:
            raise KeyboardInterrupt

    torch.set_num_threads(1)
    train.train(recording, tmp_path / "whole", TINY, ignore)
    with pytest.raises(KeyboardInterrupt):
        train.train(recording, tmp_path / "parts", TINY, interrupt)
    stopped = load_file(tmp_path / "parts" / "model.safetensors")
    train.train(recording, tmp_path / "parts", TINY, ignore)
    whole, parts = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    for name, tensor in whole.items():
        assert tensor.dtype == torch.bfloat16
        assert torch.equal(tensor, parts[name]), name
    assert any(not torch.equal(stopped[name], whole[name]) for name in whole)


def test_training_leaves_a_policy_both_engines_run(recording: Path, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    train.train(recording, tmp_path, TINY, ignore)
    assert {path.name for path in tmp_path.iterdir()} == {
        "config.json",
        "model.safetensors",
        "training.pt",
        "history.json",
        "loss.png",
    }
    history = json.loads((tmp_path / "history.json").read_text())
    assert history[-1]["step"] == TINY.steps
    rust, other = (Policy.load(tmp_path, engine=engine, num_threads=1) for engine in ("rust", "torch"))
    assert rust.config.tasks == tuple(TASKS)
    images = {
        camera.name: np.full((16, 16, 3), 30 * number, np.uint8)
        for number, camera in enumerate(RECORDING.cameras)
    }
    observation = {"images": images, "proprio": np.zeros(4), "instruction": "press the button"}
    noise = rust.noise(np.random.default_rng(0))
    np.testing.assert_allclose(
        rust.act(observation, noise=noise).actions, other.act(observation, noise=noise).actions, atol=1e-4
    )


def test_a_run_with_other_settings_is_refused(recording: Path, tmp_path: Path) -> None:
    train.train(recording, tmp_path, TINY, ignore)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    other = train.TrainingSettings(**{**vars(TINY), "seed": 1, "batch_size": 3})
    with pytest.raises(InputError, match=r"other settings \(batch_size, seed\)"):
        train.train(recording, tmp_path, other, ignore)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_settings_that_do_not_fit_the_pictures_are_refused(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="image_size 16 is not a multiple of patch_size 32"):
        train.train(recording, tmp_path, train.TrainingSettings(patch_size=32), ignore)
    assert not list(tmp_path.iterdir())


def test_learning_rate_warms_up_and_falls_to_zero() -> None:
    settings = train.TrainingSettings(steps=1000)
    rates = [train.learning_rate(settings, step) for step in range(1000)]
    assert rates[0] < 0.01 * settings.learning_rate
    assert max(rates) <= settings.learning_rate
    assert np.argmax(rates) == train.WARMUP_STEPS - 1
    assert rates[-1] < 1e-4 * settings.learning_rate


def test_training_starts_from_a_policy(recording: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    train.train(recording, first, TINY, ignore)
    settings = train.TrainingSettings(
        **{**vars(TINY), "steps": 2, "learning_rate": 1e-9, "absent_share": 0.5}
    )
    train.train(recording, second, settings, ignore, start=first)
    tensors = load_file(second / "model.safetensors")
    for name, tensor in load_file(first / "model.safetensors").items():
        torch.testing.assert_close(tensors[name], tensor)
    with pytest.raises(InputError, match=r"other settings \(start_sha256\)"):
        train.train(recording, second, settings, ignore)


def test_a_policy_of_other_sizes_cannot_be_started_from(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="other sizes or other demonstrations"):
        train.train(recording, tmp_path / "out", TINY, ignore, start=DEMO_CHECKPOINT)
    with pytest.raises(FileNotFoundError):
        train.train(recording, tmp_path / "out", TINY, ignore, start=tmp_path / "nowhere")
    assert not (tmp_path / "out").exists()
