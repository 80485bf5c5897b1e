"""Words count: where the object that an instruction names is not there, nothing is done."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from saccade.sim import demos, train
from saccade.sim.dataset import Samples, statistics
from saccade.sim.instructions import Tokenizer
from saccade.sim.policy import Policy
from saccade.sim.rollout import environment_for, run_episode
from saccade.sim.tasks import TASKS
from saccade.sim.training_settings import TrainingSettings

FRAMES, HORIZON = 40, 4


def make_batches(tasks: list[str], absent_share: float) -> tuple[train.Batches, Tokenizer]:
    """Batches of random samples of the tasks."""
    rng = np.random.default_rng(0)
    numbers = [list(TASKS).index(task) for task in tasks]
    recording = demos.RecordingSettings(image_size=16)
    samples = Samples(
        images=rng.integers(256, size=(FRAMES, len(recording.cameras), 16, 16, 3), dtype=np.uint8),
        now=np.arange(FRAMES),
        later=np.arange(FRAMES),
        state=rng.standard_normal((FRAMES, 4), dtype=np.float32),
        targets=rng.standard_normal((FRAMES, 6), dtype=np.float32),
        actions=rng.uniform(0.2, 1.0, size=(FRAMES, HORIZON, 4)).astype(np.float32),
        mask=np.ones((FRAMES, HORIZON, 1), np.float32),
        tasks=rng.choice(numbers, size=FRAMES),
    )
    found = statistics(samples)
    settings = TrainingSettings(horizon=HORIZON, execute_steps=2, patch_size=8)
    config = train.policy_config(settings, recording, tasks, found)
    batches = train.Batches(samples, config, found["targets"], 64, absent_share)
    return batches, Tokenizer(config.vocabulary, config.backbone.text_length)


def tasks_told(words: np.ndarray, tokenizer: Tokenizer) -> list[str]:
    """The task of each row of word numbers."""
    wordings = {tuple(tokenizer(text)): name for name, task in TASKS.items() for text in task.instructions}
    return [wordings[tuple(row)] for row in words]


def test_a_task_that_is_not_there_is_shown_as_standing_still() -> None:
    batches, tokenizer = make_batches(list(TASKS), absent_share=1.0)
    plain, _ = make_batches(list(TASKS), absent_share=0.0)
    told = tasks_told(batches.draw(3)["words"].numpy(), tokenizer)
    shown = tasks_told(plain.draw(3)["words"].numpy(), tokenizer)
    assert set(told) == set(TASKS)
    for one, other in zip(told, shown, strict=True):
        assert TASKS[one].objects != TASKS[other].objects
    actions = batches.draw(3)["actions"]
    assert (actions == actions[0, 0]).all()  # zero velocity, normalised
    assert not (plain.draw(3)["actions"] == actions[0, 0]).all(-1).any()


@pytest.mark.parametrize("tasks", [["reach"], ["reach", "push"]])
def test_tasks_of_one_scene_are_never_told_as_absent(tasks: list[str]) -> None:
    batches, _ = make_batches(tasks, absent_share=1.0)
    plain, _ = make_batches(tasks, absent_share=0.0)
    np.testing.assert_array_equal(batches.draw(1)["actions"], plain.draw(1)["actions"])


def test_drawing_does_not_change_the_samples() -> None:
    batches, _ = make_batches(list(TASKS), absent_share=0.5)
    first = {name: tensor.clone() for name, tensor in batches.draw(7).items()}
    for key in range(10):
        batches.draw(key)
    for name, tensor in batches.draw(7).items():
        np.testing.assert_array_equal(tensor, first[name])


@pytest.mark.parametrize(
    ("task", "other"), [("drawer-open", "button-press-topdown"), ("window-open", "push"), ("push", "reach")]
)
def test_the_shipped_policy_fails_when_told_another_task(task: str, other: str) -> None:
    policy = Policy.load(num_threads=1)
    with contextlib.closing(environment_for(policy, task)) as environment:
        assert not run_episode(environment, policy, 0, instruction_from=other).success
