"""Damaged data sets: an error that names the file, and episode and step where they are known."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import saccade.datasets
from tests.helpers import dataset_cases as cases
from tests.helpers.dataset_damage import (
    OLD_STEPS,
    OLD_VIDEO,
    STEPS,
    VIDEO,
    Change,
    cut,
    damaged_video,
    dangling,
    edited,
    lines,
    pipe,
    png,
    put,
    rewritten,
    shifted_video,
    shorter_video,
    small_video,
)
from tests.helpers.lfs_pointer import POINTER


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    cases.write_old(folder / "v2.1")
    cases.write_new(folder / "v3.0")
    cases.write_new(folder / "images", "image")
    return folder


def key(values: Any, *path: str) -> Any:
    for name in path[:-1]:
        values = values[name]
    return values


def setting(*path: Any) -> Callable[[Any], None]:
    """Sets the value at a path of keys; the last one given is the value."""

    def change(values: Any) -> None:
        *names, last, value = path
        for name in names:
            values = values[name]
        values[last] = value

    return change


#: The layout, what happens to it, and what the message of opening it says.
OPENING: list[tuple[str, Change, str]] = [
    ("v2.1", lambda root: (root / OLD_STEPS).unlink(), f"{OLD_STEPS}: no such file; episode 2 is in it"),
    ("v2.1", lambda root: (root / OLD_VIDEO).unlink(), f"{OLD_VIDEO}: no such file; episode 2 is in it"),
    ("v3.0", lambda root: (root / STEPS).unlink(), f"{STEPS}: no such file; episode 0 is in it"),
    ("v3.0", lambda root: (root / VIDEO).unlink(), f"{VIDEO}: no such file; episode 0 is in it"),
    ("v2.1", lambda root: (root / "meta/info.json").unlink(), "info.json: no such file"),
    ("v2.1", lambda root: (root / "meta/tasks.jsonl").unlink(), "tasks.jsonl: no such file"),
    ("v2.1", lambda root: (root / "meta/episodes.jsonl").unlink(), "episodes.jsonl: no such file"),
    ("v3.0", lambda root: (root / "meta/tasks.parquet").unlink(), "tasks.parquet: no such file"),
    ("v3.0", lambda root: shutil.rmtree(root / "meta/episodes"), "episodes: no such folder"),
    ("v2.1", cut("meta/info.json", 0.5), "info.json: cannot be read as JSON"),
    (
        "v2.1",
        cut("meta/episodes.jsonl", 0.5),
        "episodes.jsonl: cannot be read as JSON lines|info.json counts 3",
    ),
    ("v3.0", cut("meta/tasks.parquet", 0.5), "tasks.parquet: cannot be read as Parquet"),
    (
        "v3.0",
        cut("meta/episodes/chunk-000/file-000.parquet", 0.5),
        "file-000.parquet: cannot be read as Parquet",
    ),
    ("v2.1", cut("meta/modality.json", 0.5), "modality.json: cannot be read as JSON"),
    ("v2.1", pipe("meta/modality.json"), "modality.json: cannot be read as JSON: not a regular file"),
    (
        "v2.1",
        lambda root: (root / "meta/modality.json").write_text(POINTER),
        "modality.json: cannot be read as JSON: it is a Git LFS pointer",
    ),
    (
        "v2.1",
        edited("meta/modality.json", lambda values: []),
        "modality.json: expected a JSON object, got list",
    ),
    (
        "v2.1",
        edited("meta/info.json", setting("codebase_version", "v1.6")),
        "codebase_version: expected v2.0, v2.1",
    ),
    (
        "v2.1",
        edited("meta/info.json", setting("codebase_version", "v4.0")),
        "codebase_version: expected v2.0, v2.1",
    ),
    ("v2.1", edited("meta/info.json", setting("fps", 0)), "fps: expected a positive number, got 0"),
    ("v2.1", edited("meta/info.json", setting("fps", None)), "fps: expected a positive number"),
    (
        "v2.1",
        edited("meta/info.json", setting("chunks_size", 0)),
        "chunks_size: expected an integer, at least 1",
    ),
    ("v2.1", edited("meta/info.json", setting("total_episodes", 4)), "info.json counts 4 episodes, got 3"),
    ("v3.0", edited("meta/info.json", setting("total_frames", 7)), "total_frames: expected"),
    (
        "v2.1",
        lines("meta/tasks.jsonl", lambda rows: rows[:1]),
        "total_tasks: expected 1, those of its list of tasks, got 2",
    ),
    ("v3.0", edited("meta/info.json", setting("total_tasks", 3)), "total_tasks: expected 2, .*, got 3"),
    (
        "v2.1",
        lines("meta/episodes_stats.jsonl", lambda rows: rows[:2]),
        "expected the statistics of every episode, got none of 2",
    ),
    (
        "v2.1",
        lines("meta/episodes_stats.jsonl", lambda rows: [*rows, rows[1]]),
        "episode 1 is listed twice",
    ),
    (
        "v2.1",
        lines("meta/episodes_stats.jsonl", lambda rows: [*rows, {**rows[0], "episode_index": 3}]),
        "episode 3 has statistics and is not in episodes.jsonl",
    ),
    ("v2.1", edited("meta/info.json", setting("features", [])), "features: expected an object, got list"),
    (
        "v2.1",
        edited("meta/info.json", setting("features", "action", 4)),
        "features: action: expected dtype and shape",
    ),
    (
        "v2.1",
        edited("meta/info.json", setting("features", "action", "shape", [-1])),
        "action: expected dtype and shape",
    ),
    (
        "v2.1",
        edited("meta/info.json", setting("data_path", "../{episode_index}")),
        "data_path: expected a path in the",
    ),
    (
        "v2.1",
        edited("meta/info.json", setting("data_path", "/etc/passwd")),
        "data_path: expected a path in the",
    ),
    (
        "v2.1",
        edited("meta/info.json", setting("data_path", "{episode_index.real}")),
        "data_path: expected a path",
    ),
    ("v2.1", edited("meta/info.json", setting("data_path", "{chunk}")), "data_path: chunk: expected one of"),
    (
        "v2.1",
        edited("meta/info.json", setting("video_path", None)),
        "video_path: expected a template of paths",
    ),
    (
        "v2.1",
        edited("meta/modality.json", setting("state", "arm", "end", 9)),
        "modality.json: state.arm: expected start and end in the 4 numbers of observation.state, got 0 and 9",
    ),
    (
        "v3.0",
        edited("meta/modality.json", setting("action", "arm", "original_key", "joints")),
        "modality.json: action.arm: expected a column of info.json, got 'joints'",
    ),
    (
        "v2.1",
        edited("meta/modality.json", setting("state", "arm", "original_key", None)),
        "state.arm: expected a column of info.json, got None",
    ),
    (
        "v2.1",
        edited("meta/modality.json", setting("action", "arm", "absolute", "yes")),
        "action.arm: absolute: expected true or false",
    ),
    (
        "v2.1",
        edited("meta/modality.json", setting("video", "front", "original_key", "observation.images.top")),
        "video.front: expected one camera of info.json, got observation.images.top",
    ),
    (
        "v2.1",
        edited("meta/modality.json", setting("video", "top", {})),
        "video.top: expected one camera of info.json",
    ),
    (
        "v2.1",
        edited("meta/modality.json", setting("state", None)),
        "modality.json: state: expected an object of keys",
    ),
    (
        "v3.0",
        rewritten("meta/tasks.parquet", "__index_level_0__", lambda texts: None),
        "tasks.parquet: expected the columns task and task_index",
    ),
    (
        "v3.0",
        rewritten("meta/tasks.parquet", "task_index", lambda places: [0, 0]),
        "tasks.parquet: expected each task_index once, got 0 for 'pick the cube' and 'close the drawer'",
    ),
    ("v2.1", dangling("meta/modality.json"), "modality.json: no such file"),
    ("v3.0", dangling("meta/stats.json"), "stats.json: no such file"),
    (
        "v3.0",
        rewritten("meta/episodes/chunk-000/file-000.parquet", "length", put(1, 2)),
        "episode 1: expected 2 steps, its length, got indices 7 to 8",
    ),
    (
        "v3.0",
        rewritten("meta/episodes/chunk-000/file-000.parquet", "data/file_index", put(1, -1)),
        "episode 1: data/file_index: expected an integer, at least 0, got -1",
    ),
    (
        "v3.0",
        rewritten("meta/episodes/chunk-000/file-000.parquet", "episode_index", put(1, 0)),
        "episode 0 is listed twice",
    ),
    (
        "v3.0",
        rewritten(
            "meta/episodes/chunk-000/file-000.parquet",
            "videos/observation.images.front/from_timestamp",
            put(2, float("nan")),
        ),
        "episode 2: videos/observation.images.front/from_timestamp: expected seconds, got nan",
    ),
]


@pytest.mark.parametrize("case", range(len(OPENING)))
def test_opening(case: int, whole: Path, tmp_path: Path) -> None:
    layout, change, message = OPENING[case]
    root = tmp_path / "data"
    shutil.copytree(whole / layout, root)
    change(root)
    with pytest.raises((saccade.DatasetError, FileNotFoundError), match=message):
        saccade.datasets.open(root)


#: The layout, what happens to it, and what the message of reading episode 2 says.
READING: list[tuple[str, Change, str]] = [
    ("v2.1", cut(OLD_STEPS, 0.5), f"{OLD_STEPS}: cannot be read as Parquet"),
    ("v3.0", cut(STEPS, 0.5), f"{STEPS}: cannot be read as Parquet"),
    (
        "v2.1",
        cut(OLD_VIDEO, 0.5),
        f"episode 2, step 0, observation.images.front: .*{OLD_VIDEO} cannot be decoded",
    ),
    ("v2.1", lambda root: (root / OLD_VIDEO).write_bytes(b""), f"step 0, .*{OLD_VIDEO} cannot be decoded"),
    ("v2.1", shorter_video, f"episode 2, step 20, .*{OLD_VIDEO}: expected a frame at 2.000000 s"),
    (
        "v2.1",
        shifted_video,
        f"episode 2, step 1, .*{OLD_VIDEO}: expected a frame at 0.100000 s .* got the nearest",
    ),
    (
        "v2.1",
        damaged_video,
        f"episode 2, step [5-9], .*{OLD_VIDEO} cannot be decoded: .*damaged",
    ),
    (
        "v2.1",
        small_video,
        r"episode 2, step 0, .*expected a frame of shape \(48, 64, 3\).* got \(32, 32, 3\)",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "timestamp", put(5, 0.501)),
        f"{OLD_STEPS}: episode 2, step 5: timestamp: expected 0.100000 s after the step before",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "timestamp", lambda times: [time + 0.03 for time in times]),
        "episode 2, step 0, .*: expected a frame at 0.030000 s .* got the nearest at 0.000000 s",
    ),
    # By a whole step: every frame would be that of another step, in v3.0 some of another episode.
    *(
        (
            layout,
            rewritten(name, "timestamp", lambda times: [time + 0.1 for time in times]),
            "episode 2, step 0: timestamp: expected 0 s, the time of the first frame, got 0.100000 s",
        )
        for layout, name in (("v2.1", OLD_STEPS), ("v3.0", STEPS))
    ),
    ("v2.1", rewritten(OLD_STEPS, "timestamp", put(3, float("nan"))), "episode 2, step 3: timestamp"),
    (
        "v2.1",
        rewritten(OLD_STEPS, "frame_index", put(4, 5)),
        "episode 2, step 4: frame_index: expected the steps in",
    ),
    ("v2.1", rewritten(OLD_STEPS, "episode_index", put(4, 1)), "episode 2: expected 23 steps, .* got 22"),
    ("v3.0", rewritten(STEPS, "episode_index", put(9, 0)), "episode 2: expected 23 steps, .* got 22"),
    (
        "v2.1",
        rewritten(OLD_STEPS, "task_index", put(6, 9)),
        "episode 2, step 6: task_index: expected the index of a",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "observation.state", lambda rows: None),
        "episode 2: no column observation.state",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "observation.state", put(7, [1.0, 2.0])),
        "episode 2, step 7: observation.state: expected 4 numbers, as step 0 has, got 2",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "observation.state", lambda rows: [row[:3] for row in rows]),
        "episode 2: observation.state: expected 4 numbers a step, as info.json says, got 3",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "observation.state", put(7, None)),
        "episode 2, step 7: observation.state: no value",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "observation.state", put(8, [1.0, 2.0, float("inf"), 0.0])),
        "episode 2, step 8: observation.state: arm: expected numbers that float32 can hold, got inf",
    ),
    (
        "v2.1",
        rewritten(OLD_STEPS, "observation.state", lambda rows: ["text"] * len(rows)),
        "episode 2: observation.state: expected numbers or lists of numbers, got string",
    ),
    (
        "images",
        rewritten(STEPS, "observation.images.front", put(8, {"bytes": b"no picture", "path": None})),
        "episode 2, step 0, observation.images.front: cannot be read as a picture",
    ),
    *(
        (
            "images",
            rewritten(STEPS, "observation.images.front", put(8, {"bytes": png(mode), "path": None})),
            f"episode 2, step 0, observation.images.front: expected a picture in RGB, got {mode}",
        )
        for mode in ("RGBA", "L", "I;16")
    ),
    (
        "images",
        rewritten(STEPS, "observation.images.front", put(9, {"bytes": None, "path": "frame.png"})),
        "episode 2, step 1, observation.images.front: expected the bytes of a picture",
    ),
]


@pytest.mark.parametrize("case", range(len(READING)))
def test_reading(case: int, whole: Path, tmp_path: Path) -> None:
    layout, change, message = READING[case]
    root = tmp_path / "data"
    shutil.copytree(whole / layout, root)
    change(root)
    config = {
        "video": {"delta_indices": [0], "modality_keys": ["front"]},
        "state": {"delta_indices": [0], "modality_keys": ["arm"]},
        "language": {"delta_indices": [0], "modality_keys": ["annotation.human.task_description"]},
    }
    data = saccade.datasets.open(root, data_config=config)

    def read() -> None:
        for step in data.episodes[2].steps:
            data.observation(2, step)

    with pytest.raises(saccade.DatasetError, match=message):
        read()
    if layout == "v2.1":  # the other episodes are whole
        assert data.observation(0, 6)["state"]["arm"].shape == (1, 1, 3)


def test_what_is_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such directory; expected the folder of a LeRobotDataset"):
        saccade.datasets.open(tmp_path / "nothing" / "there" / "at all")
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="expected the folder of a LeRobotDataset"):
        saccade.datasets.open(tmp_path / "file")
    with pytest.raises(FileNotFoundError, match=r"meta/info.json: no such file"):
        saccade.datasets.open(tmp_path)
    for wrong in (None, 3, "a\0b"):
        with pytest.raises(saccade.InputError, match="path_or_id: expected a path or an id"):
            saccade.datasets.open(wrong)  # type: ignore[arg-type]
    with pytest.raises(saccade.InputError, match="revision: expected None with a path"):
        saccade.datasets.open(tmp_path, revision="main")


def test_an_annotation_without_a_column_is_refused_when_it_is_used(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(whole / "v2.1", root)
    edited("meta/modality.json", setting("annotation", "human.note", "original_key", "note"))(root)
    assert saccade.datasets.open(root).instruction(0, 0) == cases.TASKS[0]
    config = {"language": {"delta_indices": [0], "modality_keys": ["annotation.human.note"]}}
    with pytest.raises(saccade.DatasetError, match=r"episode_000000.parquet: episode 0: no column note"):
        saccade.datasets.open(root, data_config=config).instruction(0, 0)


def test_depth_maps_are_refused_by_name(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    shutil.copytree(whole / "v2.1", root)
    about = ("features", "observation.images.front", "info")
    edited("meta/info.json", setting(*about, {"video.is_depth_map": True}))(root)
    data = saccade.datasets.open(root)
    with pytest.raises(saccade.InputError, match="camera: expected colours, got the depth map 'front'"):
        data.frame(0, 0, "front")
    assert data.observation(0, 0, "lerobot").keys() == {
        "observation.images.wrist",
        "observation.state",
        "task",
    }
