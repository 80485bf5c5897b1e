"""The expert and its recordings in the simulator."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.cli import main
from saccade_lab.libero import demos
from saccade_lab.libero.checkpoint import CAMERAS
from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.expert import OPEN, Expert
from saccade_lab.libero.layout import ACTION_GROUPS, STATE_GROUPS
from saccade_lab.libero.recording import read_recordings
from saccade_lab.libero.scene import Scene
from saccade_lab.parallel import Workers
from saccade_lab.sim import demos as sim_demos
from saccade_lab.sim import environment_cache
from saccade_lab.sim.demos import load
from saccade_lab.sim.tasks import DEMONSTRATION_SEEDS

SEED = DEMONSTRATION_SEEDS.start
CARRIED_NOTHING = SEED + 7  # a seed of task 6 whose miss ends while the empty hand is carried
SMALL = demos.recording("libero_object", 6, image_size=32, frame_stride=30)

#: Positions of the object and the basket in the first frame of the first demonstration of that task.
RECORDED = [-0.100449, -0.2534029, 0.0086955, 0.0335882, 0.236071, -0.0045823]


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    environment_cache.close()


@pytest.mark.parametrize(
    ("suite", "task"),
    [("libero_object", 1), ("libero_object", 4), ("libero_spatial", 3), ("libero_spatial", 7)],
)
def test_the_expert_solves_official_starts(suite: str, task: int) -> None:
    environment = LiberoEnvironment(suite, task)
    environment.restart(3, 0)
    expert = Expert(demos.scene_of(environment), demos.EXPERTS[suite].technique)
    for _ in range(demos.MAX_STEPS):
        if environment.advance(expert.action()).success:
            break
    environment.close()
    assert environment.success
    assert 60 < environment.steps < 220


def test_an_episode_depends_on_its_task_and_seed_only() -> None:
    recorder = demos.Recorder({SMALL.name: SMALL})
    first = recorder((SMALL.name, SEED))
    assert first is not None
    assert recorder((SMALL.name, SEED + 1)) != first
    assert recorder((SMALL.name, SEED)) == first
    environment_cache.close()
    assert recorder((SMALL.name, SEED)) == first


def test_a_recording_shows_what_happened(tmp_path: Path) -> None:
    environment = LiberoEnvironment("libero_object", 6, image_size=32, settle_steps=0, official_states=False)
    episode = demos.record_episode(environment, SMALL, SEED)
    assert episode is not None
    steps = len(episode.actions)
    np.testing.assert_array_equal(episode.frame_steps, np.arange(0, steps, 30))
    assert episode.images.shape == (len(episode.frame_steps), 2, 32, 32, 3)
    assert episode.proprio.shape == (len(episode.frame_steps), 8)
    # The same actions, or where the expert was disturbed other ones, lead to the same observations.
    demos.start(environment, SMALL, SEED)
    undisturbed = int(np.argmax(episode.disturbed)) if episode.disturbed.any() else steps
    for step in range(undisturbed):
        if step % 30 == 0:
            seen = environment.observe()
            np.testing.assert_array_equal(seen["state"], episode.proprio[step // 30])
            images = np.stack([seen["images"][name] for name in CAMERAS])
            np.testing.assert_array_equal(images, episode.images[step // 30])
        environment.advance(episode.actions[step])
    environment.close()


def test_a_demonstration_after_a_miss_begins_with_a_hand_that_holds_nothing() -> None:
    environment = LiberoEnvironment("libero_object", 6, image_size=32, settle_steps=0, official_states=False)
    scene = demos.start(environment, SMALL, CARRIED_NOTHING)
    at_rest = scene.situation()
    episode = demos.record_episode(environment, SMALL, CARRIED_NOTHING)
    assert episode is not None
    assert environment.success
    environment.close()
    target, hand, fingers = episode.targets[0, :3], episode.proprio[0, :3], episode.proprio[0, 6:8]
    assert np.abs(fingers).max() < 0.005  # metres: closed on nothing
    assert hand[2] > at_rest.target[:, 2].max() + 0.03  # and carried
    np.testing.assert_allclose(target, at_rest.body, atol=0.05)  # while the object stayed where it was
    assert episode.actions[0, 6] == OPEN


def test_a_third_of_the_demonstrations_begins_after_a_miss(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def no_miss(scene: Any, technique: Any, advance: Any, rng: Any) -> bool:
        tried.append(1)
        return False  # so that nothing is recorded

    environment = SimpleNamespace(observe=None, advance=None)
    monkeypatch.setattr(demos, "start", lambda environment, settings, seed: None)
    monkeypatch.setattr(demos, "Expert", lambda scene, technique: SimpleNamespace(action=None))
    monkeypatch.setattr(demos, "miss", no_miss)
    monkeypatch.setattr(sim_demos, "demonstrated", lambda *given, **named: None)
    spatial = demos.recording("libero_spatial", 0, image_size=32, frame_stride=30)
    for seed in range(SEED, SEED + 600):
        demos.record_episode(environment, SMALL, seed)  # type: ignore[arg-type]
    assert 0.28 < len(tried) / 600 < 0.39
    tried.clear()
    for seed in range(SEED, SEED + 100):
        demos.record_episode(environment, spatial, seed)  # type: ignore[arg-type]
    assert not tried


def test_starts_are_wider_than_the_official_ones() -> None:
    environment = LiberoEnvironment("libero_object", 1, settle_steps=0, official_states=False)
    places = []
    for seed in range(SEED, SEED + 6):
        scene = demos.start(environment, demos.recording("libero_object", 1, 32, 30), seed)
        places.append([scene.position(name) for name in scene.names()])
        assert np.abs(environment.simulation.data.qvel).max() < 0.5  # all have come to rest
    found = np.array(places)
    assert found[..., 2].min() > -0.01  # none has fallen through the floor
    assert found[..., :2].std(axis=0).mean() > 0.012  # metres; 3 to 9 mm in the official states
    environment.close()


@pytest.mark.parametrize(
    ("task", "carrier"),
    [
        (0, "akita_black_bowl_1"),
        (2, "akita_black_bowl_1"),
        (3, "cookies_1"),
        (4, None),
        (8, "akita_black_bowl_1"),
    ],
)
def test_what_stands_on_something_moves_with_it_or_stays(task: int, carrier: str | None) -> None:
    """A bowl on the table, near other things, on a box of cookies, and in a drawer."""
    settings = demos.recording("libero_spatial", task, 32, 30)
    environment = LiberoEnvironment("libero_spatial", task, settle_steps=0, official_states=False)
    environment.restart(None, SEED)
    before = demos.scene_of(environment)
    assert before.carriers()[before.target] == carrier
    assert before.carriers()["plate_1"] == "plate_1"
    found = {name: before.position(name) for name in before.names()}
    scene = demos.start(environment, settings, SEED)
    moved = {name: (scene.position(name) - found[name])[:2] for name in scene.names()}
    assert np.abs(moved["plate_1"]).max() > 0.004
    expected = np.zeros(2) if carrier is None else moved[carrier]
    np.testing.assert_allclose(moved[scene.target], expected, atol=0.004)  # metres; it has settled
    if carrier is not None:
        assert np.abs(expected).max() > 0.004
    environment.close()


def test_libero_object_starts_as_in_the_demonstrations_of_the_committed_policies() -> None:
    environment = LiberoEnvironment("libero_object", 6, settle_steps=0, official_states=False)
    np.testing.assert_allclose(demos.start(environment, SMALL, SEED).targets(), RECORDED, atol=1e-6)
    environment.close()


def test_furniture_is_an_obstacle_also_between_its_corners() -> None:
    environment = LiberoEnvironment("libero_spatial", 4, settle_steps=10, official_states=False)
    environment.restart(None, SEED)
    scene = demos.scene_of(environment)
    # The top of the cabinet, where the other bowl stands.
    bowl = scene.points("akita_black_bowl_2")
    top = np.append(bowl[:, :2].mean(axis=0), bowl[:, 2].min())
    scene.move("akita_black_bowl_2", np.array([0.0, 0.5]))
    assert np.linalg.norm(scene.obstacles() - top, axis=1).min() < 0.02  # metres
    environment.close()


def test_points_span_the_shapes_of_objects() -> None:
    """MuJoCo has computed a box around each geom, which the points touch on all sides."""
    environment = LiberoEnvironment("libero_object", 0, settle_steps=0, official_states=False)
    environment.restart(None, SEED)
    model, data = environment.simulation.model, environment.simulation.data
    scene = Scene(environment.simulation.inner, "alphabet_soup_1", "basket_1")
    for name in scene.names():
        root = environment.simulation.inner.obj_body_id[name]
        corners = []
        for geom in range(model.ngeom):
            body = model.geom_bodyid[geom]
            collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
            if model.body_rootid[body] != model.body_rootid[root] or not collides:
                continue
            centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            signs = np.stack(np.meshgrid(*3 * [[-1, 1]], indexing="ij"), axis=-1).reshape(-1, 3)
            turned = (centre + signs * half) @ data.geom_xmat[geom].reshape(3, 3).T
            corners.append(data.geom_xpos[geom] + turned)
        box = np.concatenate(corners)
        points = scene.points(name)
        assert (points.min(axis=0) >= box.min(axis=0) - 1e-6).all()
        assert (points.max(axis=0) <= box.max(axis=0) + 1e-6).all()
        assert np.ptp(points, axis=0).prod() > 0.4 * np.ptp(box, axis=0).prod()
    environment.close()


def test_the_command_records_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, record = tmp_path / "demos", tmp_path / "data"
    arguments = ["demos", "--env", "libero_object", "--tasks", "6", "--episodes", "1", "--image-size", "32"]
    assert main([*arguments, "--out", str(out), "--record", str(record)]) == 0
    assert "1 demonstrations" in capsys.readouterr().out
    (task,) = read_recordings(out)
    (path,) = (out / task.name).glob("*.npz")
    one = load(path)
    data = saccade.datasets.open(record)
    assert len(data) == 1
    assert path.stem.isdigit()
    assert int(path.stem) in DEMONSTRATION_SEEDS
    assert len(one.actions) == len(one.images)
    assert data.cameras == CAMERAS
    assert (data.state_widths, data.action_widths) == (STATE_GROUPS, ACTION_GROUPS)
    np.testing.assert_array_equal(data.column(0, "observation.state"), one.proprio)
    actions = data.column(0, "action")
    np.testing.assert_array_equal(actions[:, :6], one.actions[:, :6])
    np.testing.assert_array_equal(actions[:, 6], one.actions[:, 6] < 0)  # 1 is open
    np.testing.assert_array_equal(data.column(0, "disturbed")[:, 0], one.disturbed)
    assert data.instruction(0, 0) == task.instruction


def test_two_processes_write_the_same_files(tmp_path: Path) -> None:
    for jobs in (1, 2):
        demos.record([SMALL], 2, tmp_path / str(jobs), lambda task: None, Workers(jobs=jobs))
    names = [f"{SMALL.name}/{SEED + index}.npz" for index in range(2)]
    for name in names:
        one, other = (
            dict(np.load(io.BytesIO((tmp_path / str(jobs) / name).read_bytes()))) for jobs in (1, 2)
        )
        assert all(np.array_equal(one[key], other[key]) for key in one)
