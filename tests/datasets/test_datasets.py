"""Reading data sets: every step and frame of those that pyarrow and PyAV wrote."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import multiprocessing
import os
import pickle
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade.datasets
import saccade.observations
from saccade.datasets.videos import Videos
from tests.helpers import dataset_cases as cases
from tests.helpers.paths import DATA

#: The modality configs of N1.7 with a history and chunks that reach beyond the end.
CONFIGS: dict[str, Any] = {
    "video": {"delta_indices": [-2, 0], "modality_keys": ["wrist", "front"]},
    "state": {"delta_indices": [-1, 0], "modality_keys": ["hand", "arm"]},
    "action": {"delta_indices": list(range(16)), "modality_keys": ["arm", "hand", "base"]},
    "language": {"delta_indices": [0], "modality_keys": ["annotation.human.task_description"]},
}


@pytest.fixture(scope="module", params=["v2.0", "v2.1", "v3.0", "images"])
def root(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("data")
    if request.param in ("v2.0", "v2.1"):
        return cases.write_old(folder, request.param)
    return cases.write_new(folder, "image" if request.param == "images" else "video")


def frames_of(root: Path, episode: int, name: str) -> list[np.ndarray[Any, Any]]:
    """All frames of an episode, decoded from the start of the video; or those that became PNGs."""
    camera = ("front", "wrist").index(name)
    key = f"observation.images.{name}"
    if not (root / "videos").exists():
        return list(cases.pixels(episode, cases.LENGTHS[episode], camera))
    old = root / "videos" / f"chunk-{episode // 2:03d}" / key / f"episode_{episode:06d}.mp4"
    if old.exists():
        return [pixels for _, pixels in cases.decoded(old)]
    first = sum(cases.LENGTHS[:episode])
    found = cases.decoded(root / "videos" / key / "chunk-000" / "file-000.mp4")
    return [pixels for _, pixels in found[first : first + cases.LENGTHS[episode]]]


def test_what_a_data_set_says_about_itself(root: Path) -> None:
    data = saccade.datasets.open(root)
    assert len(data) == 3
    assert [one.length for one in data.episodes] == list(cases.LENGTHS)
    assert data.episodes[2].steps == range(23)
    assert data.episodes[1].tasks == (cases.TASKS[1],)
    assert data.tasks == cases.TASKS
    assert data.fps == cases.FPS
    assert data.robot == "so100"
    assert data.cameras == ("front", "wrist")
    assert data.state_widths == {"arm": 3, "hand": 1}
    assert data.action_widths == {"arm": 3, "hand": 1, "base": 1}
    assert "3 episodes, 31 steps at 10 Hz, 2 tasks" in repr(data)


def test_every_frame_in_any_order_is_that_of_the_whole_video(root: Path) -> None:
    data = saccade.datasets.open(root)
    rng = np.random.default_rng(0)
    for episode in (2, 0, 1):
        for name in ("front", "wrist"):
            expected = frames_of(root, episode, name)
            steps = list(data.episodes[episode].steps)
            for step in [*steps, *reversed(steps), *rng.permutation(steps)]:
                found = data.frame(episode, int(step), name)
                np.testing.assert_array_equal(found.pixels, expected[step])
                assert found.timestamp == pytest.approx(step / cases.FPS, abs=1e-6)


def test_a_frame_is_the_callers(root: Path) -> None:
    """A camera's picture that is drawn on stays as it was recorded."""
    data = saccade.datasets.open(root)
    frame = data.frame(2, 3, "front")
    before = frame.pixels.copy()
    frame.pixels[:] = 0
    np.testing.assert_array_equal(data.frame(2, 3, "front").pixels, before)


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        ("libx265", {"g": "8", "x265-params": "log-level=none"}),  # open groups of pictures
        ("libx264", {"g": "8", "x264-params": "open-gop=1"}),
        ("libsvtav1", {"g": "2", "crf": "30"}),  # as lerobot encodes
        ("mpeg4", {}),
    ],
)
def test_every_frame_of_other_encodings(codec: str, options: dict[str, str], tmp_path: Path) -> None:
    """Frames that stand before a keyframe are stored after it where groups are open."""
    import av

    if codec not in av.codecs_available:
        pytest.skip(f"PyAV has no {codec}")
    path = tmp_path / "video.mp4"
    # SVT-AV1 gives the calling thread a real-time priority where it may, for ever.
    encoding = multiprocessing.get_context("spawn").Process(
        target=cases.encode, args=(path, codec, options, cases.pixels(1, 40, 0))
    )
    encoding.start()
    encoding.join()
    assert encoding.exitcode == 0
    whole, videos = cases.decoded(path), Videos()
    assert len(whole) == 40
    for place in (*np.random.default_rng(0).permutation(40).tolist(), *range(40)):
        found = videos.frame("here", path, place / cases.FPS, 0.0)
        np.testing.assert_array_equal(found.pixels, whole[place][1])


def test_observations_of_a_history(root: Path) -> None:
    data = saccade.datasets.open(root, data_config=CONFIGS)
    for episode in (0, 1, 2):
        recorded = cases.columns(episode, cases.LENGTHS[episode], 0)["observation.state"]
        frames = {name: frames_of(root, episode, name) for name in ("front", "wrist")}
        for step in data.episodes[episode].steps:
            found = data.observation(episode, step)
            assert list(found["video"]) == ["wrist", "front"]
            for name, shown in found["video"].items():
                assert shown.dtype == np.uint8
                places = [max(step - 2, 0), step]
                np.testing.assert_array_equal(shown[0], np.stack([frames[name][place] for place in places]))
            rows = recorded[[max(step - 1, 0), step]]
            assert list(found["state"]) == ["hand", "arm"]
            np.testing.assert_array_equal(found["state"]["arm"][0], rows[:, :3])
            np.testing.assert_array_equal(found["state"]["hand"][0], rows[:, 3:])
            assert found["language"] == {"annotation.human.task_description": [[cases.TASKS[episode % 2]]]}


def test_the_forms_hold_the_same(root: Path) -> None:
    data = saccade.datasets.open(root, data_config=CONFIGS)
    nested, flat, lerobot = (data.observation(2, 9, form) for form in ("isaac", "isaac flat", "lerobot"))
    for name, frames in nested["video"].items():
        np.testing.assert_array_equal(flat[f"video.{name}"], frames)
        np.testing.assert_array_equal(lerobot[f"observation.images.{name}"], np.moveaxis(frames, -1, -3))
    # lerobot has the whole column, in its order.
    state = np.concatenate([nested["state"][key] for key in ("arm", "hand")], axis=-1)
    np.testing.assert_array_equal(lerobot["observation.state"], state)
    assert flat["annotation.human.task_description"] == [lerobot["task"]] == [[cases.TASKS[0]]]
    with pytest.raises(saccade.InputError, match="form: expected one of isaac, isaac flat, lerobot, got 'x'"):
        data.observation(2, 9, "x")


def test_actions_at_the_end_of_an_episode(root: Path) -> None:
    data = saccade.datasets.open(root, data_config=CONFIGS)
    recorded = cases.columns(2, 23, 0)
    for step in (0, 7, 8, 22):
        found = data.actions(2, step)
        places = np.minimum(step + np.arange(16), 22)
        np.testing.assert_array_equal(found["arm"], recorded["action"][places, :3])
        np.testing.assert_array_equal(found["base"], recorded["action.base"][places, 1:])
        assert found["base"].dtype == np.float64
        past = step + np.arange(16) > 22
        np.testing.assert_array_equal(found["hand"][past], 0)  # N1.5, for keys that are not absolute
        np.testing.assert_array_equal(found["hand"][~past], recorded["action"][places[~past], 3:])
        few = data.actions(2, step, 5)
        assert all(np.array_equal(few[key], found[key][:5]) for key in found)
    assert data.actions(1, 0)["arm"].shape == (16, 3)
    assert data.actions(2, 0, 23)["arm"].shape == (23, 3)
    without = saccade.datasets.open(root)
    np.testing.assert_array_equal(without.actions(2, 20, 3)["arm"], recorded["action"][20:, :3])
    with pytest.raises(saccade.InputError, match="horizon: expected a number"):
        without.actions(2, 0)


def test_a_data_set_without_modality_has_lerobots_names(tmp_path: Path) -> None:
    data = saccade.datasets.open(cases.write_old(tmp_path, modality=None))
    assert (data.cameras, data.state_widths, data.action_widths) == (
        ("front", "wrist"),
        {"state": 4},
        {"action": 4},
    )
    found = data.observation(0, 2, "lerobot")
    assert list(found) == [
        "observation.images.front",
        "observation.images.wrist",
        "observation.state",
        "task",
    ]
    assert found["observation.images.front"].shape == (1, 3, *cases.SIZE)
    assert found["task"] == [cases.TASKS[0]]
    assert data.instruction(1, 0) == cases.TASKS[1]


def test_statistics_are_those_of_all_steps(root: Path) -> None:
    data = saccade.datasets.open(root)
    recorded = [cases.columns(episode, length, 0) for episode, length in enumerate(cases.LENGTHS)]
    if data.version == "v3.0":  # no stats.json
        assert data.statistics == {"state": {}, "action": {}}
        return
    for kind, key, column, numbers in (
        ("state", "hand", "observation.state", slice(3, 4)),
        ("action", "base", "action.base", slice(1, 2)),
    ):
        rows = np.concatenate([one[column] for one in recorded]).astype(np.float64)[:, numbers]
        found = data.statistics[kind][key]
        assert list(found) == ["min", "max", "mean", "std"]
        for name, values in found.items():
            np.testing.assert_allclose(values, getattr(np, name)(rows, axis=0), rtol=1e-12)


def test_a_copy_reads_the_same(root: Path) -> None:
    data = saccade.datasets.open(root)
    before = data.frame(0, 3, "front").pixels
    copied = pickle.loads(pickle.dumps(data))
    np.testing.assert_array_equal(copied.frame(0, 3, "front").pixels, before)
    assert copied.fingerprint() == data.fingerprint()


def test_the_fingerprint_is_of_every_file(tmp_path: Path) -> None:
    data = saccade.datasets.open(cases.write_old(tmp_path))
    seen = {data.fingerprint()}
    for path in sorted(tmp_path.rglob("*.*")):
        if path.is_dir():
            continue
        path.write_bytes(path.read_bytes() + b"\n")
        assert data.fingerprint() not in seen
        seen.add(data.fingerprint())
    assert len(seen) == 1 + 5 + 3 + 6


def test_the_fingerprint_is_of_files_wherever_the_template_leads(tmp_path: Path) -> None:
    root = cases.write_old(tmp_path / "data")
    (root / "data").rename(root / "steps")
    info = root / "meta" / "info.json"
    info.write_text(info.read_text().replace('"data/chunk', '"steps/chunk'))
    data = saccade.datasets.open(root)
    before, path = data.fingerprint(), root / "steps" / "chunk-000" / "episode_000001.parquet"
    path.write_bytes(path.read_bytes() + b"more")
    assert data.fingerprint() != before


def test_the_keys_and_history_of_a_policy(tmp_path: Path) -> None:
    data = saccade.datasets.open(cases.write_old(tmp_path))
    config = {
        "video_keys": ["video.wrist"],
        "state_keys": ["state.hand", "state.arm"],
        "action_keys": ["action.arm"],
        "language_keys": ["annotation.human.task_description"],
        "observation_indices": [-1, 0],
        "action_indices": list(range(8)),
        "state_modes": {},
        "action_modes": {},
        "target_rotations": {},
    }
    needs = saccade.observations.Requirements(
        cameras=(saccade.observations.Camera("wrist"),),
        state=(("hand", 1), ("arm", 3)),
        state_history=2,
        video_horizon=2,
        language_keys=("annotation.human.task_description",),
        any_annotation=True,
        video_indices=(-1, 0),
        state_indices=(-1, 0),
        action_indices=tuple(range(8)),
    )
    policy = policy_like(needs, ["arm"])
    chosen, expected = data.for_policy(policy), saccade.datasets.open(tmp_path, data_config=config)
    found, wanted = chosen.observation(2, 5), expected.observation(2, 5)
    assert found["language"] == wanted["language"]
    for part in ("video", "state"):
        assert list(found[part]) == list(wanted[part])
        assert all(np.array_equal(found[part][key], wanted[part][key]) for key in found[part])
    assert list(chosen.actions(2, 0)) == ["arm"]
    assert chosen.actions(2, 0)["arm"].shape == (8, 3)
    with pytest.raises(
        saccade.InputError, match="data_config: expected one, because the checkpoint does not say"
    ):
        data.for_policy(policy_like(dataclasses.replace(needs, video_indices=None), ["arm"]))
    # The data config that the data set was opened with says it.
    told = expected.for_policy(policy_like(dataclasses.replace(needs, video_indices=None), ["arm"]))
    assert np.array_equal(told.observation(2, 5)["video"]["wrist"], wanted["video"]["wrist"])
    other = dataclasses.replace(needs, language_keys=("annotation.human.other",))
    assert expected.for_policy(policy_like(other, ["arm"])).language_key == needs.language_keys[0]
    with pytest.raises(saccade.InputError, match="has several"):
        _ = data.for_policy(policy_like(other, ["arm"])).language_key
    with pytest.raises(
        saccade.InputError, match=r"policy: state.leg, action.leg: not in .*modality.json, which has"
    ):
        data.for_policy(policy_like(dataclasses.replace(needs, state=(("leg", 1),)), ["leg"]))
    # Policies of lerobot have the names of the data set.
    plain = data.for_policy(policy_like(saccade.observations.Requirements(), [], pipeline=True))
    assert (plain.cameras, plain.state_widths, plain.action_widths) == (
        ("front", "wrist"),
        {"state": 4},
        {"action": 4},
    )


def policy_like(needs: saccade.observations.Requirements, actions: list[str], pipeline: Any = None) -> Any:
    """What a data set looks at of a policy."""
    groups = tuple(types.SimpleNamespace(key=key) for key in actions)
    normalizer = types.SimpleNamespace(action_groups=groups, pipeline=pipeline)
    return types.SimpleNamespace(requirements=needs, normalizer=normalizer)


def test_keys_that_the_data_set_has_not(tmp_path: Path) -> None:
    cases.write_old(tmp_path)
    wrong = {**CONFIGS, "video": {"delta_indices": [0], "modality_keys": ["top"]}}
    with pytest.raises(
        saccade.InputError, match=r"data_config: video.top: not in .*modality.json, which has video.front"
    ):
        saccade.datasets.open(tmp_path, data_config=wrong)
    parts: list[Any] = [{"modality_keys": ["front"]}, {"delta_indices": [], "modality_keys": []}, 3]
    for part in parts:
        with pytest.raises(
            saccade.InputError, match="data_config: video: expected modality_keys and delta_indices"
        ):
            saccade.datasets.open(tmp_path, data_config={**CONFIGS, "video": part})
    # Two annotations: which of them is the instruction?
    data = saccade.datasets.open(tmp_path)
    with pytest.raises(
        saccade.InputError, match="data_config: expected one that says which is the instruction"
    ):
        data.instruction(0, 0)
    for episode, step in ((3, 0), (-1, 0), (0, 7), (0, -1), (0, 1.5), ("0", 0)):
        with pytest.raises(saccade.InputError, match=r"^(episode|step): expected"):
            data.frame(episode, step, "front")  # type: ignore[arg-type]
    with pytest.raises(saccade.InputError, match="camera: expected one of front, wrist, got 'top'"):
        data.frame(0, 0, "top")
    with pytest.raises(saccade.InputError, match=r"name: expected a column, one of observation.state"):
        data.column(0, "observation.images.front")


@pytest.mark.parametrize("name", sorted(path.name for path in (DATA / "datasets").iterdir()))
def test_published_metadata(name: str, tmp_path: Path) -> None:
    """The keys of NVIDIA's demo data are those of its modality.json; the numbers follow from info.json."""
    from saccade.datasets.metadata import Info
    from saccade.datasets.modality import read_modality

    info = json.loads((DATA / "datasets" / name / "info.json").read_text())
    modality = json.loads((DATA / "datasets" / name / "modality.json").read_text())
    known = Info(tmp_path, info)
    found = read_modality(modality, known.features, "modality.json")
    for kind in ("state", "action"):
        keys = getattr(found, kind)
        assert list(keys) == list(modality[kind])
        column = known.features["observation.state" if kind == "state" else "action"]
        assert sum(one.width for one in keys.values()) == column.shape[0]
    assert [known.features[key].dtype for key in found.video.values()] == ["video"] * len(modality["video"])
    assert list(found.language)[1:] == [f"annotation.{key}" for key in modality["annotation"]]


def test_threads_and_forks_share_a_data_set(root: Path) -> None:
    data = saccade.datasets.open(root)
    places = [(episode, step) for episode in (0, 1, 2) for step in data.episodes[episode].steps]
    expected = {place: data.frame(*place, "front").pixels for place in places}

    def check(order: list[int]) -> bool:
        chosen = [places[number] for number in order]
        return all(np.array_equal(data.frame(*place, "front").pixels, expected[place]) for place in chosen)

    rng = np.random.default_rng(0)
    orders = [rng.permutation(len(places)).tolist() for _ in range(4)]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert all(pool.map(check, orders))
    child = os.fork()
    if not child:  # no cleaning up, which is the parent's
        os._exit(0 if check(orders[0]) else 1)
    assert check(orders[1])
    assert os.waitpid(child, 0)[1] == 0
