"""Writing data sets: they come back as they were given, or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import saccade.datasets
from saccade.datasets import encoding, writing
from tests.helpers import dataset_cases as cases

SIZES: dict[str, Any] = {
    "fps": 25,
    "robot": "so100",
    "cameras": {"front": (48, 64), "wrist": (35, 27)},
    "state": {"arm": 3, "hand": 1},
    "action": {"arm": 3, "hand": 1},
}
LENGTHS = (9, 1, 30)


def episode(number: int) -> dict[str, Any]:
    """What is given for an episode: frames of noise, which no lossy codec gives back."""
    rng, length = np.random.default_rng(number), LENGTHS[number]
    return {
        "task": cases.TASKS[number % 2],
        "frames": {
            name: rng.integers(0, 256, (length, *size, 3), np.uint8)
            for name, size in SIZES["cameras"].items()
        },
        "state": rng.normal(size=(length, 4)).astype(np.float32),
        "action": rng.normal(size=(length, 4)).astype(np.float32),
        "extra": {"noise_seed": rng.integers(0, 9, (length, 3))},
    }


def write(folder: Path) -> None:
    with saccade.datasets.Writer(folder, **SIZES, extra={"noise_seed": 3}) as writer:
        for number in range(3):
            writer.add_episode(**episode(number))


def check(folder: Path) -> None:
    """Everything is as it was given."""
    data = saccade.datasets.open(folder)
    assert [one.length for one in data.episodes] == list(LENGTHS)
    assert (data.fps, data.robot, data.version, data.tasks) == (25, "so100", "v3.0", cases.TASKS)
    for number in (2, 0, 1):
        given = episode(number)
        for step in range(LENGTHS[number]):
            for name in SIZES["cameras"]:
                found = data.frame(number, step, name)
                np.testing.assert_array_equal(found.pixels, given["frames"][name][step])
                assert found.timestamp == pytest.approx(step / 25, abs=1e-6)
            assert data.instruction(number, step) == given["task"]
        np.testing.assert_array_equal(data.column(number, "observation.state"), given["state"])
        np.testing.assert_array_equal(data.column(number, "action"), given["action"])
        np.testing.assert_array_equal(data.column(number, "noise_seed"), given["extra"]["noise_seed"])
    assert data.language_key == "annotation.human.action.task_description"


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    write(tmp_path / "data")
    check(tmp_path / "data")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_every_episode_begins_with_a_keyframe(tmp_path: Path) -> None:
    write(tmp_path)
    data = saccade.datasets.open(tmp_path)
    for part in zip(*(one.videos.values() for one in data.episodes), strict=True):
        with av.open(str(tmp_path / part[0].file)) as container:
            packets: list[Any] = [packet for packet in container.demux(video=0) if packet.pts is not None]
        keyframes = {float(packet.pts * packet.time_base) for packet in packets if packet.is_keyframe}
        assert {one.start for one in part} <= keyframes
        assert [packet.pts for packet in packets] == [packet.dts for packet in packets]


def test_files_that_are_full_are_followed_by_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "DATA_MB", 0)
    monkeypatch.setattr(writing, "VIDEO_MB", 0)
    monkeypatch.setattr(writing, "CHUNK", 2)
    write(tmp_path)
    check(tmp_path)
    for folder in ("data", "videos/observation.images.wrist"):
        found = sorted(
            path.relative_to(tmp_path / folder).with_suffix("") for path in (tmp_path / folder).rglob("*.*")
        )
        assert list(map(str, found)) == ["chunk-000/file-000", "chunk-000/file-001", "chunk-001/file-000"]


def test_statistics_are_numpys(tmp_path: Path) -> None:
    write(tmp_path)
    data = saccade.datasets.open(tmp_path)
    actions = np.concatenate([episode(number)["action"] for number in range(3)]).astype(np.float64)
    found = data.statistics["action"]
    for key, columns in (("arm", slice(0, 3)), ("hand", slice(3, 4))):
        for name in ("mean", "std", "min", "max"):
            expected = getattr(np, name)(actions, axis=0)[columns]
            np.testing.assert_allclose(found[key][name], expected, rtol=1e-5, atol=1e-6)
    recorded = json.loads((tmp_path / "meta" / "stats.json").read_text())
    frames = np.concatenate([episode(number)["frames"]["front"] for number in range(3)]) / 255
    mean = np.array(recorded["observation.images.front"]["mean"])
    np.testing.assert_allclose(mean[:, 0, 0], frames.mean(axis=(0, 1, 2)), rtol=1e-5)
    assert recorded["action"]["count"] == [40]


def test_an_interrupted_recording_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> None:
        with saccade.datasets.Writer(tmp_path / "data", **SIZES, extra={"noise_seed": 3}) as writer:
            writer.add_episode(**episode(0))
            raise KeyboardInterrupt

    def empty() -> None:
        with saccade.datasets.Writer(tmp_path / "data", **SIZES):
            pass

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(saccade.InputError, match="at least one episode"):
        empty()
    assert list(tmp_path.iterdir()) == []


def test_an_episode_that_failed_is_not_followed_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its steps may be written and its frames not: what comes after it would stand at wrong places."""

    def kept() -> None:
        with saccade.datasets.Writer(tmp_path / "data", **SIZES, extra={"noise_seed": 3}) as writer:
            writer.add_episode(**episode(0))
            with monkeypatch.context() as broken:
                broken.setattr("saccade.datasets.encoding.VideoFile.append", None)
                with pytest.raises(TypeError):
                    writer.add_episode(**episode(1))
            with pytest.raises(saccade.InputError, match="before an episode failed"):
                writer.add_episode(**episode(1))

    with pytest.raises(saccade.InputError, match="an episode could not be written, nothing is kept"):
        kept()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("seed", [(0, 1, 10**15), (0, -1, 0), (0, 1, -1), (0, 1, 3)])
def test_a_noise_that_cannot_be_is_refused(seed: tuple[int, ...], tmp_path: Path) -> None:
    """The number of a chunk is at most that of its step; a larger one would be drawn for ever."""
    extra = {"noise_seed": np.tile(seed, (9, 1)), "chunk_step": np.zeros((9, 1), np.int64)}
    sizes = {**SIZES, "extra": {"noise_seed": 3, "chunk_step": 1}}
    with saccade.datasets.Writer(tmp_path / "data", **sizes) as writer:
        writer.add_episode(**{**episode(0), "extra": extra})
    data = saccade.datasets.open(tmp_path / "data")
    with pytest.raises(saccade.DatasetError, match="episode 0, step 2: noise_seed: expected two seeds"):
        data.noise(0, 2, (1, 4, 2))


def test_a_writer_writes_in_its_block_only(tmp_path: Path) -> None:
    writer = saccade.datasets.Writer(tmp_path / "data", **SIZES, extra={"noise_seed": 3})
    with pytest.raises(saccade.InputError, match="expected a call in the with block"):
        writer.add_episode(**episode(0))
    with writer:
        writer.add_episode(**episode(0))
    with pytest.raises(saccade.InputError, match="expected a call in the with block"):
        writer.add_episode(**episode(0))
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_folders_with_something_in_them_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(saccade.InputError, match="path: expected a new or empty folder"):
        saccade.datasets.Writer(tmp_path, **SIZES)
    with pytest.raises(saccade.InputError, match="path: expected a new or empty folder"):
        saccade.datasets.Writer(tmp_path / "note.txt", **SIZES)
    assert (tmp_path / "note.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": {"../front": (8, 8)}}, "cameras: expected names of letters"),
        ({"cameras": {"": (8, 8)}}, "cameras: expected names of letters"),
        ({"cameras": {"front": (0, 8)}}, "cameras: front: expected at least 1, got 0"),
        ({"state": {"arm": 0}}, "state: arm: expected at least 1, got 0"),
        ({"action": {"a b": 1}}, "action: expected names of letters"),
        ({"extra": {"timestamp": 1}}, "extra: expected names of letters"),
        ({"fps": 29.97}, "fps: expected an integer, got 29.97"),
    ],
)
def test_data_sets_of_another_form(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(saccade.InputError, match=message):
        saccade.datasets.Writer(tmp_path / "data", **{**SIZES, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"task": None}, "task: expected an instruction"),
        ({"frames": {}}, "frames: expected front, wrist, got "),
        ({"extra": {}}, "extra: expected"),
        (
            {"state": np.zeros((9, 5), np.float32)},
            r"observation.state: expected shape \(9, 4\), got \(9, 5\)",
        ),
        ({"action": np.zeros((8, 4), np.float32)}, r"action: expected shape \(9, 4\), got \(8, 4\)"),
        ({"action": np.full((9, 4), np.nan)}, "action: expected finite numbers"),
        ({"state": np.zeros((0, 4))}, "at least one step"),
        ({"state": np.zeros(9)}, r"expected numbers of shape \(steps, width\)"),
        ({"state": [["a"]]}, "expected numbers of shape"),
    ],
)
def test_episodes_of_another_form(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    def changed() -> None:
        with saccade.datasets.Writer(tmp_path / "data", **SIZES, extra={"noise_seed": 3}) as writer:
            writer.add_episode(**{**episode(0), **change})

    with pytest.raises(saccade.SaccadeError, match=message):
        changed()
    assert list(tmp_path.iterdir()) == []


def test_frames_of_another_size_or_type(tmp_path: Path) -> None:
    given = episode(0)
    with saccade.datasets.Writer(tmp_path, **SIZES, extra={"noise_seed": 3}) as writer:
        for wrong in (given["frames"]["front"][:, 1:], given["frames"]["front"].astype(np.float32), None):
            with pytest.raises(saccade.ShapeError, match="frames: front: expected uint8"):
                writer.add_episode(**{**given, "frames": {**given["frames"], "front": wrong}})
        writer.add_episode(**given)
    assert len(saccade.datasets.open(tmp_path)) == 1


def test_the_codec_is_lossless() -> None:
    assert encoding.OPTIONS["qp"] == "0"
