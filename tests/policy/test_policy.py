"""A head in the robot's units is the head between the two halves of a normalizer."""

from __future__ import annotations

import functools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import saccade
from saccade import ActionHead, Normalizer, Policy
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from tests.helpers import layout_files
from tests.helpers.published import published

Array = NDArray[np.float32]
#: The layouts that bring statistics, and the id of the robot that they have in common.
EMBODIMENTS = {
    **dict.fromkeys(("nvidia", "isaac", "lerobot", "fork", "fork-split", "n1"), 31),
    **dict.fromkeys(("n16", "n17", "lerobot-n17"), 10),
}


@functools.cache
def load(layout: str) -> ActionHead:
    return ActionHead.from_pretrained(published(layout))


def draw(*shape: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def features(head: ActionHead, batch: int = 2) -> Array:
    return draw(batch, 5, head.config.context_dim)


def masks(head: ActionHead, batch: int = 2) -> dict[str, Any]:
    """The arguments of `encode` besides the features."""
    image = np.zeros((batch, 5), bool)
    image[:, 1:3] = True
    return {"image_mask": image} if head.config.mask_mode == "alternate" else {}


@pytest.mark.parametrize("layout", EMBODIMENTS)
def test_a_policy_is_the_head_between_the_normalizers_halves(layout: str) -> None:
    head = load(layout)
    policy = Policy(head, embodiment="new_embodiment")
    normalizer = Normalizer.from_pretrained(published(layout), "new_embodiment")
    state = draw(2, 7, seed=1)
    found = policy(features(head), state, seed=4, num_steps=2, **masks(head))
    context = head.encode(features(head), **masks(head))
    normalised = head.sample(context, normalizer.state(state), EMBODIMENTS[layout], seed=4, num_steps=2)
    horizon = normalizer.action_horizon or head.config.action_horizon
    assert policy.embodiment_id == EMBODIMENTS[layout]
    assert found.shape == (2, horizon, 6)
    assert np.array_equal(found, normalizer.actions(normalised))
    assert np.array_equal(policy.sample(context, state[:, None], seed=4, num_steps=2), found)
    samples = policy.sample(context, state, seed=4, num_steps=2, num_samples=3)
    assert samples.shape == (2, 3, horizon, 6)


def test_frozen_actions_stay_beyond_the_statistics_too() -> None:
    head = load("lerobot-n17")
    policy = Policy(head, embodiment="new_embodiment")
    context = head.encode(features(head), **masks(head))
    within = np.asarray(policy.normalizer.actions(np.ones((2, 40, head.config.action_dim), np.float32)))
    before = 3 * within + 1
    chunking = saccade.Chunking(overlap=9, frozen=4)
    after = policy.sample(context, draw(2, 7), seed=1, previous_chunk=before, chunking=chunking)
    rows = before.shape[1]
    moving = ~np.isclose(
        policy.normalizer.actions(np.zeros((1, 40, head.config.action_dim), np.float32))[0, 0], within[0, 0]
    )
    assert moving.any()
    frozen, taken = np.asarray(after)[:, :4], before[:, rows - 9 : rows - 5]
    assert np.allclose(frozen[..., moving], taken[..., moving], rtol=1e-5)


@pytest.mark.parametrize("layout", ["lerobot", "fork", "n17"])
def test_a_chunk_goes_on_where_the_last_one_is(layout: str) -> None:
    head = load(layout)
    policy = Policy(head, embodiment="new_embodiment")
    context = head.encode(features(head), **masks(head))
    rows = policy.normalizer.action_horizon or head.config.action_horizon
    width = policy.normalizer.action_width
    first, second = draw(2, 7, seed=1), draw(2, 7, seed=2)
    # Within the range of the statistics, where nothing is cut off.
    before = np.asarray(policy.normalizer.actions(np.random.default_rng(0).uniform(-1, 1, (2, rows, 8))))
    chunking = saccade.Chunking(overlap=9, frozen=4)
    after = policy.sample(context, second, seed=1, previous_chunk=before, chunking=chunking)
    assert np.allclose(np.asarray(after)[:, :4], before[:, rows - 9 : rows - 5], atol=1e-5)
    free = policy.sample(context, second, seed=1)
    assert not np.allclose(np.asarray(after)[:, 4:], np.asarray(free)[:, 4:], atol=1e-3)
    # The head's own rule, on what the normalizer makes of the chunk.
    normalised = np.zeros((2, rows, head.config.encoder_action_dim), np.float32)
    normalised[..., :width] = np.asarray(policy.normalizer.normalize_actions(before))[..., :width]
    expected = head.sample(
        context,
        policy.normalizer.state(second),
        policy.embodiment_id,
        seed=1,
        previous_chunk=normalised,
        chunking=saccade.Chunking(overlap=9, frozen=4, horizon=rows),
    )
    assert np.array_equal(after, policy.normalizer.actions(expected))
    with pytest.raises(saccade.InputError, match="both or neither"):
        policy.sample(context, first, previous_chunk=before)
    with pytest.raises(saccade.ShapeError, match="previous_chunk"):
        policy.sample(context, first, previous_chunk=before[:, 1:], chunking=chunking)


def test_what_is_relative_to_the_state_stays_where_it_is_in_the_room(tmp_path: Path) -> None:
    """The last chunk was relative to an older state: the robot's units tell what that is now."""
    shutil.copytree(published("n17"), tmp_path, dirs_exist_ok=True)
    relative = {"rep": "RELATIVE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
    config = json.loads((tmp_path / "processor_config.json").read_text())
    kwargs = config["processor_kwargs"]
    kwargs["use_relative_action"] = True
    kwargs["modality_configs"]["new_embodiment"]["action"]["action_configs"] = [
        relative,
        {**relative, "rep": "ABSOLUTE"},
    ]
    layout_files.write_json(tmp_path / "processor_config.json", config)
    statistics = json.loads((tmp_path / "statistics.json").read_text())
    statistics["new_embodiment"]["relative_action"] = {"arm": {"min": [-3.0] * 5, "max": [3.0] * 5}}
    layout_files.write_json(tmp_path / "statistics.json", statistics)
    head = load("n17")
    policy = Policy(head, tmp_path, "new_embodiment")
    context = head.encode(features(head), **masks(head))
    older, newer = draw(2, 7, seed=1), draw(2, 7, seed=2)
    before = np.asarray(policy.sample(context, older, seed=0))
    chunking = saccade.Chunking(overlap=8, frozen=8)
    after = np.asarray(policy.sample(context, newer, seed=1, previous_chunk=before, chunking=chunking))
    # Values further than 3 from the newer state are beyond the statistics, and are clipped as in training.
    near = np.abs(before[:, 8:, :5] - newer[:, None, :5]) < 3
    assert near.mean() > 0.5
    assert np.allclose(after[:, :8, :5][near], before[:, 8:, :5][near], atol=1e-5)


def test_torch_in_torch_out() -> None:
    head = load("lerobot")
    policy, state = Policy(head), draw(2, 7, seed=1)
    expected = policy(features(head), state, seed=4, num_steps=1)
    found = policy(torch.from_numpy(features(head)), torch.from_numpy(state), seed=4, num_steps=1)
    assert isinstance(found, torch.Tensor)
    assert np.array_equal(found.numpy(), expected)


def test_the_demo_policy() -> None:
    head = ActionHead.from_pretrained(DEMO_CHECKPOINT)
    actions = Policy(head)(draw(1, 57, head.config.context_dim), draw(1, 4), seed=0)
    assert actions.shape == (1, 16, 4)


def statistics(state: int, action: int) -> dict[str, Any]:
    return {
        "state": {"min": [0.0] * state, "max": [1.0] * state},
        "action": {"min": [0.0] * action, "max": [1.0] * action},
    }


def test_which_embodiment_is_meant() -> None:
    head = load("nvidia")
    with pytest.raises(saccade.InputError, match=r"embodiment: expected one of those in .*got None"):
        Policy(head)
    assert Policy(head, embodiment=31).normalizer.embodiment == "new_embodiment"
    assert Policy(head, statistics(7, 6), 9).embodiment_id == 9
    assert Policy(head, Normalizer.from_pretrained(statistics(7, 6), state_dim=12), 9).embodiment_id == 9
    with pytest.raises(saccade.InputError, match=r"files do not say .*: pass its id, one of 0, 1"):
        Policy(head, statistics(7, 6))
    with pytest.raises(saccade.InputError, match="got 40"):
        Policy(head, statistics(7, 6), 40)
    read = Normalizer.from_pretrained(published("nvidia"), "new_embodiment")
    for name in ("new_embodiment", "NEW_EMBODIMENT"):
        assert Policy(head, read, name).embodiment_id == 31
    for other in ("oxe_droid", 17):
        with pytest.raises(saccade.InputError, match="embodiment: expected that of the normalizer"):
            Policy(head, read, other)
    one = ActionHead.from_pretrained(published("isaac"), embodiment_ids=[3])
    assert Policy(one, statistics(7, 6)).embodiment_id == 3
    with pytest.raises(saccade.InputError, match=r"one of the head's embodiments \(3\), got 31"):
        Policy(one)


def test_statistics_of_another_head() -> None:
    head = load("nvidia")
    with pytest.raises(saccade.InputError, match=r"normalizer: .*got states of width 7"):
        Policy(head, Normalizer.from_pretrained(statistics(7, 6)), 3)
    with pytest.raises(saccade.InputError, match=r"actions of at most width 8, .* actions of width 9"):
        Policy(head, Normalizer.from_pretrained(statistics(7, 9), state_dim=12), 3)
    with pytest.raises(saccade.CheckpointError, match="9 numbers, the head's only 8"):
        Policy(head, statistics(7, 9), 3)


def test_arguments_that_do_not_fit() -> None:
    head = load("lerobot")
    policy = Policy(head)
    given = features(head)
    with pytest.raises(saccade.ShapeError, match="the Normalizer of 'new_embodiment' expected"):
        policy(given, draw(2, 12))
    with pytest.raises(saccade.ShapeError, match=r"state: .*as the checkpoint's normaliser does, got"):
        head(given, draw(2, 7), 31)
    with pytest.raises(TypeError, match="out"):  # it would contain the normalised actions of the head
        policy(given, draw(2, 7), out=np.empty((2, 16, 8), np.float32))  # type: ignore[call-arg]
    chunk: Any = {"overlap": 2, "frozen": 1}
    with pytest.raises(saccade.InputError, match=r"chunking: expected a saccade\.Chunking, got dict"):
        policy(given, draw(2, 7), previous_chunk=policy(given, draw(2, 7)), chunking=chunk)


def test_it_says_what_it_is() -> None:
    assert "embodiment_id=31" in repr(Policy(load("lerobot")))
