"""The midpoint rule: against the torch reference in float64, and step by step from velocities."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

import saccade
from saccade import Intervention
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import TAME, TOLERANCE, arrays, same, three_observations, tiny_head
from tests.helpers.intervention_cases import Case, cases, everything, per_isa
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import load_released


def without_patches(case: Case) -> list[Intervention]:
    return [
        Intervention(cut=one.cut, key_bias=one.key_bias, steps=one.steps, future_tokens=one.future_tokens)
        for one in case.interventions
    ]


@per_isa
@given(case=cases(max_steps=3), refresh=st.integers(1, 4))
def test_random_configurations_equal_the_reference(isa: str, case: Case, refresh: int) -> None:
    options: dict[str, Any] = {
        "integrator": "midpoint",
        "intervention": case.interventions if refresh == 1 else without_patches(case),
        "num_steps": case.num_steps,
        "future_refresh": refresh,
        "drop_vl": case.drop_vl,
    }
    with torch.no_grad():
        expected = case.reference(**case.inputs, **options)
        case.reference.float()
        assume(relative_error(case.reference(**case.inputs, **options), expected) <= TAME)
    assert relative_error(case.head(**arrays(case.inputs), **options), expected) <= TOLERANCE


@pytest.fixture
def head() -> saccade.ActionHead:
    return tiny_head()


@pytest.fixture
def inputs(head: saccade.ActionHead) -> dict[str, Any]:
    return three_observations(head)


@pytest.mark.parametrize("num_steps", [1, 2, 3, 7])
def test_it_is_two_velocities_a_step(
    head: saccade.ActionHead, inputs: dict[str, Any], num_steps: int
) -> None:
    observed = {name: inputs[name] for name in ("context", "state", "embodiment_id")}
    x, dt = inputs["noise"], np.float32(1) / np.float32(num_steps)
    for step in range(num_steps):

        def velocity(actions: Any, time: float) -> Any:
            return np.asarray(head.velocity(**observed, actions=actions, timestep=int(time * 1000)))

        middle = x + dt / 2 * velocity(x, step / num_steps)
        x = x + dt * velocity(middle, (step + 0.5) / num_steps)
    given_actions = head.sample(**inputs, num_steps=num_steps, integrator="midpoint")
    assert same(given_actions, x)
    assert not same(given_actions, head.sample(**inputs, num_steps=num_steps))


def test_euler_is_the_default(head: saccade.ActionHead, inputs: dict[str, Any]) -> None:
    euler = head.sample(**inputs)
    assert same(head.sample(**inputs, integrator="euler"), euler)
    assert same(head.sample(**inputs, integrator=None), euler)


def test_the_second_evaluation_may_be_of_the_action_rows_only(
    head: saccade.ActionHead, inputs: dict[str, Any]
) -> None:
    exact = head.sample(**inputs, num_steps=1, integrator="midpoint")
    assert same(head.sample(**inputs, num_steps=1, integrator="midpoint", future_refresh=1), exact)
    held = head.sample(**inputs, num_steps=1, integrator="midpoint", future_refresh=2)
    assert not same(held, exact)
    blind = Intervention(cut=[("action", "state"), ("action", "future")])
    options: dict[str, Any] = {"num_steps": 1, "integrator": "midpoint", "intervention": blind}
    assert same(head.sample(**inputs, **options, future_refresh=2), head.sample(**inputs, **options))


def test_a_step_is_all_of_its_evaluations(head: saccade.ActionHead, inputs: dict[str, Any]) -> None:
    """Something is changed at step 1: what step 0 gave is a start of the same kind."""
    late = Intervention(cut=[("action", "vl")], steps=[1])
    always = Intervention(cut=[("action", "vl")])
    options: dict[str, Any] = {"integrator": "midpoint", "num_steps": 2}
    kinds: list[Any] = [[], late, always]
    chunks = [head.sample(**inputs, **options, intervention=one) for one in kinds]
    assert not same(chunks[0], chunks[1])
    assert not same(chunks[1], chunks[2])
    early = Intervention(cut=[("action", "vl")], steps=[0])
    assert same(head.sample(**inputs, **options, intervention=[early, late]), chunks[2])
    row = np.zeros((1, head.config.width), np.float32)
    patch = Intervention(patch={(1, 0): {"state": row}})
    head.sample(**inputs, **options, intervention=patch)
    with pytest.raises(saccade.InputError, match="do not always run at step 1"):
        head.sample(**inputs, **options, intervention=patch, future_refresh=2)


def test_bits_do_not_depend_on_batch_samples_or_threads(isa: str) -> None:
    released = load_released("n15_tiny")
    heads = [
        saccade.ActionHead.from_pretrained(released.path, config=released.config, num_threads=threads)
        for threads in (1, 3)
    ]
    head = heads[0]
    config = head.config
    rng = np.random.default_rng(7)
    features = rng.standard_normal((3, 8, config.context_dim), np.float32)
    state = rng.standard_normal((3, config.state_dim), np.float32)
    noise = rng.standard_normal((3, 2, config.action_horizon, config.encoder_action_dim), np.float32)
    options: dict[str, Any] = {
        "intervention": everything(head, 3)[:-1],
        "num_steps": 3,
        "integrator": "midpoint",
        "future_refresh": 2,
    }

    def chunks(of: saccade.ActionHead, rows: slice, **more: Any) -> Any:
        return of.sample(of.encode(features[rows]), state[rows], 1, **options, **more)

    everyone = slice(None)
    together = chunks(head, everyone, noise=noise, num_samples=2)
    assert same(chunks(heads[1], everyone, noise=noise, num_samples=2), together)
    for sample in range(2):
        assert same(chunks(head, everyone, noise=noise[:, sample].copy()), together[:, sample])
    for element in range(3):
        rows = slice(element, element + 1)
        assert same(chunks(head, rows, noise=noise[rows, 0]), together[rows, 0])


@pytest.mark.parametrize("name", ["heun", "Euler", "", 2, True])
def test_no_other_name_is_taken(head: saccade.ActionHead, inputs: dict[str, Any], name: Any) -> None:
    with pytest.raises(saccade.InputError, match="integrator: expected euler or midpoint, got"):
        head.sample(**inputs, integrator=name)
    reference = random_head(small_config(), 1)
    drawn: dict[str, Any] = random_inputs(reference.config, 2, batch=1, num_vl_tokens=3)
    with pytest.raises(saccade.InputError, match="integrator: expected euler or midpoint, got"):
        reference(**drawn, integrator=name)
