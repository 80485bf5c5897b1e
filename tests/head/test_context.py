"""Immutable results: copies are the object itself, pickling says what to do, repr lists the contents."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest

import saccade
from tests.helpers.released import load_released

TINY = load_released("n15_tiny")


@pytest.fixture(scope="module")
def head() -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(TINY.path, config=TINY.config)


@pytest.fixture(scope="module")
def context(head: saccade.ActionHead) -> saccade.Context:
    return head.encode(TINY.backbone_features[:, :7], record=("attention", "hidden"))


@pytest.fixture(scope="module")
def cross_attention() -> saccade.CrossAttention:
    tensors: dict[str, Any] = {
        f"{name}.weight": np.ones((4, 4), np.float32) for name in ("to_q", "to_k", "to_v", "to_out.0")
    }
    tensors |= {f"{name}.bias": np.ones(4, np.float32) for name in ("to_q", "to_k", "to_v", "to_out.0")}
    return saccade.CrossAttention(tensors, 2)


@pytest.fixture(scope="module")
def key_values(cross_attention: saccade.CrossAttention) -> saccade.KeyValues:
    return cross_attention.project(np.ones((1, 3, 4), np.float32))


@pytest.mark.parametrize("name", ["context", "cross_attention", "key_values"])
def test_copies_are_the_object_itself(name: str, request: pytest.FixtureRequest) -> None:
    one = request.getfixturevalue(name)
    assert copy.copy(one) is one
    assert copy.deepcopy([one])[0] is one


@pytest.mark.parametrize(
    ("name", "what_to_do"),
    [
        ("context", "pickle the backbone features"),
        ("cross_attention", "pickle the tensors"),
        ("key_values", "pickle the tokens"),
    ],
)
@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickling_says_what_to_do(
    name: str, what_to_do: str, protocol: int, request: pytest.FixtureRequest
) -> None:
    with pytest.raises(saccade.DtypeError, match=f"cannot be pickled.*{what_to_do}"):
        pickle.dumps(request.getfixturevalue(name), protocol)


def test_a_trace_lists_what_it_contains(head: saccade.ActionHead, context: saccade.Context) -> None:
    given: dict[str, Any] = {"noise": TINY.noise, "num_steps": 3, "record": ("attention", "hidden")}
    trace = head.trace(context, TINY.state, 1, **given, blocks=[0, 1, 2])
    lines = repr(trace).splitlines()
    nbytes = sum(a.nbytes for kept in (trace.attention, trace.hidden) for a in kept.values())
    assert lines[0] == f"<saccade.Trace {(nbytes + trace.actions.nbytes) / 1e6:,.1f} MB"
    rows = trace.hidden[0, 0].shape[1]
    heads = head.config.num_heads
    assert lines[1] == f"  attention[step, block]: steps 0-2, blocks 0, 2: {(2, heads, rows, 7)}"
    assert lines[2] == f"  attention[step, block]: steps 0-2, blocks 1: {(2, heads, rows, rows)}"
    assert lines[3] == f"  hidden[step, block]: steps 0-2, blocks 0-2: {(2, rows, head.config.width)}"
    assert lines[4].startswith("  rows: state 0, future 1-")
    assert lines[5] == "  actions: (2, 6, 5)>"
    assert len(lines) == 6
    bare = repr(head.trace(context, TINY.state, 1, **{**given, "record": ()}))
    assert bare.count("not recorded") == 2


def test_a_record_lists_what_it_contains(context: saccade.Context) -> None:
    record = context.record
    assert record is not None
    text = repr(record)
    assert text.startswith(f"<saccade.Record {record.nbytes / 1e6:,.1f} MB\n  attention[block]: blocks 0")
    assert str(tuple(record.hidden[0].shape)) in text
