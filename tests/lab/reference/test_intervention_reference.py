"""Interventions and traces of the torch reference, against loops over rows and heads."""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator, union-attr"

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from saccade import Intervention
from tests.helpers.intervention_loops import (
    EVERY_READER,
    NUM_VL_TOKENS,
    Loops,
    assert_close,
    head_and_inputs,
    random_interventions,
)


@pytest.mark.parametrize("seed", range(12))
def test_random_interventions_equal_loops(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    interventions = random_interventions(seed, batch=2, num_steps=2)
    drop_vl = np.random.default_rng(seed).random((2, NUM_VL_TOKENS)) < 0.3 if seed % 3 == 0 else None
    expected = Loops(head, inputs, interventions, drop_vl=drop_vl)
    options: dict[str, Any] = {"num_steps": 2, "intervention": interventions, "drop_vl": drop_vl}
    with torch.no_grad():
        trace = head.trace(**inputs, **options, record=("attention", "hidden"))
        assert_close(head.sample(**inputs, **options), expected.actions)
    assert_close(trace.actions, expected.actions)
    assert trace.attention.keys() == trace.hidden.keys() == expected.hidden.keys()
    for place, hidden in expected.hidden.items():
        assert_close(trace.hidden[place], torch.as_tensor(hidden))
        attention = torch.as_tensor(expected.attention[place])
        assert_close(trace.attention[place], attention)
        assert ((trace.attention[place] == 0) == (attention == 0)).all()  # removed is exactly zero


# Traces


def test_trace_keeps_what_is_asked_for_where_it_is_asked_for() -> None:
    head, inputs = head_and_inputs()
    everywhere = {(step, block) for step in range(3) for block in range(4)}
    trace = head.trace(**inputs)
    assert trace.attention.keys() == everywhere
    assert trace.hidden == {}
    assert trace.rows == {"state": slice(0, 1), "future": slice(1, 5), "action": slice(5, 10)}
    for (_, block), attention in trace.attention.items():
        assert attention.shape == (2, 3, 10, NUM_VL_TOKENS if block % 2 == 0 else 10)
        assert_close(attention.sum(-1), torch.ones(2, 3, 10).double())
    trace = head.trace(**inputs, record=["hidden"], blocks=[3, 0], steps=1)
    assert trace.hidden.keys() == {(1, 0), (1, 3)}
    assert trace.attention == {}
    assert trace.hidden[1, 3].shape == (2, 10, 12)
    trace = head.trace(**inputs, blocks=range(2), steps=[0])
    assert trace.attention.keys() == {(0, 0), (0, 1)}
    assert head.trace(**inputs, blocks=()).attention == {}


def test_trace_changes_nothing() -> None:
    head, inputs = head_and_inputs()
    expected = head.sample(**inputs)
    assert torch.equal(head.trace(**inputs, record=("hidden",)).actions, expected)
    assert_close(head.trace(**inputs).actions, expected)  # the attention is written out: rounding


def test_rows_of_a_trace_follow_the_future_tokens_given() -> None:
    head, inputs = head_and_inputs()
    seven = Intervention(future_tokens=np.ones((7, 12), np.float32))
    trace = head.trace(**inputs, intervention=seven)
    assert trace.rows == {"state": slice(0, 1), "future": slice(1, 8), "action": slice(8, 13)}
    assert trace.attention[0, 1].shape == (2, 3, 13, 13)


def test_gradients_flow_through_what_was_traced() -> None:
    head, inputs = head_and_inputs(num_layers=2)
    vl_embs = inputs.pop("vl_embs").requires_grad_()

    def traced(vl_embs: Tensor) -> Tensor:
        trace = head.trace(vl_embs, **inputs, num_steps=2, record=("attention", "hidden"))
        return torch.cat([t.flatten() for t in (*trace.attention.values(), *trace.hidden.values())]).sin()

    assert torch.autograd.gradcheck(traced, (vl_embs,), fast_mode=True)
    trace = head.trace(vl_embs, **inputs, record=("attention", "hidden"))
    loss = trace.actions.square().sum()
    kept = [trace.hidden[0, 0], trace.attention[0, 1], head.future_tokens.weight]
    for gradient in torch.autograd.grad(loss, kept):
        assert gradient.isfinite().all()
        assert gradient.any()


# Cuts and patches


def test_a_row_with_no_key_left_gets_the_output_bias_and_finite_gradients() -> None:
    head, inputs = head_and_inputs()
    everyone = Intervention(cut=[(reader, "vl") for reader in EVERY_READER], blocks=0)
    trace = head.trace(**inputs, intervention=everyone, record=("attention", "hidden"))
    assert not trace.attention[0, 0].any()
    assert trace.attention[0, 2].any()
    block: Any = head.model.transformer_blocks[0]
    future = head.future_tokens.weight + block.attn1.to_out[0].bias
    future = future + block.ff(torch.nn.functional.layer_norm(future, (12,), eps=1e-5))
    assert_close(trace.hidden[0, 0][:, trace.rows["future"]], future.expand(2, -1, -1))
    trace.actions.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in head.parameters())


def test_removing_all_tokens_leaves_the_same() -> None:
    head, inputs = head_and_inputs()
    blind = Intervention(cut=[(reader, "vl") for reader in EVERY_READER])
    with torch.no_grad():
        dropped = head.sample(**inputs, drop_vl=np.ones((2, NUM_VL_TOKENS), bool))
        assert_close(dropped, head.sample(**inputs, intervention=blind))


def test_what_acts_in_some_of_its_blocks_is_fine() -> None:
    head, inputs = head_and_inputs()
    with torch.no_grad():
        some = head.sample(**inputs, intervention=Intervention(cut=[("action", "vl")], blocks=[0, 1, 3]))
        cross = head.sample(**inputs, intervention=Intervention(cut=[("action", "vl")], blocks=[0]))
        assert torch.equal(some, cross)
        assert not torch.equal(some, head.sample(**inputs))
        nothing = [Intervention(), Intervention(key_bias={"future": 0.0})]
        assert torch.equal(head.sample(**inputs, intervention=nothing), head.sample(**inputs))


def test_steps_limit_cuts_and_biases() -> None:
    head, inputs = head_and_inputs()
    later = Intervention(cut=[("action", "vl")], key_bias={"future": 1.0}, steps=[1, 2])
    with torch.no_grad():
        plain = head.trace(**inputs, record=("attention", "hidden"))
        changed = head.trace(**inputs, intervention=later, record=("attention", "hidden"))
    for block in range(4):
        assert_close(changed.hidden[0, block], plain.hidden[0, block])
        assert (changed.hidden[1, block] - plain.hidden[1, block]).abs().max() > 1e-6


def test_patching_a_run_with_its_own_rows_changes_no_bit() -> None:
    head, inputs = head_and_inputs()
    head = head.float()
    inputs = {name: t.float() if t.is_floating_point() else t for name, t in inputs.items()}
    with torch.no_grad():
        trace = head.trace(**inputs, record=("hidden",))
        for place, rows in trace.hidden.items():
            for group in EVERY_READER:
                patch = Intervention(patch={place: {group: rows[:, trace.rows[group]]}})
                assert torch.equal(head.sample(**inputs, intervention=patch), trace.actions)


@pytest.mark.parametrize("block", range(4))
def test_patching_all_rows_reproduces_the_rest_of_the_other_run(block: int) -> None:
    head, inputs = head_and_inputs()
    head = head.float()
    inputs = {name: t.float() if t.is_floating_point() else t for name, t in inputs.items()}
    other = inputs | {"state": -inputs["state"], "noise": inputs["noise"].flip(0)}
    with torch.no_grad():
        mine = head.trace(**inputs, num_steps=1, record=("hidden",))
        patch: Any = {
            (0, block): {group: mine.hidden[0, block][:, where] for group, where in mine.rows.items()}
        }
        patched = head.trace(**other, num_steps=1, record=("hidden",), intervention=Intervention(patch=patch))
    for later in range(block, 4):
        assert torch.equal(patched.hidden[0, later], mine.hidden[0, later])
    velocity = mine.actions - inputs["noise"]
    assert_close(patched.actions - other["noise"], velocity, tolerance=1e-5)  # noise added and taken away


def test_the_last_patch_of_a_row_counts() -> None:
    head, inputs = head_and_inputs()
    first, second = np.zeros((4, 12), np.float32), np.ones((1, 12), np.float32)
    given = (
        Intervention(patch={(0, 1): {"future": first}}),
        Intervention(patch={(0, 1): {("future", 2): second}}),
    )
    expected = [[0.0], [0.0], [1.0], [0.0]]
    rows = head.trace(**inputs, intervention=given, record=("hidden",)).hidden[0, 1][:, 1:5]
    assert torch.equal(rows, torch.tensor(expected).double().expand(2, -1, 12))
    rows = head.trace(**inputs, intervention=given[::-1], record=("hidden",)).hidden[0, 1][:, 1:5]
    assert not rows.any()


def test_velocity_is_step_0_of_1() -> None:
    head, inputs = head_and_inputs()
    noise = inputs.pop("noise")
    one = Intervention(cut=[("action", "vl")], steps=0, patch={(0, 1): {"state": np.ones((1, 12))}})
    with torch.no_grad():
        velocity = head.velocity(**inputs, actions=noise, timestep=0, intervention=one)
        sampled = head.sample(**inputs, noise=noise, num_steps=1, intervention=one)
    assert_close(noise + velocity, sampled)
