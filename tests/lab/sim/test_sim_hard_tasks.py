"""All tasks made for studies alike: their names, experts, seeds, pictures and recordings."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import saccade_lab.sim  # noqa: F401  (registers the environments)
from saccade import InputError
from saccade.cli import main
from saccade_lab.sim import demos, graphics
from saccade_lab.sim.cameras import DEFAULT_CAMERAS, DEFAULT_IMAGE_SIZE
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.experts import Expert
from saccade_lab.sim.tasks import DEMO_TASKS, DEMONSTRATION_SEEDS, STUDY_TASKS, TASKS, check_evaluation_seeds
from tests.helpers.ball_cases import balls_of, coloured, go_to, make, seen_at

NAMES = ("two-goals", "stereo-reach", "two-stage", "fork", "touch-yellow", "touch-blue")
SHIPPED = ("reach", "push", "drawer-open", "button-press-topdown", "window-open")


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


@pytest.mark.parametrize("task", NAMES)
def test_recordings_use_seeds_of_their_own(task: str, tmp_path: Path) -> None:
    settings = demos.RecordingSettings(image_size=16)
    demos.record_tasks({task: 2}, tmp_path, settings, lambda task: None)
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
