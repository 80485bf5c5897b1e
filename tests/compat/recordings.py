"""Data sets against lerobot's writer and loader: `make test-compat` runs this in each environment.

What lerobot writes is read by saccade as by lerobot itself; releases of v2.1 write that version. What saccade
writes is read by lerobot's loader, and its statistics are those that lerobot computes.
"""

# lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call, attr-defined"

from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
import torchvision
from lerobot.datasets import compute_stats, lerobot_dataset
from lerobot.datasets.lerobot_dataset import CODEBASE_VERSION, LeRobotDataset

import saccade.datasets
from tests.helpers import dataset_cases as cases

RELEASE = tuple(map(int, importlib.metadata.version("lerobot").split(".")[:2]))
FPS, SIZE = 10, (48, 64)
LENGTHS = (5, 2, 31, 12)
TASKS = ("pick the cube", "close the drawer")
AXES = ["height", "width", "channels"]
CAMERAS = {"front": "video", "wrist": "video", "top": "image"}
writes_v3 = pytest.mark.skipif(CODEBASE_VERSION != "v3.0", reason="this lerobot reads v2.1 only")


def features() -> dict[str, Any]:
    found: dict[str, Any] = {
        f"observation.images.{name}": {
            "dtype": kind,
            "shape": (*SIZE, 3),
            "names": ["height", "width", "channels"],
        }
        for name, kind in CAMERAS.items()
    }
    found["observation.state"] = {"dtype": "float32", "shape": (4,), "names": list("abcd")}
    found["action"] = {"dtype": "float32", "shape": (3,), "names": list("xyz")}
    found["reward"] = {"dtype": "float32", "shape": (2,), "names": None}
    return found


def noise(rng: np.random.Generator, *size: int | tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Pictures that a codec cannot keep as they are."""
    return rng.integers(0, 256, (*np.hstack(size), 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set that lerobot wrote; those of v3.0 in several files."""
    root = tmp_path_factory.mktemp("lerobot") / "data"
    made = LeRobotDataset.create("saccade/test", FPS, features(), root=root, use_videos=True)
    if hasattr(made.meta, "update_chunk_settings"):
        made.meta.update_chunk_settings(chunks_size=2, video_files_size_in_mb=0.05, data_files_size_in_mb=0.2)
    rng = np.random.default_rng(0)
    for number, length in enumerate(LENGTHS):
        for step in range(length):
            frame: dict[str, Any] = {f"observation.images.{name}": noise(rng, SIZE) for name in CAMERAS}
            frame["observation.state"] = rng.normal(size=4).astype(np.float32)
            frame["action"] = rng.normal(size=3).astype(np.float32)
            frame["reward"] = np.array([step, -step], np.float32)
            task = TASKS[(number + (step > 20)) % 2]  # a long episode has two
            if RELEASE < (0, 4):
                made.add_frame(frame, task=task)
            else:
                made.add_frame({**frame, "task": task})
        made.save_episode()
    if hasattr(made, "finalize"):
        made.finalize()
    return root


def loaded(root: Path, **options: Any) -> Any:
    """The data set in lerobot's loader, which decodes by PyAV."""
    return LeRobotDataset("saccade/test", root=root, video_backend="pyav", **options)


@pytest.fixture(autouse=True)
def decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Releases before 0.6 decode by torchvision's reader, which newer torchvisions have no more.

    In its place the whole video is decoded by PyAV, and the frames that are next in time are taken, as there.
    """

    def decode(path: Any, times: list[float], tolerance: float, backend: Any = None) -> torch.Tensor:
        every = cases.decoded(Path(path))
        distances = np.abs(np.array([time for time, _ in every]) - np.array(times)[:, None])
        assert (distances.min(axis=1) < tolerance).all()
        frames = np.stack([every[place][1] for place in distances.argmin(axis=1)])
        return torch.from_numpy(frames).permute(0, 3, 1, 2).float() / 255

    if RELEASE < (0, 6) and not hasattr(torchvision.io, "VideoReader"):
        monkeypatch.setattr(lerobot_dataset, "decode_video_frames", decode)


def as_uint8(frame: torch.Tensor) -> npt.NDArray[np.uint8]:
    return (frame * 255).round().byte().permute(1, 2, 0).numpy()


def check_rows(root: Path) -> None:
    """Every row and frame is that of lerobot's loader."""
    theirs, ours = loaded(root), saccade.datasets.open(root)
    assert ours.version == CODEBASE_VERSION
    assert (len(ours), ours.fps) == (theirs.meta.total_episodes, theirs.meta.fps)
    row, names = 0, [key for key in theirs.features if key not in theirs.meta.camera_keys]
    for episode in range(len(ours)):
        columns = {name: ours.column(episode, name) for name in names}
        for step in ours.episodes[episode].steps:
            item = theirs[row]
            for key in theirs.meta.camera_keys:
                found = ours.frame(episode, step, key.removeprefix("observation.images."))
                np.testing.assert_array_equal(found.pixels, as_uint8(item[key]))
            for name in names:
                np.testing.assert_array_equal(columns[name][step], np.atleast_1d(item[name].numpy()))
            assert ours.observation(episode, step, "lerobot")["task"] == [item["task"]]
            row += 1
    assert row == len(theirs)


def check_statistics(root: Path) -> None:
    """Statistics are those that lerobot reads, or combines from those of episodes."""
    theirs, ours = loaded(root).meta.stats, saccade.datasets.open(root).statistics
    for kind, column in (("state", "observation.state"), ("action", "action")):
        for found in ours[kind].values():
            assert found.keys() == theirs[column].keys() - {"count"}
    joined = {
        kind: {
            name: np.concatenate([found[name] for found in ours[kind].values()])
            for name in ("mean", "std", "min")
        }
        for kind in ("state", "action")
    }
    for kind, column in (("state", "observation.state"), ("action", "action")):
        for name, values in joined[kind].items():
            np.testing.assert_allclose(values, np.asarray(theirs[column][name]), rtol=1e-12)


def test_what_lerobot_writes_is_read_as_by_lerobot(written: Path) -> None:
    check_rows(written)
    check_statistics(written)
    for folder in ("data", "videos/observation.images.front"):
        if folder == "data" or CODEBASE_VERSION == "v3.0":
            assert len([path for path in (written / folder).rglob("*.*") if path.is_file()]) > 1


def test_chunks_at_the_end_of_an_episode(written: Path) -> None:
    deltas = {"action": [step / FPS for step in range(6)], "observation.state": [-1 / FPS, 0.0]}
    theirs, ours = (
        loaded(written, delta_timestamps=deltas),
        saccade.datasets.open(
            written,
            data_config={
                "state": {"delta_indices": [-1, 0], "modality_keys": ["state"]},
                "action": {"delta_indices": list(range(6)), "modality_keys": ["action"]},
            },
        ),
    )
    row = 0
    for episode in range(len(ours)):
        for step in ours.episodes[episode].steps:
            item = theirs[row]
            np.testing.assert_array_equal(ours.actions(episode, step)["action"], item["action"].numpy())
            np.testing.assert_array_equal(
                ours.state(episode, step)["state"], item["observation.state"].numpy()
            )
            row += 1


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A data set that saccade wrote, and what was given."""
    root = tmp_path_factory.mktemp("saccade") / "data"
    rng = np.random.default_rng(1)
    given: list[dict[str, Any]] = []
    sizes = {"front": SIZE, "wide": (30, 320)}  # lerobot samples wide frames for its statistics
    with saccade.datasets.Writer(
        root,
        fps=FPS,
        robot="so100",
        cameras=sizes,
        state={"arm": 3, "hand": 1},
        action={"arm": 3, "hand": 1},
        extra={"chunk_step": 1, "noise_seed": 3},
    ) as writer:
        for number, length in enumerate((1, 40, 130)):
            given.append(
                {
                    "frames": {
                        name: rng.integers(0, 256, (length, *size, 3), np.uint8)
                        for name, size in sizes.items()
                    },
                    "state": rng.normal(size=(length, 4)).astype(np.float32),
                    "action": rng.normal(size=(length, 4)).astype(np.float32),
                    "extra": {
                        "chunk_step": rng.integers(0, 9, (length, 1)),
                        "noise_seed": rng.integers(0, 9, (length, 3)),
                    },
                }
            )
            writer.add_episode(TASKS[number % 2], **given[-1])
    return root, given


@writes_v3
def test_lerobot_reads_what_saccade_writes(recorded: tuple[Path, list[dict[str, Any]]]) -> None:
    root, given = recorded
    check_rows(root)
    theirs, row = loaded(root), 0
    for number, episode in enumerate(given):
        for step in range(len(episode["state"])):
            item = theirs[row]
            for name, frames in episode["frames"].items():
                np.testing.assert_array_equal(as_uint8(item[f"observation.images.{name}"]), frames[step])
            np.testing.assert_array_equal(item["action"].numpy(), episode["action"][step])
            assert item["task"] == TASKS[number % 2]
            row += 1
    chosen = loaded(root, episodes=[1])
    assert len(chosen) == 40
    np.testing.assert_array_equal(chosen[3]["action"].numpy(), given[1]["action"][3])


@writes_v3
def test_statistics_are_lerobots(recorded: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> None:
    from PIL import Image

    root, given = recorded
    theirs = loaded(root)
    first, parts = 0, []
    for number, episode in enumerate(given):
        steps = np.arange(len(episode["state"]))
        data: dict[str, Any] = {
            "observation.state": episode["state"],
            "action": episode["action"],
            "chunk_step": episode["extra"]["chunk_step"][:, 0],
            "noise_seed": episode["extra"]["noise_seed"],
            "timestamp": (steps / FPS).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full(len(steps), number),
            "index": first + steps,
            "task_index": np.full(len(steps), number % 2),
        }
        for name, frames in episode["frames"].items():
            paths = [tmp_path / f"{name}-{number}-{step}.png" for step in steps]
            for path, frame in zip(paths, frames, strict=True):
                Image.fromarray(frame).save(path)
            data[f"observation.images.{name}"] = [str(path) for path in paths]
        parts.append(compute_stats.compute_episode_stats(data, theirs.features))
        first += len(steps)
    expected = parts[0]
    for part in parts[1:]:
        expected = compute_stats.aggregate_stats([expected, part])
    assert theirs.meta.stats.keys() == expected.keys()
    for key, numbers in expected.items():
        assert theirs.meta.stats[key].keys() == numbers.keys()
        for name, values in numbers.items():
            is_bytes = RELEASE < (0, 6) and key.startswith("observation.images.")
            if is_bytes and name == "std":
                continue  # releases before 0.6 square bytes, which overflow
            found, rounding = theirs.meta.stats[key][name], 1e-4 if is_bytes else 1e-6
            np.testing.assert_allclose(found, values, rtol=rounding, atol=1e-9, err_msg=f"{key} {name}")


def test_other_data_sets_are_read_as_by_lerobot(tmp_path: Path) -> None:
    """Those of the main suite, which neither program wrote."""
    write = cases.write_old if CODEBASE_VERSION == "v2.1" else cases.write_new
    root = write(tmp_path / "data", modality=None)
    ours, theirs, row = saccade.datasets.open(root), loaded(root), 0
    for episode in range(len(ours)):
        for step in ours.episodes[episode].steps:
            for name in ours.cameras:
                found = ours.frame(episode, step, name).pixels
                np.testing.assert_array_equal(found, as_uint8(theirs[row][f"observation.images.{name}"]))
            row += 1
