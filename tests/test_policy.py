"""A head in the robot's units is the head between the two halves of a normalizer."""

from __future__ import annotations

import functools
from typing import Any

import layouts
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from published import published

import saccade
from saccade import ActionHead, Normalizer, Policy
from saccade.sim.policy import DEMO_CHECKPOINT

Array = NDArray[np.float32]
#: What a small head of each layout needs to be told, and the id that the statistics have for it.
EMBODIMENTS = {"nvidia": 31, "isaac": 31, "lerobot": 31}


@functools.cache
def load(layout: str) -> ActionHead:
    folder = published(layout)
    return ActionHead.load(folder, config={"action_head_cfg": layouts.head_config(layout)})


def draw(*shape: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def features(head: ActionHead, batch: int = 2) -> Array:
    return draw(batch, 5, head.config.context_dim)


@pytest.mark.parametrize("layout", EMBODIMENTS)
def test_a_policy_is_the_head_between_the_normalizers_halves(layout: str) -> None:
    head = load(layout)
    policy = Policy(head, embodiment="new_embodiment")
    normalizer = Normalizer.load(published(layout), "new_embodiment")
    state = draw(2, 7, seed=1)
    found = policy(features(head), state, seed=4, num_steps=2)
    normalised = head(features(head), normalizer.state(state), EMBODIMENTS[layout], seed=4, num_steps=2)
    assert policy.embodiment_id == EMBODIMENTS[layout]
    assert found.shape == (2, head.config.action_horizon, 6)
    assert np.array_equal(found, normalizer.actions(normalised))
    context = head.encode(features(head))
    assert np.array_equal(policy.sample(context, state[:, None], seed=4, num_steps=2), found)
    samples = policy.sample(context, state, seed=4, num_steps=2, num_samples=3)
    assert samples.shape == (2, 3, head.config.action_horizon, 6)


def test_torch_in_torch_out() -> None:
    head = load("lerobot")
    policy, state = Policy(head), draw(2, 7, seed=1)
    expected = policy(features(head), state, seed=4, num_steps=1)
    found = policy(torch.from_numpy(features(head)), torch.from_numpy(state), seed=4, num_steps=1)
    assert isinstance(found, torch.Tensor)
    assert np.array_equal(found.numpy(), expected)


def test_the_demo_policy() -> None:
    head = ActionHead.load(DEMO_CHECKPOINT)
    actions = Policy(head)(draw(1, 57, head.config.context_dim), draw(1, 4), seed=0)
    assert actions.shape == (1, 16, 4)


def statistics(state: int, action: int) -> dict[str, Any]:
    return {
        "state": {"min": [0.0] * state, "max": [1.0] * state},
        "action": {"min": [0.0] * action, "max": [1.0] * action},
    }


def test_which_embodiment_is_meant() -> None:
    head = load("nvidia")
    with pytest.raises(saccade.InputError, match="embodiment: given None"):
        Policy(head)
    assert Policy(head, embodiment=24).normalizer.embodiment == "gr1"
    assert Policy(head, statistics(7, 6), 9).embodiment_id == 9
    assert Policy(head, Normalizer.load(statistics(7, 6), state_dim=12), 9).embodiment_id == 9
    with pytest.raises(saccade.InputError, match="got nothing that says which"):
        Policy(head, statistics(7, 6))
    with pytest.raises(saccade.InputError, match="got 40"):
        Policy(head, statistics(7, 6), 40)
    read = Normalizer.load(published("nvidia"), "gr1")
    assert Policy(head, read, "gr1").embodiment_id == 24
    for other in ("oxe_droid", 17):
        with pytest.raises(saccade.InputError, match="embodiment: given"):
            Policy(head, read, other)
    one = ActionHead.load(
        published("isaac"), config={"action_head_cfg": layouts.head_config("isaac")}, embodiment_ids=[3]
    )
    assert Policy(one, statistics(7, 6)).embodiment_id == 3
    with pytest.raises(saccade.InputError, match=r"one of the head's embodiments \(3\), got 31"):
        Policy(one)


def test_statistics_of_another_head() -> None:
    head = load("nvidia")
    with pytest.raises(saccade.InputError, match="normalizer: gives states of 7"):
        Policy(head, Normalizer.load(statistics(7, 6)), 3)
    with pytest.raises(saccade.InputError, match="gives 8 numbers an action"):
        Policy(head, Normalizer.load(statistics(7, 9), state_dim=12), 3)
    with pytest.raises(saccade.CheckpointError, match="9 numbers, the head's only 8"):
        Policy(head, statistics(7, 9), 3)


def test_arguments_that_do_not_fit() -> None:
    policy = Policy(load("lerobot"))
    given = features(policy.head)
    with pytest.raises(saccade.ShapeError, match="the Normalizer of 'new_embodiment' expected"):
        policy(given, draw(2, 12))
    with pytest.raises(saccade.InputError, match="out: expected none"):
        policy(given, draw(2, 7), out=np.empty((2, 16, 8), np.float32))


def test_it_says_what_it_is() -> None:
    assert "embodiment_id=31" in repr(Policy(load("lerobot")))
