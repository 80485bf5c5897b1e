"""Demonstrations: recorded, resumed, and read as samples."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from saccade import InputError
from saccade.processor import Processor
from saccade_lab.sim import demos
from saccade_lab.sim.tasks import DEMONSTRATION_SEEDS
from saccade_lab.training import train
from saccade_lab.training.dataset import chunks, describe, later_frames, load_samples
from saccade_lab.training.frames import prepared
from saccade_lab.training.settings import TrainingSettings
from tests.helpers.training_cases import RECORDING, TASKS, TINY, recorded


@pytest.fixture
def recording() -> Path:
    """Two demonstrations of two tasks."""
    return recorded()


def processor_of(settings: TrainingSettings) -> Processor:
    """The processor of the policy that a run trains."""
    return train.policy_config(settings, RECORDING, TASKS).processor()


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

    def stop(task: str) -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        demos.record_tasks({"reach": 2}, tmp_path, RECORDING, stop)
    first = sorted((tmp_path / "reach").glob("*.npz"))
    written = first[0].stat().st_mtime_ns
    assert len(first) == 1
    episodes: list[str] = []
    demos.record_tasks({"reach": 2}, tmp_path, RECORDING, episodes.append)
    assert episodes == ["reach", "reach"]
    assert first[0].stat().st_mtime_ns == written
    both = zip(demos.episodes(recording, "reach"), demos.episodes(tmp_path, "reach"), strict=True)
    for (seed, whole), (other_seed, resumed) in both:
        assert seed == other_seed
        np.testing.assert_array_equal(whole.images, resumed.images)
        np.testing.assert_array_equal(whole.actions, resumed.actions)
    assert not list(tmp_path.rglob(".*"))


def test_what_was_recorded_earlier_counts_for_the_expert(tmp_path: Path) -> None:
    """Only seeds at which the expert failed are tried again: they alone would look as if it always failed."""
    first = DEMONSTRATION_SEEDS[0]
    for seed in range(first, first + 60, 2):
        (tmp_path / f"{seed}.npz").touch()
    seeds = demos.Seeds("push", 60, tmp_path)
    missing = seeds.next_seeds(lambda: None)
    assert missing[:30] == list(range(first + 1, first + 60, 2))
    assert (seeds.done, len(missing)) == (30, 30)
    for seed in missing[:30]:
        seeds.outcomes[seed] = False
        seeds.check()
    alone = demos.Seeds("push", 60, tmp_path / "empty")
    for seed in alone.next_seeds(lambda: None)[:20]:
        alone.outcomes[seed] = False
    with pytest.raises(InputError, match="the expert failed in 20 of 20 episodes"):
        alone.check()


def test_recording_with_other_settings_is_refused(recording: Path) -> None:
    other = demos.RecordingSettings(image_size=24, cameras=RECORDING.cameras)
    with pytest.raises(
        InputError, match=r"reach: has results with other settings \(image_size, frame_stride changed\)"
    ):
        demos.record_tasks({"reach": 3}, recording, other, lambda task: None)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda text: text[:-9], "cannot be read as JSON"),
        (lambda text: "[]", "expected a JSON object, got list"),
        (lambda text: "{}", "settings of an unknown form"),
    ],
)
def test_damaged_settings_are_named(
    damage: Callable[[str], str], problem: str, recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "recording"
    shutil.copytree(recording, out)
    for task in TASKS:
        path = out / task / "recording.json"
        path.write_text(damage(path.read_text()))
    first = out / TASKS[0] / "recording.json"
    with pytest.raises(InputError, match=rf"^{re.escape(str(first))}: {problem}.*\Z"):
        demos.read_settings(out, TASKS)
    with pytest.raises(InputError, match=re.escape(str(first.parent))):
        demos.record_tasks({TASKS[0]: 2}, out, RECORDING, lambda task: None)


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
    monkeypatch.setattr("saccade_lab.training.dataset.VALIDATION_EVERY", 2)
    training, held_out = load_samples(recording, TASKS, 4, processor_of(TINY))
    seeds = [demonstration.proprio[0] for _, demonstration in demos.episodes(recording, "reach")]
    assert len(seeds) == 2
    assert set(map(tuple, training.targets)).isdisjoint(map(tuple, held_out.targets))
    assert set(training.tasks) == set(held_out.tasks)


def test_frames_are_prepared_as_the_policy_prepares_them() -> None:
    """At 68 pixels the crop is all that is done; against a slice of the frame."""
    config = train.policy_config(TINY, dataclasses.replace(RECORDING, image_size=68), TASKS)
    images = np.random.default_rng(0).integers(256, size=(2, 3, 68, 68, 3), dtype=np.uint8)
    found = prepared(images, config.processor())
    expected = images[:, :, 2:66, 2:66].transpose(0, 1, 4, 2, 3)
    assert found.dtype == np.uint8
    # Isaac-GR00T truncates after it has divided and multiplied by 255.
    assert np.abs(found.astype(int) - expected.astype(int)).max() <= 1
    processed = config.processor()(list(images[0]), "reach the green ball").pixel_values
    np.testing.assert_array_equal((found[0].astype(np.float32) - 127.5) / 127.5, processed)


def test_later_frames_are_the_next_ones_recorded_a_horizon_on() -> None:
    steps = np.array([0, 3, 6, 9, 12, 15], np.int32)
    demonstration = demos.Demonstration(
        images=np.zeros((len(steps), 1, 8, 8, 3), np.uint8),
        proprio=np.zeros((len(steps), 4), np.float32),
        targets=np.zeros((len(steps), 6), np.float32),
        frame_steps=steps,
        actions=np.zeros((17, 4), np.float32),
        disturbed=np.zeros(17, np.bool_),
    )
    assert later_frames(demonstration, 6).tolist() == [2, 3, 4, 5, 5, 5]  # exactly there, then the last one
    assert later_frames(demonstration, 7).tolist() == [3, 4, 5, 5, 5, 5]  # the first one after
    assert later_frames(demonstration, 40).tolist() == [5, 5, 5, 5, 5, 5]


def test_samples_point_at_their_own_demonstrations_pictures(recording: Path) -> None:
    horizon = 16
    processor = processor_of(TINY)
    samples, _ = load_samples(recording, TASKS, horizon, processor)
    row, first = 0, 0
    for task in TASKS:
        for _, demonstration in demos.episodes(recording, task):
            valid = chunks(demonstration, horizon)[1].sum(axis=(1, 2))
            images = prepared(demonstration.images, processor)
            for frame, step in enumerate(demonstration.frame_steps):
                if valid[frame] < 4:
                    continue  # no sample, but its picture is kept: it may be what another one leads to
                np.testing.assert_array_equal(samples.images[samples.now[row]], images[frame])
                after = [n for n, other in enumerate(demonstration.frame_steps) if other >= step + horizon]
                expected = after[0] if after else len(demonstration.images) - 1
                assert samples.later[row] == first + expected
                np.testing.assert_array_equal(samples.images[samples.later[row]], images[expected])
                row += 1
            first += len(demonstration.images)
    assert row == len(samples)
    assert first == len(samples.images)


def test_description_tells_recordings_apart(recording: Path, tmp_path: Path) -> None:
    whole = describe(recording, TASKS)
    assert whole["tasks"] == dict.fromkeys(TASKS, 2)
    shutil.copytree(recording, tmp_path / "copy")
    assert describe(tmp_path / "copy", TASKS) == whole
    next((tmp_path / "copy" / "reach").glob("*.npz")).unlink()
    fewer = describe(tmp_path / "copy", TASKS)
    assert fewer["tasks"] == {"reach": 1, "button-press-topdown": 2}
    assert fewer["sha256"] != whole["sha256"]
