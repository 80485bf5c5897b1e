"""The tasks made for studies: two goals, a place that takes two cameras, two stages, a fork, named balls."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

import saccade_lab.sim  # noqa: F401  (registers the environments)
from saccade import InputError
from saccade.cli import main
from saccade_lab.sim import demos, graphics
from saccade_lab.sim.cameras import DEFAULT_CAMERAS, DEFAULT_IMAGE_SIZE, CameraPose
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.experts import Expert
from saccade_lab.sim.scenarios import TOUCH, Ball, BallScenario, Fork, NamedBall, StereoReach, TwoGoals
from saccade_lab.sim.tasks import DEMO_TASKS, DEMONSTRATION_SEEDS, STUDY_TASKS, TASKS, check_evaluation_seeds

Float64Array = npt.NDArray[np.float64]

NAMES = ("two-goals", "stereo-reach", "two-stage", "fork", "touch-yellow", "touch-blue")
SHIPPED = ("reach", "push", "drawer-open", "button-press-topdown", "window-open")
FIELD_OF_VIEW = 45.0  # degrees, MuJoCo's default for a free camera


@contextlib.contextmanager
def make(task: str, **options: Any) -> Iterator[TaskEnvironment]:
    with contextlib.closing(TaskEnvironment(task, **options)) as environment:
        yield environment


def balls_of(environment: TaskEnvironment) -> tuple[Ball, ...]:
    assert isinstance(environment.scenario, BallScenario)
    return environment.scenario.placed


def go_to(environment: TaskEnvironment, target: Float64Array, steps: int = 150) -> bool:
    """Moves the fingertips to a place by feedback of our own; whether any step on the way was a success."""
    done = False
    for _ in range(steps):
        way = target - environment.fingertips()
        done = environment.advance(np.append(np.clip(20.0 * way, -1.0, 1.0), 0.0)).success or done
    return done


def eye_and_forward(camera: CameraPose) -> tuple[Float64Array, Float64Array]:
    """Position and viewing direction of a camera."""
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + [0.0, 0.0, np.sin(elevation)]
    return np.array(camera.lookat) - camera.distance * forward, forward


def seen_at(camera: CameraPose, points: Float64Array, size: int) -> tuple[Float64Array, Float64Array]:
    """Where a pinhole camera sees points `(n, 3)`: pixels from the middle, right and up; and their scale.

    The scale is that of lengths there, in pixels a metre.
    """
    eye, forward = eye_and_forward(camera)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = points - eye
    scale = size / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2)) / (away @ forward)
    pixels = np.stack([away @ right, away @ np.cross(right, forward)], axis=1) * scale[:, None]
    return pixels, scale


def coloured(picture: npt.NDArray[np.uint8], ball: Ball) -> Float64Array:
    """Rows and columns `(n, 2)` of the pixels that have the hue of a ball."""
    pixels = picture.astype(float)
    hue = np.array(ball.rgba[:3])
    bright = pixels.max(axis=2)
    cosine = pixels @ hue / np.maximum(np.linalg.norm(pixels, axis=2) * np.linalg.norm(hue), 1.0)
    return np.argwhere((cosine > 0.97) & (bright > 120)).astype(float)


def test_the_shipped_tasks_keep_their_numbers() -> None:
    assert tuple(task.name for task in DEMO_TASKS) == SHIPPED
    assert tuple(TASKS) == SHIPPED + NAMES
    assert tuple(task.name for task in STUDY_TASKS) == NAMES
    assert [demos.DEFAULT_COUNTS[name] for name in SHIPPED] == [300, 100, 100, 100, 100]
    assert set(demos.DEFAULT_COUNTS) == set(TASKS)


def test_instructions_are_five() -> None:
    said = [text for task in TASKS.values() for text in task.instructions]
    assert len(set(said)) == len(said)
    for task in STUDY_TASKS:
        assert len(task.instructions) == 5


@pytest.mark.parametrize("task", NAMES)
def test_gymnasium_knows_them(task: str) -> None:
    with contextlib.closing(gymnasium.make(f"saccade/{task}-v0", render_mode="rgb_array")) as environment:
        observation, info = environment.reset(seed=1)
        assert environment.observation_space.contains(observation)
        assert observation["instruction"] == TASKS[task].instructions[1]
        assert info == {"success": False, "task": task}
        plain = environment.unwrapped
        assert isinstance(plain, TaskEnvironment)
        view = environment.render()
        assert isinstance(view, np.ndarray)
        for ball in balls_of(plain):
            assert len(coloured(view, ball)) > 20


@pytest.mark.parametrize("task", NAMES)
def test_the_expert_succeeds_well_before_the_end(task: str) -> None:
    with make(task) as environment:
        for seed in range(6):
            environment.restart(seed)
            expert = Expert(environment)
            steps = next(step for step in itertools.count(1) if environment.advance(expert.action()).success)
            # A fork leaves no time: the choice has to be made at once.
            assert steps < (0.9 if task == "fork" else 0.65) * environment.task.max_steps


@pytest.mark.parametrize("task", NAMES)
def test_a_seed_gives_the_same_layout_and_pixels_whatever_went_before(task: str) -> None:
    with make(task) as used, make(task) as fresh:
        used.reset(seed=3)
        for ball in balls_of(used):
            go_to(used, ball.position)
        first, _ = used.reset(seed=4)
        second, _ = fresh.reset(seed=4)
        np.testing.assert_array_equal(used.privileged_targets(), fresh.privileged_targets())
        assert used.scenario.expert_action(used.privileged_state()).tolist() == (
            fresh.scenario.expert_action(fresh.privileged_state()).tolist()
        )
        layouts = set()
        for seed in range(20):
            used.restart(seed)
            layouts.add(tuple(used.privileged_targets()))
    assert len(layouts) == 20
    np.testing.assert_array_equal(first["proprio"], second["proprio"])
    for camera in DEFAULT_CAMERAS:
        np.testing.assert_array_equal(first["images"][camera.name], second["images"][camera.name])


@pytest.mark.parametrize("task", NAMES)
def test_proprioception_and_words_do_not_depend_on_the_layout(task: str) -> None:
    with make(task, image_size=16) as environment:
        observations = [environment.reset(seed=seed)[0] for seed in (0, 5, 10)]
    for observation in observations[1:]:
        assert observation["instruction"] == observations[0]["instruction"]
        np.testing.assert_array_equal(observation["proprio"], observations[0]["proprio"])


@pytest.mark.parametrize("task", NAMES)
def test_every_ball_is_drawn_where_it_is(task: str) -> None:
    size = DEFAULT_IMAGE_SIZE
    with make(task) as environment:
        for seed in range(8):
            images = environment.reset(seed=seed)[0]["images"]
            balls = balls_of(environment)
            visible = np.zeros(len(balls), dtype=int)
            for camera in DEFAULT_CAMERAS:
                where, scale = seen_at(camera, np.stack([ball.position for ball in balls]), size)
                radius = scale * [ball.radius for ball in balls]
                assert (np.abs(where).max(axis=1) + radius < size / 2).all()  # not cut off
                for number, ball in enumerate(balls):
                    found = coloured(images[camera.name], ball)
                    # Row and column of a pixel to right and up, from the picture's middle.
                    from_middle = np.stack(
                        [found[:, 1] + 0.5 - size / 2, size / 2 - found[:, 0] - 0.5], axis=1
                    )
                    inside = np.linalg.norm(from_middle - where[number], axis=1) <= radius[number] + 1
                    visible[number] += inside.sum() >= 0.5 * np.pi * radius[number] ** 2
                    outside = [
                        np.linalg.norm(from_middle - spot, axis=1) - reach
                        for spot, reach in zip(where, radius, strict=True)
                    ]
                    assert (np.min(outside, axis=0) <= 1.5).all()  # nothing else has that colour
            assert (visible >= 2).all(), (seed, visible)  # the hand may hide it from one camera


def test_layouts_are_as_described() -> None:
    chosen, nearer = [], []
    with make("two-goals") as environment:
        assert isinstance(environment.scenario, TwoGoals)
        for seed in range(60):
            environment.restart(seed)
            left, right = balls_of(environment)
            hand = environment.fingertips()
            ways = [np.linalg.norm(ball.position - hand) for ball in (left, right)]
            assert np.linalg.norm(left.position - right.position) >= 0.2
            assert abs(ways[0] - ways[1]) <= 0.02 + 1e-9
            assert (left.radius, left.rgba) == (right.radius, right.rgba)
            assert left.position[0] < right.position[0]
            np.testing.assert_allclose(
                environment.privileged_targets(), [*left.position, *right.position], rtol=1e-6
            )
            chosen.append(environment.scenario.chosen)
            nearer.append(np.argmin(ways))
    # Sixty fair coins: less than one in a thousand such samples is outside.
    assert 17 <= sum(chosen) <= 43
    assert 17 <= np.equal(chosen, nearer).sum() <= 43

    with make("two-stage") as environment:
        for seed in range(20):
            environment.restart(seed)
            first, second = balls_of(environment)
            assert np.linalg.norm(first.position - second.position) >= 0.3
            assert np.linalg.norm(first.position - environment.fingertips()) >= 0.15

    with make("stereo-reach") as environment:
        radii = []
        for seed in range(40):
            environment.restart(seed)
            (ball,) = balls_of(environment)
            radii.append(ball.radius)
            targets = environment.privileged_targets()
            np.testing.assert_array_equal(targets[:3], targets[3:])
        assert 0.018 <= min(radii) < 0.021
        assert 0.039 < max(radii) <= 0.045


@pytest.mark.parametrize("task", ["two-goals", "fork"])
def test_the_choice_cannot_be_seen_but_changes_what_the_expert_does(task: str) -> None:
    with make(task) as environment, make(task) as other:
        first, _ = environment.reset(seed=11)
        other.reset(seed=11)
        assert isinstance(other.scenario, (TwoGoals, Fork))
        other.scenario.chosen = 1 - other.scenario.chosen
        second = other.observe()
        assert first["instruction"] == second["instruction"]
        np.testing.assert_array_equal(first["proprio"], second["proprio"])
        np.testing.assert_array_equal(environment.privileged_targets(), other.privileged_targets())
        for camera in DEFAULT_CAMERAS:
            np.testing.assert_array_equal(first["images"][camera.name], second["images"][camera.name])
        actions = [Expert(world).action() for world in (environment, other)]
        assert actions[0][0] * actions[1][0] < 0  # one to the left, one to the right


@pytest.mark.parametrize("goal", [0, 1])
def test_either_goal_counts_and_what_lies_between_does_not(goal: int) -> None:
    with make("two-goals") as environment:
        environment.restart(2)
        one, other = balls_of(environment)
        assert not go_to(environment, (one.position + other.position) / 2)
        assert go_to(environment, balls_of(environment)[goal].position)


def test_a_fork_is_its_own_mirror_image_and_the_expert_keeps_away_from_the_middle() -> None:
    chosen = []
    with make("fork") as environment:
        scenario = environment.scenario
        assert isinstance(scenario, Fork)
        for seed in range(60):
            environment.restart(seed)
            hand = environment.fingertips()
            left, middle, right = (ball.position - hand for ball in balls_of(environment))
            np.testing.assert_allclose(left, right * [-1.0, 1.0, 1.0], atol=1e-12)
            np.testing.assert_allclose(middle, left * [0.0, 1.0, 1.0], atol=1e-12)
            chosen.append(scenario.chosen)
        assert 17 <= sum(chosen) <= 43
        for seed in (0, 1):
            environment.restart(seed)
            nearest = np.inf
            while not environment.advance(Expert(environment).action()).success:
                nearest = min(nearest, scenario.distance(scenario.placed[1]))
            assert nearest > TOUCH + 0.02
            assert (environment.fingertips()[0] > hand[0]) == bool(scenario.chosen)


def test_the_mean_of_both_ways_touches_the_blue_ball_and_then_nothing_counts() -> None:
    """What a policy does that averages: the experts' mean action, straight ahead."""
    with make("fork") as environment:
        scenario = environment.scenario
        assert isinstance(scenario, Fork)
        for seed in range(4):
            environment.restart(seed)
            for _ in range(environment.task.max_steps):
                ways = []
                for chosen in (0, 1):
                    scenario.chosen = chosen
                    ways.append(Expert(environment).action())
                environment.advance(np.mean(ways, axis=0))
            assert environment.advance(np.zeros(4)).reward < -TOUCH
            assert not go_to(environment, scenario.placed[0].position)
            environment.restart(seed)
            assert go_to(environment, scenario.placed[0].position)


def test_the_words_alone_tell_which_ball_is_meant() -> None:
    rights = []
    with make("touch-yellow") as yellow, make("touch-blue") as blue:
        for seed in range(60):
            seen = [environment.reset(seed=seed)[0] for environment in (yellow, blue)]
            if seed < 3:
                for camera in DEFAULT_CAMERAS:
                    np.testing.assert_array_equal(*(one["images"][camera.name] for one in seen))
            words = [set(one["instruction"].split()) for one in seen]
            assert (words[0] - words[1], words[1] - words[0]) == ({"yellow"}, {"blue"})
            scenarios = [environment.scenario for environment in (yellow, blue)]
            assert all(isinstance(scenario, NamedBall) for scenario in scenarios)
            assert [ball.rgba for ball in balls_of(yellow)] == [ball.rgba for ball in balls_of(blue)]
            rights.append(scenarios[0].is_right)  # type: ignore[attr-defined]
            assert scenarios[1].is_right != rights[-1]  # type: ignore[attr-defined]
            actions = [Expert(environment).action() for environment in (yellow, blue)]
            assert (actions[0][0] > 0) == rights[-1] != (actions[1][0] > 0)
    assert 17 <= sum(rights) <= 43


def test_the_first_touch_decides_between_named_balls() -> None:
    with make("touch-blue") as environment:
        scenario = environment.scenario
        assert isinstance(scenario, NamedBall)
        for first, last in ((0, 1), (1, 0)):
            environment.restart(7)
            assert not environment.advance(np.zeros(4)).success
            assert go_to(environment, scenario.placed[first].position) == (first == 1)
            assert scenario.touched == first
            assert go_to(environment, scenario.placed[last].position) == (first == 1)
            assert scenario.touched == first


def test_success_is_a_touch_of_five_centimetres() -> None:
    with make("stereo-reach") as environment:
        environment.restart(0)
        (ball,) = balls_of(environment)
        back = environment.fingertips() - ball.position
        back /= np.linalg.norm(back)
        assert not go_to(environment, ball.position + (TOUCH + 0.01) * back)
        assert environment.advance(np.zeros(4)).reward == pytest.approx(-0.06, abs=0.004)
        assert go_to(environment, ball.position + (TOUCH - 0.01) * back)


def test_the_first_ball_vanishes_and_only_then_the_second_counts() -> None:
    with make("two-stage") as environment:
        environment.restart(1)
        first, second = balls_of(environment)
        targets = environment.privileged_targets()
        rewards = [environment.advance(np.zeros(4)).reward]
        assert not go_to(environment, second.position)
        assert environment.scenario.balls() == (first, second)
        assert not go_to(environment, first.position)
        rewards.append(environment.advance(np.zeros(4)).reward)
        assert environment.scenario.balls() == (second,)
        pictures = environment.observe()["images"]
        assert all(len(coloured(picture, first)) == 0 for picture in pictures.values())
        assert any(len(coloured(picture, second)) > 4 for picture in pictures.values())
        np.testing.assert_array_equal(environment.privileged_targets(), targets)
        assert go_to(environment, second.position)
        rewards.append(environment.advance(np.zeros(4)).reward)
        assert rewards == sorted(rewards)
        environment.restart(1)
        assert len(environment.scenario.balls()) == 2


def test_one_picture_tells_a_direction_and_two_tell_the_place() -> None:
    """The best guess from position and size of the ball in the pictures, learnt from many layouts."""
    rng = np.random.default_rng(0)
    scenario = StereoReach(world=None)
    places = rng.uniform(*scenario.workspace, size=(60_000, 3))
    smallest, largest = np.log(scenario.RADII)
    radii = np.exp(rng.uniform(smallest, largest, size=len(places)))
    pictures = {}
    for camera in DEFAULT_CAMERAS:
        where, scale = seen_at(camera, places, 64)
        exact = np.column_stack([where, radii * scale])
        pictures[camera.name] = exact + rng.normal(0.0, 0.3, exact.shape)  # a third of a pixel

    def share_within_reach(*cameras: str) -> float:
        seen = np.hstack([pictures[name] for name in cameras])
        _, alike = cKDTree(seen[1000:]).query(seen[:1000], k=20)
        guess = places[1000:][alike].mean(axis=1)
        return float((np.linalg.norm(guess - places[:1000], axis=1) <= TOUCH).mean())

    for name in pictures:
        assert share_within_reach(name) < 0.6
    for pair in itertools.combinations(pictures, 2):
        assert share_within_reach(*pair) > 0.98


def test_a_larger_ball_further_away_looks_the_same_to_one_camera_only() -> None:
    camera = DEFAULT_CAMERAS[0]
    near = np.array([0.1, 0.68, 0.26])
    with make("stereo-reach") as environment:
        environment.restart(0)
        scenario = environment.scenario
        assert isinstance(scenario, StereoReach)
        eye, _ = eye_and_forward(camera)
        far = eye + 1.3 * (near - eye)
        low, high = scenario.workspace
        assert ((low <= far) & (far <= high)).all()
        assert np.linalg.norm(far - near) > 4 * TOUCH
        pictures = []
        for place, radius in ((near, 0.03), (far, 0.039)):
            scenario.placed = (Ball(place, radius, (0.1, 0.2, 1.0, 1.0)),)
            pictures.append(environment.observe()["images"])
    differ = {
        name: int((np.abs(pictures[0][name].astype(int) - pictures[1][name]).max(axis=2) > 60).sum())
        for name in pictures[0]
    }
    assert differ["left"] == 0
    assert differ["right"] > 20
    assert differ["top"] > 20


def test_a_blanked_camera_is_black_and_the_others_are_as_before() -> None:
    with make("stereo-reach") as whole, make("stereo-reach", blanked=["right", "top"]) as one:
        seen, _ = whole.reset(seed=0)
        less, _ = one.reset(seed=0)
        assert one.observation_space.contains(less)
    assert list(less["images"]) == list(seen["images"])
    np.testing.assert_array_equal(less["images"]["left"], seen["images"]["left"])
    assert less["images"]["right"].max() == less["images"]["top"].max() == 0
    assert seen["images"]["right"].max() > 0


@pytest.mark.parametrize("blanked", [["rear"], "left", ["left", "rear"]])
def test_blanking_what_is_no_camera_is_refused(blanked: Any) -> None:
    with pytest.raises(InputError, match=r"blanked: given .*expected names out of left, right, top"):
        TaskEnvironment("reach", blanked=blanked)


@pytest.mark.parametrize("task", NAMES)
def test_recordings_use_seeds_of_their_own(task: str, tmp_path: Path) -> None:
    settings = demos.RecordingSettings(image_size=16)
    demos.record_task(task, 2, tmp_path, settings, lambda: None)
    seeds = [seed for seed, _ in demos.episodes(tmp_path, task)]
    assert len(seeds) == 2
    assert set(seeds) <= set(DEMONSTRATION_SEEDS)
    with pytest.raises(InputError, match="evaluation seeds"):
        check_evaluation_seeds(seeds[0], 1)
    layouts = []
    with make(task, image_size=16) as environment:
        for seed, episode in demos.episodes(tmp_path, task):
            environment.restart(seed)
            layouts.append(environment.privileged_targets())
            np.testing.assert_array_equal(episode.targets, np.tile(layouts[-1], (len(episode.targets), 1)))
    assert not np.array_equal(layouts[0], layouts[1])


def test_demos_without_names_are_those_of_the_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded: dict[str, int] = {}
    monkeypatch.setattr(graphics, "check", lambda: None)
    monkeypatch.setattr(demos, "record_tasks", lambda counts, *_: recorded.update(counts))
    assert main(["demos", "--out", str(tmp_path)]) == 0
    assert recorded == dict(zip(SHIPPED, (300, 100, 100, 100, 100), strict=True))
    recorded.clear()
    assert main(["demos", "--out", str(tmp_path), "--tasks", "two-stage,two-goals"]) == 0
    assert list(recorded) == ["two-stage", "two-goals"]


@pytest.mark.parametrize("command", ["demos", "rollout"])
def test_help_names_both_kinds(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert "Tasks of the demo" in shown
    for name in TASKS:
        assert name in shown


def test_the_shipped_policy_says_that_it_does_not_know_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(graphics, "check", lambda: None)
    assert main(["rollout", "--tasks", "two-goals", "--out", str(tmp_path / "out")]) == 2
    assert "does not know two-goals" in capsys.readouterr().err
