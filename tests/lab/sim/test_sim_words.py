"""Words count: where the object that an instruction names is not there, nothing is done."""

from __future__ import annotations

import contextlib
import re

import numpy as np
import pytest
import torch

from saccade.processor import Processor
from saccade_lab.reference import Backbone
from saccade_lab.reference.backbone import BackboneFeatures, PreparedInputs
from saccade_lab.sim import demos
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.sim.tasks import TASKS
from saccade_lab.training import train
from saccade_lab.training.batches import Batches, prompts_of
from saccade_lab.training.dataset import Samples
from saccade_lab.training.graphs import tensors_of
from saccade_lab.training.settings import TrainingSettings

FRAMES, HORIZON = 40, 4
DEFAULT = "Perform the default behavior."  # Isaac-GR00T N1.5, where there is no instruction


def make_batches(
    tasks: list[str], absent_share: float, language_dropout: float = 0.0
) -> tuple[Batches, Processor]:
    """Batches of random samples of the tasks, and what prepares their words."""
    rng = np.random.default_rng(0)
    numbers = [list(TASKS).index(task) for task in tasks]
    recording = demos.RecordingSettings(image_size=16)
    samples = Samples(
        images=rng.integers(256, size=(FRAMES, len(recording.cameras), 3, 16, 16), dtype=np.uint8),
        now=np.arange(FRAMES),
        later=np.arange(FRAMES),
        state=rng.standard_normal((FRAMES, 4), dtype=np.float32),
        targets=rng.standard_normal((FRAMES, 6), dtype=np.float32),
        actions=rng.uniform(0.2, 1.0, size=(FRAMES, HORIZON, 4)).astype(np.float32),
        mask=np.ones((FRAMES, HORIZON, 1), np.float32),
        tasks=rng.choice(numbers, size=FRAMES),
    )
    settings = TrainingSettings(horizon=HORIZON, execute_steps=2, patch_size=8)
    config = train.with_statistics(train.policy_config(settings, recording, tasks), samples)
    processor = config.processor()
    targets = np.zeros(6, np.float32), np.ones(6, np.float32)
    prompts = prompts_of(config, processor)
    batches = Batches(
        samples,
        config,
        Backbone(config.backbone_sizes),
        prompts,
        targets,
        64,
        absent_share=absent_share,
        language_dropout=language_dropout,
    )
    return batches, processor


def tasks_told(inputs: PreparedInputs | BackboneFeatures, processor: Processor) -> list[str]:
    """The task of each prompt."""
    assert isinstance(inputs, PreparedInputs)
    frames = [np.zeros((16, 16, 3), np.uint8)] * 3
    wordings = {
        tuple(processor(frames, text).input_ids[0]): name
        for name, task in TASKS.items()
        for text in task.instructions
    } | {tuple(processor(frames, DEFAULT).input_ids[0]): DEFAULT}
    prompts = zip(inputs.input_ids, inputs.attention_mask, strict=True)
    return [wordings[tuple(prompt[mask].tolist())] for prompt, mask in prompts]


def test_a_task_that_is_not_there_is_shown_as_standing_still() -> None:
    batches, processor = make_batches(list(TASKS), absent_share=1.0)
    plain, _ = make_batches(list(TASKS), absent_share=0.0)
    told = tasks_told(batches.draw(3).inputs, processor)
    shown = tasks_told(plain.draw(3).inputs, processor)
    assert set(told) == set(TASKS)
    for one, other in zip(told, shown, strict=True):
        assert TASKS[one].objects != TASKS[other].objects
    actions = batches.draw(3).actions
    assert (actions == actions[0, 0]).all()  # zero velocity, normalised
    assert not (plain.draw(3).actions == actions[0, 0]).all(-1).any()


@pytest.mark.parametrize("tasks", [["reach"], ["reach", "push"]])
def test_tasks_of_one_scene_are_never_told_as_absent(tasks: list[str]) -> None:
    batches, _ = make_batches(tasks, absent_share=1.0)
    plain, _ = make_batches(tasks, absent_share=0.0)
    np.testing.assert_array_equal(batches.draw(1).actions, plain.draw(1).actions)


def test_dropped_words_are_the_released_default_and_nothing_else_changes() -> None:
    plain, processor = make_batches(["reach", "push"], absent_share=0.0)
    dropped, _ = make_batches(["reach", "push"], absent_share=0.0, language_dropout=0.5)
    before, after = plain.draw(2), dropped.draw(2)
    told = tasks_told(after.inputs, processor)
    assert 16 <= told.count(DEFAULT) <= 48  # of 64: less than one in ten thousand such batches is outside
    for one, other in zip(told, tasks_told(before.inputs, processor), strict=True):
        assert one in (DEFAULT, other)
    for name in ("state", "actions", "mask", "targets"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_an_absent_task_is_always_told() -> None:
    batches, processor = make_batches(list(TASKS), absent_share=1.0, language_dropout=0.9)
    assert DEFAULT not in tasks_told(batches.draw(3).inputs, processor)


def test_drawing_does_not_change_the_samples() -> None:
    batches, _ = make_batches(list(TASKS), absent_share=0.5)
    first = batches.draw(7)
    for key in range(10):
        batches.draw(key)
    again = batches.draw(7)
    for name in ("state", "actions", "mask", "targets"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name))
    for one, other in zip(tensors_of(again.inputs), tensors_of(first.inputs), strict=True):
        assert torch.equal(one, other)


def test_every_word_of_the_instructions_is_one_token() -> None:
    _, processor = make_batches(list(TASKS), absent_share=0.0)
    for task in TASKS.values():
        for text in task.instructions:
            words = re.findall("[a-z]+|[^a-z ]", text)
            assert len(processor.tokens(text)) == len(words), text


@pytest.mark.parametrize(
    ("task", "other"), [("drawer-open", "button-press-topdown"), ("window-open", "push"), ("push", "reach")]
)
def test_the_shipped_policy_fails_when_told_another_task(task: str, other: str) -> None:
    policy = Policy.from_pretrained(num_threads=1)
    with contextlib.closing(environment_for(policy, task)) as environment:
        assert not run_episode(environment, policy, 0, instruction_from=other).success
