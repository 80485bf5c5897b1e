"""Guidance of whole policies: what stands in place of the words, what is computed once, what is refused."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import BackboneInputs, InputError, Intervention, Policy
from tests.helpers import whole_checkpoints
from tests.helpers.policy_cases import noise, with_parts
from tests.helpers.whole_checkpoints import EMBODIMENT, whole

Observation = dict[str, Any]

#: Layouts in which an observation may come without an instruction, and those whose empty text is one.
WITH_DEFAULT = ("nvidia", "isaac", "lerobot", "lerobot-n17")
WITH_EMPTY = ("nvidia", "isaac", "n16", "n17")
MEANINGS = [
    *((layout, "default") for layout in WITH_DEFAULT),
    *((layout, "empty") for layout in WITH_EMPTY),
]


@functools.cache
def load(layout: str) -> Any:
    return Policy.from_pretrained(whole(layout), embodiment=EMBODIMENT, num_threads=1)


def told(policy: Policy, text: str | None = "push the button", seed: int = 0) -> Observation:
    """An example observation with this instruction, or without the key of one."""
    example = policy.example_observation(seed)
    if text is None:
        return {key: value for key, value in example.items() if key != "language"}
    return example | {"language": {key: [[text]] for key in example["language"]}}


def same(found: Any, expected: Any) -> bool:
    assert found.keys() == expected.keys()
    return all(np.array_equal(found[key], expected[key]) for key in expected)


class Counted:
    """A backbone that notes what it is asked to encode."""

    def __init__(self, backbone: saccade.Backbone) -> None:
        self._backbone, self.nbytes = backbone, backbone.nbytes
        self.calls: list[tuple[int, list[Any]]] = []

    def encode_many(self, inputs: Sequence[BackboneInputs], *, previous: Sequence[Any] = ()) -> list[Any]:
        self.calls.append((len(inputs), list(previous)))
        return self._backbone.encode_many(inputs, previous=previous)


@pytest.mark.parametrize(("layout", "without"), MEANINGS)
def test_without_is_the_observation_without_its_words(layout: str, without: Any) -> None:
    policy = load(layout)
    observation = told(policy)
    found = policy.encode(observation, without=without)
    assert found.without is not None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no instruction
        bare = policy.encode(told(policy, None if without == "default" else ""))
    assert np.array_equal(found.without.context.vl_embs, bare.context.vl_embs)
    assert found.without.num_vl_tokens == bare.num_vl_tokens
    plain = policy.encode(observation)
    assert plain.without is None
    assert np.array_equal(found.context.vl_embs, plain.context.vl_embs)
    state = policy.normalizer.state(
        np.concatenate([observation["state"][key] for key in policy.normalizer.state_slices], axis=-1)
    )
    by_head = policy.head.sample(
        plain.context,
        state,
        policy.embodiment_id,
        noise=noise(policy),
        guidance=2.5,
        without=bare.context,
    )
    actions = policy.sample(found, observation, noise=noise(policy), guidance=2.5)
    again = policy.act(observation, noise=noise(policy), guidance=2.5, without=without)
    assert same(actions, again)
    raw = np.concatenate([observation["state"][key] for key in policy.normalizer.state_slices], axis=-1)
    expected = np.asarray(policy.normalizer.actions(by_head, raw))
    for key, where in policy.normalizer.action_slices.items():
        assert np.array_equal(actions[key], expected[..., where])
    assert not same(actions, policy.act(observation, noise=noise(policy)))


def test_the_two_meanings_differ() -> None:
    policy = load("nvidia")
    kinds: list[Any] = ["default", "empty"]
    chunks = [
        policy.act(told(policy), noise=noise(policy), guidance=2.0, without=without) for without in kinds
    ]
    assert not same(*chunks)
    assert same(policy.act(told(policy), noise=noise(policy), guidance=2.0), chunks[0])


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_a_weight_of_one_has_the_bits_of_no_guidance_and_costs_nothing(layout: str) -> None:
    policy = load(layout)
    counted = Counted(policy.backbone)
    observed = with_parts(policy, backbone=counted)
    plain = policy.act(told(policy), noise=noise(policy))
    for options in ({"guidance": 1}, {"guidance": 1.0, "without": "empty"}, {"guidance": None}):
        assert same(observed.act(told(policy), noise=noise(policy), **options), plain)
    assert counted.calls == [(1, [])] * 3
    context = policy.encode(told(policy))
    assert same(policy.sample(context, told(policy), noise=noise(policy), guidance=1), plain)


def test_the_second_context_takes_views_and_prompt_from_the_first() -> None:
    policy = load("nvidia")
    counted = Counted(policy.backbone)
    observed = with_parts(policy, backbone=counted)
    first = observed.encode(told(policy), without="default")
    assert first.without is not None
    assert [count for count, _ in counted.calls] == [1, 1]
    assert counted.calls[1][1] == list(first.features)
    second = observed.encode(told(policy, "open the drawer", seed=1), previous=first, without="default")
    assert counted.calls[2][1] == list(first.features)
    assert counted.calls[3][1] == [*second.features, *first.without.features]
    # In the engine's own call too, and with the bits of no reuse.
    for previous in (None, policy.encode(told(policy, seed=1), without="empty")):
        found = policy.encode(told(policy, "lift", seed=1), previous=previous, without="default")
        expected = observed.encode(told(policy, "lift", seed=1), without="default")
        assert found.without is not None
        assert expected.without is not None
        for one, other in ((found, expected), (found.without, expected.without)):
            assert np.array_equal(one.context.vl_embs, other.context.vl_embs)


@pytest.mark.parametrize("layout", ["nvidia", "n17", "lerobot"])
def test_each_has_the_bits_that_it_has_alone(layout: str) -> None:
    policy, without = load(layout), "empty" if layout == "n17" else "default"
    texts = ("push", "pick up the red block and put it behind the mug", "open the drawer")
    observations = [told(policy, text, seed) for seed, text in enumerate(texts)]
    start = noise(policy, 3)
    options: Any = {"guidance": 3.0, "without": without}
    together = policy.act(observations, noise=start, **options)
    for row, observation in enumerate(observations):
        assert same(together[row], policy.act(observation, noise=start[row : row + 1], **options))


def test_it_composes_with_chunks_samples_and_interventions() -> None:
    policy = load("nvidia")
    observation = told(policy)
    context = policy.encode(observation, without="default")
    sample = functools.partial(policy.sample, context, observation, guidance=2.0)
    before = sample(seed=1)
    chunking = saccade.Chunking(overlap=4, frozen=2)
    after = sample(seed=2, previous_chunk=before, chunking=chunking)
    for key, chunk in after.items():
        horizon = chunk.shape[1]
        np.testing.assert_allclose(
            chunk[:, :2], before[key][:, horizon - 4 : horizon - 2], rtol=1e-5, atol=1e-6
        )
    several = sample(seed=3, num_samples=2, integrator="midpoint", future_refresh=2)
    assert all(chunk.shape[:2] == (1, 2) for chunk in several.values())
    deaf = Intervention(cut=[(rows, "vl") for rows in ("state", "future", "action")])
    assert same(
        sample(seed=4, intervention=deaf), policy.sample(context, observation, seed=4, intervention=deaf)
    )


@pytest.mark.parametrize("layout", ["n16", "n17"])
def test_a_release_without_a_default_says_so(layout: str) -> None:
    policy = load(layout)
    message = r"^without='default': instruction: .*has no default"
    with pytest.raises(InputError, match=message):
        policy.act(told(policy), guidance=2.0)
    with pytest.raises(InputError, match=message):
        policy.encode(told(policy), without="default")


@pytest.mark.parametrize("layout", ["lerobot", "lerobot-n17"])
def test_lerobot_has_no_empty_instruction(layout: str) -> None:
    policy = load(layout)
    with pytest.raises(InputError, match=r"^without: expected 'default', since lerobot's preprocessing"):
        policy.encode(told(policy), without="empty")


def test_bad_input_is_refused_by_name() -> None:
    policy = load("nvidia")
    observation = told(policy)
    context = policy.encode(observation)
    for weight in (-1.0, math.nan, math.inf, 1e39, "2", True, [2.0]):
        with pytest.raises(InputError, match=r"^guidance: expected a finite number of at least 0, got"):
            policy.act(observation, guidance=weight)
        with pytest.raises(InputError, match=r"^guidance: expected a finite number of at least 0, got"):
            policy.sample(context, observation, guidance=weight)
    for name in ("", "none", 0, True):
        with pytest.raises(InputError, match=r"^without: expected 'default' or 'empty', got"):
            policy.encode(observation, without=name)
        with pytest.raises(InputError, match=r"^without: expected 'default' or 'empty', got"):
            policy.act(observation, guidance=1, without=name)
    with pytest.raises(InputError, match=r"^without: expected guidance with it"):
        policy.act(observation, without="default")
    for held in (context, context.context):
        with pytest.raises(InputError, match=r"^guidance: expected a context from encode\(observation, wi"):
            policy.sample(held, observation, guidance=2.0)
    for text in ("", " "):
        with pytest.raises(InputError, match=r"^guidance: expected an instruction in each row"):
            policy.act(told(policy, text), guidance=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(InputError, match=r"^guidance: expected an instruction in each row"):
            policy.act(told(policy, None), guidance=2.0)
    with pytest.raises(InputError, match=r"^previous: expected what encode returns"):
        policy.encode(observation, previous=3, without="default")


def test_a_head_that_takes_no_guidance_is_named() -> None:
    policy = load("nvidia")

    class Foreign(SimpleNamespace):
        def encode(self, *given: Any, **options: Any) -> Any:
            return policy.head.encode(*given, **options)

        def sample(self, context: Any, state: Any, embodiment_id: Any, *, noise: Any = None) -> Any:
            return policy.head.sample(context, state, embodiment_id, noise=noise)

    parts = ("config", "source", "embodiment_ids", "num_threads", "nbytes")
    foreign = Foreign(**{name: getattr(policy.head, name) for name in parts})
    other = with_parts(policy, head=foreign)
    assert same(other.act(told(policy), noise=noise(policy)), policy.act(told(policy), noise=noise(policy)))
    with pytest.raises(InputError, match=r"^guidance: expected a head whose sample takes guidance.*Foreign"):
        other.act(told(policy), noise=noise(policy), guidance=2.0)
