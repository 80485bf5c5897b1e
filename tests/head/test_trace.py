"""What `trace` and `encode(record=)` keep; test_intervention_parity.py compares a trace's numbers too."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import saccade
from saccade import Intervention
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers.engine_cases import TOLERANCE, arrays, both
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import Released

BOTH = ("attention", "hidden")
Inputs = dict[str, Any]


@pytest.fixture
def head(isa: str) -> saccade.ActionHead:
    """Three Euler steps, four blocks, three heads of width 4, rows 1 + 4 + 5."""
    head, _ = both(small_config(vl_num_layers=2), seed=21)
    assert head.isa == isa
    return head


@pytest.fixture
def inputs(head: saccade.ActionHead) -> Inputs:
    given_arrays = arrays(random_inputs(head.config, 22, batch=2, num_vl_tokens=6))
    given_arrays["context"] = head.encode(given_arrays.pop("backbone_features"))
    return given_arrays


def test_actions_are_those_of_sample(isa: str, released: Released) -> None:
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config)
    batch, num_tokens, _ = released.backbone_features.shape
    drop_vl = np.arange(batch * num_tokens).reshape(batch, num_tokens) % 7 == 3
    blind = Intervention(cut=[("action", "vl"), (("future", [1]), "state")], key_bias={"future": 0.5})
    patch = np.zeros((1, head.config.width), np.float32)
    patched = Intervention(patch={(1, head.config.num_layers - 1): {("action", (2,)): patch}})
    for dropped in (None, drop_vl):
        context = head.encode(released.backbone_features, drop_vl=dropped)
        arguments: Inputs = {"context": context, "state": released.state, "noise": released.noise}
        arguments["embodiment_id"] = released.embodiment_id
        for intervention in (None, blind, [blind, patched]):
            trace = head.trace(**arguments, intervention=intervention, record=BOTH)
            actions = head.sample(**arguments, intervention=intervention)
            np.testing.assert_array_equal(trace.actions, actions)


def test_places_and_shapes(head: saccade.ActionHead, inputs: Inputs) -> None:
    trace = head.trace(**inputs, record=BOTH)
    places = [(step, block) for step in range(3) for block in range(4)]
    assert list(trace.attention) == list(trace.hidden) == places
    for (_, block), weights in trace.attention.items():
        assert weights.shape == (2, 3, 10, 6 if block % 2 == 0 else 10)
        assert weights.dtype == np.float32
        np.testing.assert_allclose(np.asarray(weights).sum(-1), 1, atol=1e-5)
    assert {rows.shape for rows in trace.hidden.values()} == {(2, 10, 12)}
    assert trace.rows == {"state": slice(0, 1), "future": slice(1, 5), "action": slice(5, 10)}
    assert trace.actions.shape == (2, 5, 3)

    fewer = Intervention(future_tokens=np.zeros((1, 12)))
    trace = head.trace(**inputs, intervention=fewer, blocks=1, steps=0)
    assert trace.rows == {"state": slice(0, 1), "future": slice(1, 2), "action": slice(2, 7)}
    assert trace.attention[0, 1].shape == (2, 3, 7, 7)
    none = head.trace(**inputs, intervention=Intervention(future_tokens=np.zeros((0, 12))))
    assert none.rows["future"] == slice(1, 1)


def test_a_chosen_part_is_that_of_the_whole(head: saccade.ActionHead, inputs: Inputs) -> None:
    whole = head.trace(**inputs, record=BOTH)
    chosen: list[tuple[Inputs, tuple[str, ...]]] = [
        ({}, ("attention",)),
        ({"record": ["hidden"]}, ("hidden",)),
        ({"record": {"hidden", "attention"}, "blocks": (3, 0), "steps": [2]}, BOTH),
        ({"record": (), "max_bytes": 0}, ()),
        ({"blocks": ()}, ("attention",)),
        ({"steps": range(1, 3), "blocks": 2}, ("attention",)),
    ]
    for options, kept in chosen:
        trace = head.trace(**inputs, **options)
        steps = np.atleast_1d(options.get("steps", range(3))).tolist()
        blocks = np.atleast_1d(options.get("blocks", range(4))).tolist()
        places = [(step, block) for step in sorted(steps) for block in sorted(blocks)]
        for name in BOTH:
            part, of = getattr(trace, name), getattr(whole, name)
            assert list(part) == (places if name in kept else [])
            for place in part:
                np.testing.assert_array_equal(part[place], of[place])
        np.testing.assert_array_equal(trace.actions, whole.actions)


def test_seeds_and_steps_are_those_of_sample(head: saccade.ActionHead, inputs: Inputs) -> None:
    del inputs["noise"]
    for num_steps in (None, 7):
        trace = head.trace(**inputs, seed=5, num_steps=num_steps, record=())
        np.testing.assert_array_equal(trace.actions, head.sample(**inputs, seed=5, num_steps=num_steps))
    assert len(head.trace(**inputs, num_steps=1).attention) == 4


def test_removed_keys_are_exactly_zero(head: saccade.ActionHead) -> None:
    given_arrays = arrays(random_inputs(head.config, 23, batch=3, num_vl_tokens=8))
    drop_vl = np.zeros((3, 8), bool)
    drop_vl[0, [0, 5]], drop_vl[2] = True, True
    context = head.encode(given_arrays.pop("backbone_features"), drop_vl=drop_vl, record=("attention",))
    cut = Intervention(cut=[("future", ("vl", [7, 2]))])
    trace = head.trace(context, **given_arrays, intervention=cut)
    removed = np.broadcast_to(drop_vl[:, None, None], (3, 3, 10, 8)).copy()
    removed[:, :, trace.rows["future"], 2] = removed[:, :, trace.rows["future"], 7] = True
    for place, weights in trace.attention.items():
        if place[1] % 2 == 0:
            np.testing.assert_array_equal(np.asarray(weights) == 0, removed)
    assert context.record is not None
    for weights in context.record.attention.values():
        kept = np.asarray(weights)[:, :, ~drop_vl[0]]
        assert ((kept == 0) == np.broadcast_to(drop_vl[:, None, None], kept.shape)).all()


@settings(max_examples=20)
@given(
    record=st.lists(st.sampled_from(BOTH), min_size=1),
    steps=st.lists(st.integers(0, 2), min_size=1, unique=True),
)
def test_max_bytes_is_what_the_arrays_hold(record: list[str], steps: list[int]) -> None:
    head, given_arrays = one_call()
    trace = head.trace(**given_arrays, record=record, steps=steps)
    arrays_kept = [*trace.attention.values(), *trace.hidden.values()]
    held = sum(np.asarray(array).nbytes for array in arrays_kept)
    head.trace(**given_arrays, record=record, steps=steps, max_bytes=held)
    message = f"max_bytes: what is to be recorded takes {held} bytes, expected at most {held - 1}"
    with pytest.raises(saccade.InputError, match=message):
        head.trace(**given_arrays, record=record, steps=steps, max_bytes=held - 1)


def test_max_bytes_comes_before_what_interventions_take() -> None:
    head, given_arrays = one_call()
    many = Intervention(future_tokens=np.zeros((20_000, 12)), cut=[("future", "future")])
    with pytest.raises(saccade.InputError, match="max_bytes: what is to be recorded takes"):
        head.trace(**given_arrays, intervention=many)


@functools.cache
def one_call() -> tuple[saccade.ActionHead, Inputs]:
    """A head and what its `trace` takes."""
    head, _ = both(small_config(), seed=1)
    given_arrays = arrays(random_inputs(head.config, 2, batch=2, num_vl_tokens=6))
    return head, given_arrays | {"context": head.encode(given_arrays.pop("backbone_features"))}


def test_a_trace_that_no_machine_holds_is_refused() -> None:
    head, _ = both(small_config(vl_num_layers=0, use_vlln=False), seed=1)
    features = np.zeros((1, 10_000, head.config.context_dim), np.float32)
    context, state = head.encode(features), np.zeros((1, head.config.state_dim), np.float32)
    # 1000 steps x 4 blocks, in half of them 3 heads x 10 rows x 10 000 keys.
    needed = 4 * 1000 * 2 * 3 * 10 * (10_000 + 10)
    with pytest.raises(
        saccade.InputError, match=f"max_bytes: .* takes {needed} bytes, expected at most 2147483648"
    ):
        head.trace(context, state, 0, seed=0, num_steps=1000)
    recording = both(small_config(vl_num_heads=2, vl_num_layers=2), seed=1)[0]
    message = "record: what is to be recorded takes 3200000000 bytes, expected at most 2147483648"
    with pytest.raises(saccade.InputError, match=message):
        recording.encode(np.zeros((2, 10_000, head.config.context_dim), np.float32), record=("attention",))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"record": "attention"},
            "record: expected a tuple of names among attention, hidden, got 'attention'",
        ),
        ({"record": ("attention", "weights")}, "record: expected a tuple of names among attention, hidden"),
        ({"record": (["attention"],)}, "record: expected"),
        ({"record": None}, "record: expected a tuple of names among attention, hidden, got None"),
        ({"record": 3}, "record: expected"),
        ({"blocks": [0, 4]}, "blocks: expected 0 to 3, got 4"),
        ({"blocks": -1}, "blocks: expected indices of at least 0, got -1"),
        ({"blocks": [True]}, "blocks: expected an integer or an array of integers"),
        ({"blocks": [1, 1]}, "blocks: expected distinct indices"),
        ({"steps": 3}, "steps: expected 0 to 2, got 3"),
        ({"steps": 0.5}, "steps: expected an integer or an array of integers"),
        ({"max_bytes": -1}, "max_bytes: expected at least 0, got -1"),
        ({"max_bytes": 1.5}, "max_bytes: expected an integer, got 1.5"),
        ({"max_bytes": 2**63}, "max_bytes: expected a number below"),
        ({"num_steps": 0}, "num_steps: expected at least 1, got 0"),
        ({"seed": 1}, "noise, seed: expected at most one of them, got both"),
        ({"noise": np.zeros((2, 1, 5, 3))}, "noise: expected"),
        ({"state": np.full((2, 6), np.nan)}, "state: expected finite values"),
        ({"embodiment_id": 3}, "embodiment_id: expected 0 to 2, got 3"),
        ({"context": None}, "context: expected what encode returns, got NoneType"),
    ],
)
def test_bad_arguments(options: Inputs, message: str) -> None:
    head, given_arrays = one_call()
    with pytest.raises((saccade.InputError, saccade.ShapeError)) as caught:
        head.trace(**(given_arrays | options))
    assert message in str(caught.value)


def test_torch_in_torch_out(head: saccade.ActionHead) -> None:
    given_tensors: Inputs = random_inputs(head.config, 24, batch=2, num_vl_tokens=6)
    context = head.encode(given_tensors.pop("backbone_features"), record=BOTH)
    trace = head.trace(context, **given_tensors, record=BOTH)
    assert context.record is not None
    kept = [*trace.attention.values(), *trace.hidden.values(), trace.actions]
    kept += [*context.record.attention.values(), *context.record.hidden.values()]
    assert all(isinstance(array, torch.Tensor) and array.dtype == torch.float32 for array in kept)


def test_a_trace_is_frozen(head: saccade.ActionHead, inputs: Inputs) -> None:
    trace = head.trace(**inputs, record=())
    with pytest.raises(dataclasses.FrozenInstanceError):
        trace.actions = np.zeros(3)  # type: ignore[misc, assignment]


# The record of encode


@pytest.mark.parametrize("dropping", [False, True])
def test_record_equals_the_reference(isa: str, dropping: bool) -> None:
    head, reference = both(small_config(vl_num_layers=3, context_dim=16), seed=31)
    features = random_inputs(head.config, 32, batch=2, num_vl_tokens=9)["backbone_features"]
    drop_vl = np.random.default_rng(0).random((2, 9)) < 0.4 if dropping else np.zeros((2, 9), bool)
    context = head.encode(features.numpy(), drop_vl=drop_vl, record=BOTH)
    assert context.record is not None
    assert list(context.record.attention) == list(context.record.hidden) == [0, 1, 2]
    bias = torch.from_numpy(np.where(drop_vl, -np.inf, 0.0))[:, None, None]
    kept = ~drop_vl
    with torch.no_grad():
        rows = reference.vlln(features.double())
        for index, block in enumerate(reference.vl_self_attention.transformer_blocks):
            attention: Any = block.attn1
            y = block.norm1(rows)  # type: ignore[operator]
            attended, weights = attention(y, y, logit_bias=bias, return_weights=True)
            rows = rows + attended
            rows = rows + block.ff(block.norm3(rows))  # type: ignore[operator]
            queries = np.broadcast_to(kept[:, None, :, None], weights.shape)
            recorded = np.asarray(context.record.attention[index])
            assert relative_error(recorded[queries], weights.numpy()[queries]) <= TOLERANCE
            hidden = np.asarray(context.record.hidden[index])
            assert relative_error(hidden[kept], rows.numpy()[kept]) <= TOLERANCE
    np.testing.assert_array_equal(hidden[kept], np.asarray(context.vl_embs)[kept])


def test_recording_changes_no_bit_and_a_batch_is_its_elements(isa: str) -> None:
    # 200 observations of 9 tokens are more rows than are encoded together.
    head, _ = both(small_config(vl_num_layers=2), seed=33)
    rng = np.random.default_rng(34)
    features = rng.standard_normal((200, 9, head.config.context_dim), np.float32)
    drop_vl = rng.random((200, 9)) < 0.3
    drop_vl[0] = False
    context = head.encode(features, drop_vl=drop_vl, record=BOTH)
    np.testing.assert_array_equal(context.vl_embs, head.encode(features, drop_vl=drop_vl).vl_embs)
    for element in (0, 113, 199):
        rows = slice(element, element + 1)
        alone = head.encode(features[rows], drop_vl=drop_vl[rows], record=BOTH)
        assert alone.record is not None
        assert context.record is not None
        for name in BOTH:
            for block, array in getattr(alone.record, name).items():
                np.testing.assert_array_equal(getattr(context.record, name)[block][rows], array)


@pytest.mark.parametrize(
    ("record", "held"),
    [((), None), (("hidden",), 2 * 6 * 10), (("attention",), 2 * 2 * 6 * 6), (BOTH, 2 * 6 * (10 + 2 * 6))],
)
def test_record_is_what_was_asked_for(record: tuple[str, ...], held: int | None) -> None:
    head, _ = both(small_config(), seed=1)
    features: NDArray[np.float32] = np.ones((2, 6, 10), np.float32)
    plain, context = head.encode(features), head.encode(features, record=record)
    assert (plain.record is None, context.record is None) == (True, held is None)
    assert context.nbytes == plain.nbytes + 4 * (held or 0)


def test_a_head_without_vl_self_attention_has_an_empty_record() -> None:
    head, _ = both(small_config(use_vlln=False), seed=1)
    context = head.encode(np.ones((2, 6, 10), np.float32), record=BOTH)
    assert context.record is not None
    assert (dict(context.record.attention), dict(context.record.hidden)) == ({}, {})


def test_encode_refuses_unknown_records() -> None:
    head, _ = both(small_config(), seed=1)
    for record in ("attention", ("keys",), 1):
        with pytest.raises(saccade.InputError, match="record: expected a tuple of names among"):
            head.encode(np.ones((2, 6, 10), np.float32), record=record)  # type: ignore[arg-type]
