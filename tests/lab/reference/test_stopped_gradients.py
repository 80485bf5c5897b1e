"""Gradients of the torch reference that stop at chosen edges, against finite differences of loops."""

from typing import Any

import pytest
import torch
from torch import Tensor

from saccade import Intervention
from saccade_lab.reference import ActionHead
from tests.helpers.intervention_loops import (
    EVERY_READER,
    Loops,
    assert_close,
    head_and_inputs,
    random_interventions,
)

STOPS: list[list[Any]] = [
    [("state", "future"), ("action", "future")],
    [("future", "vl")],
    [(("action", [1, 3]), ("vl", [0, 2, 5])), ("future", ("action", [0]))],
    [("state", "state"), ("action", "action"), ("action", "vl")],
]


def gradient(head: ActionHead, inputs: dict[str, Any], stop: Any, of: Tensor, **options: Any) -> Tensor:
    actions = head.sample(**inputs, num_steps=2, stop_gradient=stop, **options)
    weights = torch.linspace(-1, 1, actions.numel()).double().view(actions.shape)
    return torch.autograd.grad((weights * actions).sum(), of)[0]


@pytest.mark.parametrize("stop", STOPS)
def test_stopped_edges_are_constants_in_the_gradient(stop: list[Any]) -> None:
    """Finite differences of a run whose stopped edges read the keys and values of a run that is not moved."""
    head, inputs = head_and_inputs()
    interventions = random_interventions(1, batch=2, num_steps=2)
    edges = Intervention(cut=stop).cut
    base = Loops(head, inputs, interventions)
    vl_embs = inputs["vl_embs"].clone().requires_grad_()
    given = gradient(head, inputs | {"vl_embs": vl_embs}, stop, vl_embs, intervention=interventions)
    weights = torch.linspace(-1, 1, base.actions.numel()).double().view(base.actions.shape)
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        direction = torch.randn(vl_embs.shape, generator=generator).double()
        sides = []
        for step in (1e-5, -1e-5):
            moved = inputs | {"vl_embs": inputs["vl_embs"] + step * direction}
            run = Loops(head, moved, interventions, stopped=edges, frozen=base)
            sides.append((weights * run.actions).sum())
        slope = (sides[0] - sides[1]) / 2e-5
        assert_close((given * direction).sum(), slope, tolerance=1e-7)


@pytest.mark.parametrize("stop", STOPS)
def test_stopping_gradients_changes_no_bit_of_the_result(stop: list[Any]) -> None:
    head, inputs = head_and_inputs()
    with torch.no_grad():
        expected = head.trace(**inputs)
        given = head.trace(**inputs, stop_gradient=stop)
        assert torch.equal(given.actions, expected.actions)
        for place, attention in expected.attention.items():
            assert torch.equal(given.attention[place], attention)


def test_no_gradient_is_left_where_all_ways_are_stopped() -> None:
    head, inputs = head_and_inputs()
    vl_embs = inputs["vl_embs"].requires_grad_()
    assert not gradient(head, inputs, [(reader, "vl") for reader in EVERY_READER], vl_embs).any()
    left = gradient(head, inputs, [(reader, ("vl", [0, 4])) for reader in EVERY_READER], vl_embs)
    assert not left[:, [0, 4]].any()
    assert left[:, [1, 2, 3, 5]].any(dim=2).all()
    tokens = head.future_tokens.weight
    assert not gradient(head, inputs, STOPS[0], tokens).any()
    assert gradient(head, inputs, [("action", "future")], tokens).any()  # the way over the state row is open


def test_gradients_by_way_of_entry_add_up() -> None:
    head, inputs = head_and_inputs()
    vl_embs = inputs["vl_embs"].requires_grad_()
    parts = [
        gradient(head, inputs, [(other, "vl") for other in EVERY_READER if other != reader], vl_embs)
        for reader in EVERY_READER
    ]
    assert all(part.any() for part in parts)
    assert_close(sum(parts[1:], parts[0]), gradient(head, inputs, (), vl_embs))


def test_gradient_without_future_rows_is_that_of_a_head_that_reads_constants() -> None:
    """With one step and two blocks the only way over the future rows is one edge, which can be counted."""
    head, inputs = head_and_inputs(num_layers=2)
    vl_embs = inputs["vl_embs"].requires_grad_()
    total = gradient(head, inputs, (), vl_embs)
    direct = gradient(head, inputs, STOPS[0], vl_embs)
    through_future = gradient(head, inputs, [("state", "vl"), ("action", "vl")], vl_embs)
    assert_close(total - direct, through_future)
