"""What is recorded for maps: attention against the reference, summaries by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

import saccade
from saccade import Intervention
from saccade.checkpoints import read_tensors
from saccade_lab.maps import record
from saccade_lab.maps.view import View
from saccade_lab.reference import ActionHead as ReferenceHead
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from tests.helpers.maps_cases import demo_head, one_hot_maps, pushed_view

torch.set_num_threads(1)


@pytest.fixture
def head() -> saccade.ActionHead:
    return demo_head()


@pytest.fixture
def pushed() -> View:
    return pushed_view()


def test_maps_are_those_of_the_reference(head: saccade.ActionHead, pushed: View) -> None:
    selection = record.Selection(blocks=(0, 3), steps=(1,), heads=(0, 2), shown_heads=())
    rows, attention = record.attention_maps(head, pushed, selection)
    assert rows == {"state": slice(0, 1), "future": slice(1, 33), "action": slice(33, 49)}
    assert list(attention) == [(1, 0), (1, 3)]
    assert pushed.observation.noise is not None
    reference = ReferenceHead.from_pretrained(DEMO_CHECKPOINT, dtype=torch.float64)
    tokens = record.random_tokens(head.future_tokens, seed=4)
    other = record.redrawn_maps(head, pushed, selection, tokens)
    for intervention, found in ((None, attention), (Intervention(future_tokens=tokens), other)):
        with torch.no_grad():
            expected = reference.trace(
                reference.encode(torch.from_numpy(pushed.observation.backbone_features.astype(np.float64))),
                torch.from_numpy(pushed.observation.state.astype(np.float64)),
                torch.tensor([0]),
                noise=torch.from_numpy(pushed.observation.noise.astype(np.float64)),
                intervention=intervention,
            ).attention
        for place, maps in found.items():
            whole = expected[place][0, [0, 2]].numpy()
            kept = whole if intervention is None else whole[:, 1:33]
            np.testing.assert_allclose(maps, kept, atol=1e-5)


def test_random_tokens_have_the_lengths_of_the_learned_ones() -> None:
    learned = read_tensors(DEMO_CHECKPOINT, "action_head.future_tokens.")["weight"]
    drawn = record.random_tokens(learned, seed=0)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), np.linalg.norm(learned, axis=1), rtol=1e-5)
    assert np.abs((drawn * learned).sum(axis=1)).max() < 0.6 * np.square(learned).sum(axis=1).min()
    np.testing.assert_array_equal(drawn, record.random_tokens(learned, seed=0))


def test_summaries_of_maps_made_by_hand() -> None:
    maps = one_hot_maps()
    found = {(e["block"], e["group"], e["head"]): e for e in maps.summaries if e["step"] == 1}
    assert set(found) == {
        (block, group, head)
        for block in (0, 1)
        for group in ("state", "future", "action")
        for head in ("mean", 0, 1)
    }
    # Head 0: every future token on a patch of its own; head 1: all of them on the special token.
    own, shared = found[0, "future", 0], found[0, "future", 1]
    assert own["overlap"] == {"jensen_shannon": 1.0, "cosine": 0.0, "distinct": pytest.approx(3.0)}
    assert own["mass"] == {
        "left": pytest.approx(1 / 3),
        "top": pytest.approx(2 / 3),
        "text": 0.0,
        "special": 0.0,
    }
    assert shared["overlap"] == {"jensen_shannon": 0.0, "cosine": 1.0, "distinct": 1.0}
    assert shared["mass"]["special"] == 1.0
    mean = found[0, "future", "mean"]
    assert mean["mass"]["special"] == 0.5
    assert mean["entropy"]["mean"] == pytest.approx(math.log(2))
    assert mean["per_head"]["entropy"] == 0.0
    assert mean["per_head"]["overlap"]["distinct"] == pytest.approx(2.0)
    assert mean["per_head"]["redrawn"]["distinct"] == pytest.approx(1.0)
    assert found[0, "state", "mean"]["overlap"] is None
    assert found[1, "action", 0]["reads"] == "rows"
    assert found[1, "action", 0]["mass"] == pytest.approx({"state": 1 / 6, "future": 3 / 6, "action": 2 / 6})


def test_agreement_is_the_rank_correlation_over_patches() -> None:
    maps = one_hot_maps()  # occlusion: 0, 1, 0, 0 and 0, 0, 0.25 of the patches at positions 1 to 7
    keys = np.array([9, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 9], np.float32)
    expected = spearmanr(keys[1:8], [0, 1, 0, 0, 0, 0, 0.25]).statistic
    assert maps.agreement(keys) == pytest.approx(expected)
    assert maps.agreement(np.square(keys)) == pytest.approx(expected)
    assert maps.agreement(np.ones(9, np.float32)) is None
    found = {(entry["block"], entry["group"]): entry["rank_correlation"] for entry in maps.agreements()}
    assert list(found) == [(0, "state"), (0, "future"), (0, "action")]
    assert found[0, "state"] is None
