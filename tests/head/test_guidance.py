"""Guidance: against the torch reference in float64, and step by step from velocities."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import saccade
from saccade import Chunking, InputError, Intervention, ShapeError
from saccade_lab.reference import Guidance
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers.engine_cases import (
    TAME,
    TOLERANCE,
    arrays,
    both,
    random_masks,
    same,
    three_observations,
    tiny_head,
    variant_configs,
)
from tests.helpers.intervention_cases import per_isa
from tests.helpers.reference_cases import relative_error
from tests.helpers.released import load_released

Inputs = dict[str, Any]


@settings(per_isa, max_examples=10)
@given(config=variant_configs(), seed=st.integers(0, 2**31 - 1), data=st.data())
def test_random_configurations_equal_the_reference(
    isa: str, config: dict[str, Any], seed: int, data: st.DataObject
) -> None:
    """Heads of every release; the second context has another length and masks of its own."""
    head, reference = both(config, seed)
    rng = np.random.default_rng(seed)
    batch, lengths = data.draw(st.integers(1, 3)), (int(rng.integers(2, 40)), int(rng.integers(2, 40)))
    given_inputs, other = (
        random_inputs(head.config, seed + place, batch=batch, num_vl_tokens=length)
        for place, length in enumerate(lengths)
    )
    masks, other_masks = (random_masks(head.config, rng, batch, length) for length in lengths)
    for name in ("attention_mask", "image_mask"):
        given_inputs.pop(name, None)
    horizon, decoded = head.config.action_horizon, head.config.action_dim
    overlap = int(rng.integers(0, horizon + 1))
    options: dict[str, Any] = {
        "num_steps": data.draw(st.integers(1, 3)),
        "integrator": data.draw(st.sampled_from(["euler", "midpoint"])),
        "future_refresh": data.draw(st.integers(1, 3)),
        "intervention": data.draw(
            st.sampled_from([None, Intervention(cut=[("action", "vl")], heads=[0], steps=[0])])
        ),
    }
    if data.draw(st.booleans()):
        options["previous_chunk"] = rng.standard_normal((batch, horizon, decoded)).astype(np.float32)
        options["chunking"] = Chunking(overlap, int(rng.integers(0, overlap + 1)), 3.0)
    weight = data.draw(st.sampled_from([0.0, 0.3, 1.7, 4.0]))

    def by_reference() -> Any:
        features = other["backbone_features"]
        encoded = reference.encode(features, drop_vl=other_masks["drop_vl"])
        guidance = Guidance(weight, encoded, **other_masks)
        plain: Inputs = dict(given_inputs)
        tokens = reference.encode(plain.pop("backbone_features"), drop_vl=masks["drop_vl"])
        return reference.sample(tokens, **plain, **masks, **options, guidance=guidance)

    with torch.no_grad():
        expected = by_reference()
        reference.float()
        assume(relative_error(by_reference(), expected) <= TAME)
    inputs = arrays(given_inputs)
    context = head.encode(inputs.pop("backbone_features"), **masks)
    second = head.encode(other["backbone_features"].numpy(), **other_masks)
    found = head.sample(context, **inputs, **options, guidance=weight, without=second)
    assert relative_error(found, expected) <= TOLERANCE


@pytest.fixture
def head() -> saccade.ActionHead:
    return tiny_head()


@pytest.fixture
def inputs(head: saccade.ActionHead) -> Inputs:
    return three_observations(head)


def second_context(head: saccade.ActionHead, batch: int = 3, length: int = 5) -> saccade.Context:
    rng = np.random.default_rng(99)
    return head.encode(rng.standard_normal((batch, length, head.config.context_dim), np.float32))


@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
@pytest.mark.parametrize("integrator", ["euler", "midpoint"])
def test_it_is_the_definition_bit_by_bit(integrator: str, precision: str) -> None:
    released = load_released("n15_tiny")
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config, precision=precision)
    inputs, second = three_observations(head), second_context(head)
    observed = {name: inputs[name] for name in ("state", "embodiment_id")}
    weight, num_steps = np.float32(2.5), 3

    def velocity(x: Any, time: float) -> Any:
        timestep = int(time * 1000)
        v, u = (
            np.asarray(head.velocity(context, **observed, actions=x, timestep=timestep))
            for context in (inputs["context"], second)
        )
        return u + weight * (v - u)

    x, dt = inputs["noise"], np.float32(1) / np.float32(num_steps)
    for step in range(num_steps):
        moved = velocity(x, step / num_steps)
        if integrator == "midpoint":
            moved = velocity(x + dt / 2 * moved, (step + 0.5) / num_steps)
        x = x + dt * moved
    options: Inputs = {"num_steps": num_steps, "integrator": integrator}
    guided = head.sample(**inputs, **options, guidance=2.5, without=second)
    assert same(guided, x)
    assert not same(guided, head.sample(**inputs, **options))


def test_a_weight_of_one_has_the_bits_of_no_guidance(head: saccade.ActionHead, inputs: Inputs) -> None:
    plain = head.sample(**inputs)
    assert same(head.sample(**inputs, guidance=None), plain)
    weights: list[Any] = [1, 1.0, np.float32(1), Fraction(1)]
    for weight in weights:
        assert same(head.sample(**inputs, guidance=weight), plain)
        assert same(head.sample(**inputs, guidance=weight, without=second_context(head)), plain)


def test_a_weight_of_zero_is_the_second_context(head: saccade.ActionHead, inputs: Inputs) -> None:
    second = second_context(head)
    expected = head.sample(**inputs | {"context": second})
    assert same(head.sample(**inputs, guidance=0, without=second), expected)


def test_the_same_context_twice_changes_nothing(head: saccade.ActionHead, inputs: Inputs) -> None:
    assert same(head.sample(**inputs, guidance=7.0, without=inputs["context"]), head.sample(**inputs))


def test_each_row_has_the_bits_that_it_has_alone(head: saccade.ActionHead, inputs: Inputs) -> None:
    config, rng = head.config, np.random.default_rng(3)
    features = rng.standard_normal((3, 8, config.context_dim), np.float32)
    bare = rng.standard_normal((3, 5, config.context_dim), np.float32)
    noise = rng.standard_normal((3, 2, config.action_horizon, config.encoder_action_dim), np.float32)

    def sample(rows: slice, draws: Any) -> Any:
        return head.sample(
            head.encode(features[rows]),
            inputs["state"][rows],
            inputs["embodiment_id"][rows],
            noise=noise[rows, draws],
            num_samples=2 if draws == slice(None) else None,
            guidance=3.0,
            without=head.encode(bare[rows]),
            future_refresh=2,
        )

    together = np.asarray(sample(slice(None), slice(None)))
    for row in range(3):
        for draw in range(2):
            assert same(together[row, draw], sample(slice(row, row + 1), draw)[0])


def test_each_context_holds_its_own_keys_and_values(head: saccade.ActionHead, inputs: Inputs) -> None:
    """With rows that do not depend on the held ones, holding changes nothing; with others it does."""
    options: dict[str, Any] = {"num_steps": 4, "guidance": 2.0, "without": second_context(head)}
    blind = Intervention(cut=[("action", "state"), ("action", "future")])
    exact = head.sample(**inputs, **options, intervention=blind)
    assert same(head.sample(**inputs, **options, intervention=blind, future_refresh=4), exact)
    assert not same(head.sample(**inputs, **options, future_refresh=4), head.sample(**inputs, **options))
    # A call that held others before leaves nothing behind.
    again = head.sample(**inputs, **options, future_refresh=4)
    head.sample(**inputs, num_steps=4, future_refresh=4)
    assert same(head.sample(**inputs, **options, future_refresh=4), again)


def test_frozen_actions_stay_frozen(head: saccade.ActionHead, inputs: Inputs) -> None:
    before = np.asarray(head.sample(**inputs))
    chunking = Chunking(overlap=6, frozen=3)
    found = head.sample(
        **inputs, previous_chunk=before, chunking=chunking, guidance=4.0, without=second_context(head)
    )
    horizon = head.config.action_horizon
    assert same(np.asarray(found)[:, :3], before[:, horizon - 6 : horizon - 3])


def test_interventions_act_in_both_contexts(head: saccade.ActionHead, inputs: Inputs) -> None:
    deaf = Intervention(cut=[("state", "vl"), ("future", "vl"), ("action", "vl")])
    found = head.sample(**inputs, intervention=deaf, guidance=5.0, without=second_context(head))
    assert same(found, head.sample(**inputs, intervention=deaf))
    biased = Intervention(key_bias={"vl": np.zeros(8, np.float32)})
    assert same(
        head.sample(**inputs, intervention=biased, guidance=2.0, without=second_context(head, length=8)),
        head.sample(**inputs, guidance=2.0, without=second_context(head, length=8)),
    )


@pytest.mark.parametrize(
    "weight",
    [
        -1,
        -1e-9,
        math.nan,
        math.inf,
        -math.inf,
        1e39,
        10**400,
        True,
        "2",
        [2.0],
        np.array([2.0]),
        2j,
        b"2",
    ],
    ids=str,
)
def test_weights_that_are_none_are_refused(head: saccade.ActionHead, inputs: Inputs, weight: Any) -> None:
    with pytest.raises(InputError, match=r"^guidance: expected a finite number of at least 0, got"):
        head.sample(**inputs, guidance=weight, without=second_context(head))


def test_second_contexts_that_do_not_fit_are_refused(head: saccade.ActionHead, inputs: Inputs) -> None:
    second, text = second_context(head), cast(Any, "default")
    with pytest.raises(InputError, match=r"^guidance, without: expected both or neither, got guidance 2"):
        head.sample(**inputs, guidance=2)
    with pytest.raises(InputError, match=r"^guidance, without: expected both or neither, got without"):
        head.sample(**inputs, without=second)
    with pytest.raises(InputError, match=r"^without: expected what encode returns, got str"):
        head.sample(**inputs, guidance=2, without=text)
    with pytest.raises(InputError, match=r"^without: expected a context of 3 observations.*got 2"):
        head.sample(**inputs, guidance=2, without=second_context(head, batch=2))
    other = tiny_head()
    with pytest.raises(InputError, match=r"^without: expected a context that this head encoded"):
        head.sample(**inputs, guidance=2, without=second_context(other))
    with pytest.raises(InputError, match=r"^without: expected a context that this head encoded"):
        head.sample(**inputs, guidance=1, without=second_context(other))
    biased = Intervention(key_bias={"vl": np.zeros(8, np.float32)})
    with pytest.raises(InputError, match=r"^without: the intervention does not fit this context of 5"):
        head.sample(**inputs, guidance=2, without=second, intervention=biased)
    with pytest.raises(ShapeError, match="key_bias"):
        head.sample(
            **inputs,
            guidance=2,
            without=second,
            intervention=Intervention(key_bias={"vl": np.zeros(5, np.float32)}),
        )
    # Nothing of a refused call stays.
    assert same(head.sample(**inputs), head.sample(**inputs))
