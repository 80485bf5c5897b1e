"""What each task made for studies asks: its layouts, what counts as a success, which cameras it takes."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from saccade import InputError
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.experts import Expert
from saccade_lab.sim.scenarios import TOUCH, Ball, Fork, NamedBall, StereoReach, TwoGoals
from tests.helpers.ball_cases import balls_of, coloured, eye_and_forward, go_to, make, seen_at


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
