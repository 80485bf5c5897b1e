"""Interventions that cannot be made, or do not fit the Rust head that they are given to."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import Intervention
from tests.helpers.intervention_cases import Head, Inputs, inputs_of, small_head


@pytest.fixture
def head(isa: str) -> Head:
    return small_head(isa)


@pytest.fixture
def inputs(head: Head) -> Inputs:
    return inputs_of(head)


def patched(step: int, block: int, group: Any, *shape: int) -> Intervention:
    return Intervention(patch={(step, block): {group: np.zeros(shape, np.float32)}})


@pytest.mark.parametrize(
    ("intervention", "error", "message"),
    [
        (Intervention(blocks=[0, 4]), saccade.InputError, "blocks: expected 0 to 3, got 4"),
        (
            Intervention(blocks=[2**62]),
            saccade.InputError,
            "blocks: expected 0 to 3, got 4611686018427387904",
        ),
        (Intervention(steps=[3]), saccade.InputError, "steps: expected 0 to 2, got 3"),
        (Intervention(heads=3), saccade.InputError, "heads: expected 0 to 2, got 3"),
        (
            Intervention(cut=[("action", ("future", [0, 40]))]),
            saccade.InputError,
            "cut: future token 40, expected 0 to 3",
        ),
        (
            Intervention(cut=[(("action", [5]), "vl")]),
            saccade.InputError,
            "cut: action token 5, expected 0 to 4",
        ),
        (
            Intervention(cut=[("action", ("vl", 6))]),
            saccade.InputError,
            "cut: vl token 6, expected 0 to 5",
        ),
        (
            Intervention(key_bias={("state", 1): 0.5}),
            saccade.InputError,
            "key_bias: state token 1, expected 0 to 0",
        ),
        (
            Intervention(key_bias={"future": np.zeros(5)}),
            saccade.ShapeError,
            "key_bias: expected a number or (4,) for future, got (5,)",
        ),
        (
            Intervention(future_tokens=np.zeros((4, 13))),
            saccade.ShapeError,
            "future_tokens: expected (tokens, width) with width 12, got (4, 13)",
        ),
        (
            [Intervention(future_tokens=np.zeros((4, 12)))] * 2,
            saccade.InputError,
            "future_tokens: expected at most one intervention that replaces them, got several",
        ),
        (
            Intervention(future_tokens=np.zeros((0, 12)), cut=[("action", ("future", 0))]),
            saccade.InputError,
            "cut: future token 0, expected none, since the group has no token",
        ),
        (patched(3, 0, "state", 1, 12), saccade.InputError, "patch: step: expected 0 to 2, got 3"),
        (patched(0, 4, "state", 1, 12), saccade.InputError, "patch: block: expected 0 to 3, got 4"),
        (
            patched(1, 2, ("future", (4,)), 1, 12),
            saccade.InputError,
            "patch[(1, 2)]: future token 4, expected 0 to 3",
        ),
        (
            patched(1, 2, "future", 2, 4, 12),
            saccade.ShapeError,
            "patch[(1, 2)]: expected (tokens, width) = (4, 12) or (batch, tokens, width) = (3, 4, 12) for "
            "future, got (2, 4, 12)",
        ),
        (patched(1, 2, "action", 4, 12), saccade.ShapeError, "got (4, 12)"),
        (
            [Intervention(key_bias={"future": 3e38})] * 2,
            saccade.InputError,
            "key_bias: expected biases whose sum for a key is below infinity",
        ),
        (
            Intervention(future_tokens=np.zeros((20_000, 12)), cut=[("future", "state")]),
            saccade.InputError,
            "intervention: cuts and biases over 1 heads, 20006 rows and 20006 keys need 1600960144 bytes",
        ),
        (
            "future",
            saccade.InputError,
            "intervention: expected an Intervention or a sequence of them, got str",
        ),
        (
            [None],
            saccade.InputError,
            "intervention: expected an Intervention or a sequence of them, got a sequence with NoneType",
        ),
    ],
)
def test_what_does_not_fit_is_refused(
    head: Head, inputs: Inputs, intervention: Any, error: type[Exception], message: str
) -> None:
    out = np.full((3, 5, 3), 7, np.float32)
    with pytest.raises(error) as caught:
        head.sample(**inputs, intervention=intervention, out=out)
    assert message in str(caught.value)
    assert (out == 7).all()
    with pytest.raises(error):
        head.trace(**inputs, intervention=intervention)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"cut": [("action", ("vl", True))]}, saccade.InputError),
        ({"cut": [("action", ("vl", [0.0]))]}, saccade.InputError),
        ({"cut": [("action", ("vl", [1, 1]))]}, saccade.InputError),
        ({"cut": [("action", ("vl", [-1]))]}, saccade.InputError),
        ({"cut": [("vl", "state")]}, saccade.InputError),
        ({"cut": [("action", "vision")]}, saccade.InputError),
        ({"cut": "action"}, saccade.InputError),
        ({"key_bias": {"vl": math.nan}}, saccade.InputError),
        ({"key_bias": {"vl": math.inf}}, saccade.InputError),
        ({"key_bias": {"vl": True}}, saccade.DtypeError),
        ({"key_bias": {"vl": [1, 2]}}, saccade.DtypeError),
        ({"patch": {(0, True): {"state": np.zeros((1, 12))}}}, saccade.InputError),
        ({"patch": {0: {"state": np.zeros((1, 12))}}}, saccade.InputError),
        ({"patch": {(0, 0): {"state": np.full((1, 12), math.nan)}}}, saccade.InputError),
        ({"patch": {(0, 0): {"vl": np.zeros((1, 12))}}}, saccade.InputError),
        ({"patch": {(0, 0): {"state": np.zeros(12)}}}, saccade.ShapeError),
        ({"future_tokens": np.zeros(12)}, saccade.ShapeError),
        ({"future_tokens": np.full((1, 12), math.inf)}, saccade.InputError),
        ({"blocks": [False]}, saccade.InputError),
        ({"heads": [-1]}, saccade.InputError),
        ({"steps": 1.0}, saccade.InputError),
        ({"cut": np.array(1)}, saccade.InputError),
        ({"key_bias": {"vl": 10**400}}, saccade.InputError),
        ({"key_bias": {("vl", 0): 1.0, ("vl", (0,)): 2.0}}, saccade.InputError),
        ({"blocks": {1, "a"}}, saccade.InputError),
        ({"blocks": ""}, saccade.InputError),
        ({"steps": range(2**70)}, saccade.InputError),
        ({"steps": range(-(10**12), 0)}, saccade.InputError),
        ({"heads": np.array([[1]])}, saccade.InputError),
    ],
)
def test_no_intervention_is_made_of_this(fields: dict[str, Any], error: type[Exception]) -> None:
    with pytest.raises(error, match=next(iter(fields))) as caught:
        Intervention(**fields)
    assert type(caught.value) is error


def test_what_is_kept_cannot_be_changed() -> None:
    tokens = np.ones((2, 3), np.float32)
    kept: Any = Intervention(future_tokens=tokens, key_bias={"vl": [1.0]}).future_tokens
    tokens[:] = 0
    assert (kept == 1).all()
    with pytest.raises(ValueError, match="read-only"):
        kept[0, 0] = 2
