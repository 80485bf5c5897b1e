"""Real-time chunking: a chunk that goes on from the one that is being carried out."""

from __future__ import annotations

import warnings
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import saccade
from saccade import Chunking, InputError, ShapeError
from saccade.head.chunking import RELEASED, from_released
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.chunking import velocity_strength
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers.engine_cases import TOLERANCE, arrays, both, same
from tests.helpers.reference_cases import relative_error, variant_config

HORIZON = 8
KINDS = ("n1", "n1.5", "n1.6", "n1.7", "fork")


def one_call(kind: str, seed: int = 1) -> tuple[saccade.ActionHead, Reference, dict[str, Any], Any]:
    """Both heads, their arguments, and a previous chunk."""
    head, reference = both(variant_config(kind, action_horizon=HORIZON), seed)
    inputs = arrays(random_inputs(head.config, seed + 1, batch=2, num_vl_tokens=6))
    shape = (2, HORIZON, head.config.encoder_action_dim)
    return head, reference, inputs, np.random.default_rng(seed).standard_normal(shape, np.float32)


@pytest.mark.parametrize("integrator", ["euler", "midpoint"])
@pytest.mark.parametrize("kind", KINDS)
def test_frozen_actions_come_out_as_they_went_in(isa: str, kind: str, integrator: str) -> None:
    head, reference, inputs, previous = one_call(kind)
    dims = head.config.action_dim
    for overlap, frozen, horizon in ((5, 2, None), (5, 5, 6), (HORIZON, HORIZON, HORIZON), (3, 1, 4)):
        chunking = Chunking(overlap, frozen, horizon=horizon)
        tail = previous[:, (horizon or HORIZON) - overlap :][:, :frozen, :dims]
        options: dict[str, Any] = {"chunking": chunking, "integrator": integrator}
        actions = head(**inputs, previous_chunk=previous, **options)
        assert same(actions[:, :frozen], tail)
        with torch.no_grad():
            expected = reference(**inputs, previous_chunk=previous, **options)
        assert torch.equal(expected[:, :frozen].float(), torch.from_numpy(tail.copy()))
        assert relative_error(actions, expected) <= TOLERANCE
        if frozen < HORIZON:
            assert not same(actions[:, frozen:], head(**inputs)[:, frozen:])


@pytest.mark.parametrize("kind", KINDS)
def test_no_overlap_is_no_chunking(isa: str, kind: str) -> None:
    head, reference, inputs, previous = one_call(kind)
    options: dict[str, Any] = {"previous_chunk": previous, "chunking": Chunking(0, 0)}
    assert same(head(**inputs, **options), head(**inputs))
    with torch.no_grad():
        assert torch.equal(reference(**inputs, **options), reference(**inputs))


def test_the_ramp_is_the_released_one() -> None:
    """As written in the released code, in float32: a table from 0 to 1, without its ends."""
    for overlap, frozen, rate in ((3, 1, 6.0), (16, 6, 6.0), (8, 0, 1.0), (5, 5, 6.0), (7, 2, 0.1)):
        table = 1 - torch.exp(-rate * torch.linspace(0.0, 1.0, overlap - frozen + 2))
        ramp = (table / table[-1])[1:-1]
        expected = torch.cat((torch.zeros(frozen), ramp, torch.ones(20 - overlap)))
        given_strength = velocity_strength(Chunking(overlap, frozen, rate), 20)
        assert relative_error(given_strength, expected) <= 2e-6


@given(
    overlap=st.integers(0, 20),
    frozen=st.integers(0, 20),
    rate=st.floats(1e-9, 700.0) | st.sampled_from([5e-324, 1e-300, 1e300]),
)
def test_the_ramp_rises(overlap: int, frozen: int, rate: float) -> None:
    frozen = min(frozen, overlap)
    strength = velocity_strength(Chunking(overlap, frozen, rate), 20)
    assert (strength[:frozen] == 0).all()
    assert (strength[overlap:] == 1).all()
    between = strength[frozen:overlap]
    assert (between > 0).all()
    assert (between <= 1).all()
    assert (np.diff(strength) >= 0).all()
    if rate < 1e-8:  # the limit: a straight line
        steps = np.arange(1, overlap - frozen + 1) / (overlap - frozen + 1)
        np.testing.assert_allclose(between, steps, rtol=1e-8)


@settings(max_examples=15)
@given(
    rate=st.sampled_from([5e-324, 1e-300, 1e-9, 1e-4, 6.0, 100.0, 1e300]),
    overlap=st.integers(0, HORIZON),
    frozen=st.integers(0, HORIZON),
)
def test_any_rate_equals_the_reference(rate: float, overlap: int, frozen: int) -> None:
    head, reference, inputs, previous = one_call("n1.7")
    chunking = Chunking(overlap, min(overlap, frozen), ramp_rate=rate)
    with torch.no_grad():
        expected = reference(**inputs, previous_chunk=previous, chunking=chunking)
    assert relative_error(head(**inputs, previous_chunk=previous, chunking=chunking), expected) <= TOLERANCE


def test_a_horizon_says_where_the_tail_ends(isa: str) -> None:
    """Only the tail is used: the same chunk, moved, is the same start."""
    head, _, inputs, previous = one_call("n1.5")
    moved = np.roll(previous, -2, axis=1)
    first = head(**inputs, previous_chunk=previous, chunking=Chunking(4, 1))
    again = head(**inputs, previous_chunk=moved, chunking=Chunking(4, 1, horizon=HORIZON - 2))
    assert same(first, again)
    shorter = previous[:, 2:]
    assert same(head(**inputs, previous_chunk=shorter, chunking=Chunking(4, 1, horizon=HORIZON - 2)), first)
    other = previous.copy()
    other[:, : HORIZON - 4] = 1e30
    assert same(head(**inputs, previous_chunk=other, chunking=Chunking(4, 1)), first)


def test_a_forks_chunk_is_taken_as_it_left(isa: str) -> None:
    """What the head returns is narrower than what it denoises."""
    head, reference, inputs, previous = one_call("fork")
    narrow = previous[..., : head.config.action_dim]
    chunking = Chunking(4, 1)
    actions = head(**inputs, previous_chunk=narrow, chunking=chunking)
    assert same(actions, head(**inputs, previous_chunk=previous, chunking=chunking))
    with torch.no_grad():
        assert torch.equal(
            reference(**inputs, previous_chunk=narrow, chunking=chunking),
            reference(**inputs, previous_chunk=previous, chunking=chunking),
        )
    following = head(**inputs, previous_chunk=actions, chunking=Chunking(HORIZON, 2))
    assert same(following[:, :2], actions[:, :2])


def test_all_samples_go_on_from_one_chunk(isa: str) -> None:
    head, _, inputs, previous = one_call("n1.6")
    noise = np.random.default_rng(3).standard_normal((2, 3, *inputs["noise"].shape[1:]), np.float32)
    options: dict[str, Any] = {"previous_chunk": previous, "chunking": Chunking(5, 2)}
    together = head(**(inputs | {"noise": noise}), num_samples=3, **options)
    assert together.shape[:2] == (2, 3)
    for sample in range(3):
        alone = head(**(inputs | {"noise": noise[:, sample].copy()}), **options)
        assert same(together[:, sample], alone)


def test_the_previous_chunk_may_be_in_the_way(isa: str) -> None:
    """The result is written over the chunk that it goes on from, and over the noise."""
    head, _, inputs, previous = one_call("n1.5")
    options: dict[str, Any] = {"chunking": Chunking(5, 2)}
    expected = head(**inputs, previous_chunk=previous, **options)
    out = previous.copy()
    head(**inputs, previous_chunk=out, **options, out=out)
    assert same(out, expected)


@pytest.mark.parametrize(
    ("overlap", "frozen", "rate", "horizon"),
    [
        (-1, 0, 6.0, None),
        (2, -1, 6.0, None),
        (2, 3, 6.0, None),
        (4, 0, 6.0, 3),
        (2, 0, 0.0, None),
        (2, 0, -1.0, None),
        (2, 0, float("nan"), None),
        (2, 0, float("inf"), None),
        (1.5, 0, 6.0, None),
        (2, True, 6.0, None),
        (2, 0, "six", None),
        (2, 0, 6.0, -1),
        (2, 0, 6.0, 2.5),
    ],
)
def test_what_is_no_chunking_is_refused(overlap: Any, frozen: Any, rate: Any, horizon: Any) -> None:
    with pytest.raises(InputError, match=r"overlap|frozen|ramp_rate|horizon"):
        Chunking(overlap, frozen, rate, horizon)


@pytest.mark.parametrize("kind", ["n1.5", "fork"])
def test_what_does_not_fit_the_head_is_refused(kind: str) -> None:
    head, reference, inputs, previous = one_call(kind)
    dims = head.config.encoder_action_dim
    for run in (head, reference):
        for wrong in (
            {"previous_chunk": previous},
            {"chunking": Chunking(2, 1)},
            {"previous_chunk": previous, "chunking": Chunking(HORIZON + 1, 1)},
            {"previous_chunk": previous, "chunking": Chunking(2, 1, horizon=HORIZON + 1)},
        ):
            with pytest.raises(InputError, match=r"chunking|previous_chunk|overlap|horizon"):
                run(**inputs, **wrong)
        for shape in ((2, HORIZON - 1, dims), (1, HORIZON, dims), (2, HORIZON, dims + 1), (2, HORIZON)):
            with pytest.raises(ShapeError, match="previous_chunk"):
                run(**inputs, previous_chunk=np.zeros(shape, np.float32), chunking=Chunking(2, 1))
    wrong = previous.copy()
    wrong[1, -1, 0] = np.nan
    with pytest.raises(InputError, match="previous_chunk"):
        head(**inputs, previous_chunk=wrong, chunking=Chunking(2, 1))


def test_it_differs_from_what_starts_anew(isa: str) -> None:
    """The free actions see the frozen ones: they go on from them."""
    head, _, inputs, previous = one_call("n1.5")
    independent = np.asarray(head(**inputs))
    on = np.asarray(head(**inputs, previous_chunk=previous, chunking=Chunking(3, 3)))
    assert not same(on[:, 3:], independent[:, 3:])


@pytest.mark.parametrize(
    "rate",
    [np.float32("inf"), np.float16("inf"), np.float32("nan"), 10**400, Fraction(1, 10**400), -1, True, "2"],
)
def test_released_ramp_rates_that_are_refused(rate: Any) -> None:
    released = dict(zip(RELEASED, (6, 4, 2, rate), strict=True))
    with pytest.raises(InputError, match="options: rtc_ramp_rate: expected a finite number above 0, got"):
        from_released(released)


@pytest.mark.parametrize("rate", [np.float32(2.5), np.float64(2.5), 2.5, Fraction(5, 2)])
def test_released_numbers_are_read_without_a_warning(rate: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = from_released(dict(zip(RELEASED, (np.int64(6), 4, 2, rate), strict=True)))
    assert found == saccade.Chunking(4, 2, ramp_rate=2.5, horizon=6)
    assert type(found.ramp_rate) is float
