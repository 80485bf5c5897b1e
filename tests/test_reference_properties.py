"""Properties that hold exactly for this architecture, whatever the weights.

Each is the ground of something that the engine saves or that an experiment with future tokens may rely on.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, operator, union-attr"

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_cases import small_config
from torch import Tensor

from saccade.reference import ActionHead
from saccade.reference.random_weights import random_head, random_inputs

small_settings = settings(max_examples=15, deadline=None)
seeds = st.integers(0, 2**31 - 1)


def assert_close(given: Tensor, expected: Tensor, tolerance: float = 1e-11) -> None:
    torch.testing.assert_close(given, expected, rtol=tolerance, atol=tolerance)


def head_and_inputs(seed: int, *, batch: int = 2, **config: Any) -> tuple[ActionHead, dict[str, Tensor]]:
    head = random_head(small_config(**config), seed, dtype=torch.float64)
    inputs = random_inputs(head.config, seed + 1, batch=batch, num_vl_tokens=6)
    return head, {name: t.double() if t.is_floating_point() else t for name, t in inputs.items()}


def run(head: ActionHead, inputs: dict[str, Tensor]) -> Tensor:
    with torch.no_grad():
        return head(**inputs)


def with_future_tokens(head: ActionHead, tokens: Tensor, logit_bias: Tensor | None = None) -> ActionHead:
    """The same weights with other future tokens, and a bias on the logits of every self-attention block."""
    head.future_tokens.weight = torch.nn.Parameter(tokens)
    if logit_bias is not None:
        for block in head.model.transformer_blocks:
            if not block.is_cross:
                block.attn1.forward = functools.partial(block.attn1.forward, logit_bias=logit_bias)
    return head


def cut(num_rows: int, readers: Iterable[int], sources: Iterable[int]) -> Tensor:
    """A bias that hides the rows `sources` from the rows `readers`, (num_rows, num_rows)."""
    bias = torch.zeros(num_rows, num_rows, dtype=torch.float64)
    for reader in readers:
        bias[reader, list(sources)] = -torch.inf
    return bias


@small_settings
@given(seed=seeds, permutation=st.permutations(range(4)))
def test_order_of_future_tokens_does_not_matter(seed: int, permutation: list[int]) -> None:
    head, inputs = head_and_inputs(seed)
    expected = run(head, inputs)
    permuted = with_future_tokens(head, head.future_tokens.weight[permutation].detach())
    assert_close(run(permuted, inputs), expected)


@small_settings
@given(seed=seeds, copies=st.integers(2, 5))
def test_copies_of_a_token_equal_one_with_a_larger_logit(seed: int, copies: int) -> None:
    head, inputs = head_and_inputs(seed, num_future_tokens=3)
    tokens = head.future_tokens.weight.detach()
    repeated = torch.cat((tokens, tokens[1:2].expand(copies - 1, -1)))
    expected = run(with_future_tokens(head, repeated), inputs)
    bias = torch.zeros(1 + 3 + head.config.action_horizon, dtype=torch.float64)
    bias[1 + 1] = math.log(copies)
    assert_close(run(with_future_tokens(head, tokens, bias), inputs), expected)


@small_settings
@given(seed=seeds)
def test_last_block_is_needed_for_the_action_rows_only(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    model, last = head.model, head.model.transformer_blocks[-1]
    assert not last.is_cross
    horizon = head.config.action_horizon
    rows = torch.randn(
        2, 1 + 4 + horizon, head.config.width, generator=torch.Generator().manual_seed(seed)
    ).double()
    temb = model.timestep_encoder(torch.tensor([250, 907]))
    expected = model.output(last(rows, inputs["backbone_features"], temb), temb)[:, -horizon:]

    y = last.norm1(rows, temb)
    attended, _ = last.attn1(y[:, -horizon:], y)
    action_rows = rows[:, -horizon:] + attended
    action_rows = action_rows + last.ff(
        torch.nn.functional.layer_norm(action_rows, action_rows.shape[-1:], eps=1e-5)
    )
    assert_close(model.output(action_rows, temb), expected)


@small_settings
@given(seed=seeds)
def test_future_tokens_act_only_through_what_state_and_actions_read(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    num_rows, future = 1 + 4 + head.config.action_horizon, range(1, 5)
    others = [row for row in range(num_rows) if row not in future]
    none_left = run(with_future_tokens(head, head.future_tokens.weight[:0].detach()), inputs)
    head, _ = head_and_inputs(seed)
    tokens = head.future_tokens.weight.detach()
    isolated = with_future_tokens(head, tokens, cut(num_rows, others, future))
    assert_close(run(isolated, inputs), none_left)
    head, _ = head_and_inputs(seed)
    actions_only = with_future_tokens(head, tokens, cut(num_rows, range(5, num_rows), future))
    assert (
        run(actions_only, inputs) - none_left
    ).abs().max() > 1e-6  # the way over the state row is still open


@small_settings
@given(seed=seeds)
def test_no_future_tokens_run_with_the_same_weights(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    without, _ = head_and_inputs(seed, num_future_tokens=0)
    assert without.state_dict()["future_tokens.weight"].shape == (0, 12)
    names = head.state_dict().keys() - {"future_tokens.weight"}
    without.load_state_dict({name: head.state_dict()[name] for name in names}, strict=False)
    emptied = with_future_tokens(head, head.future_tokens.weight[:0].detach())
    assert_close(run(without, inputs), run(emptied, inputs), tolerance=0.0)


@small_settings
@given(seed=seeds)
def test_first_block_gives_future_rows_that_know_only_image_and_time(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    seen = []
    head.model.transformer_blocks[0].register_forward_hook(
        lambda module, args, out: seen.append(out[:, 1:5].detach())
    )
    run(head, inputs)
    other = inputs | {
        "state": -inputs["state"],
        "noise": inputs["noise"].flip(0),
        "embodiment_id": torch.tensor([1, 1]),
    }
    run(head, other)
    steps = head.config.num_steps
    for step in range(steps):
        assert_close(seen[step], seen[steps + step])


def change_nothing(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return inputs


def change_other_rows(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.cat((t[:1], t[1:].flip(0))) for name, t in inputs.items()}


@pytest.mark.parametrize("change", [change_nothing, change_other_rows])
@small_settings
@given(seed=seeds)
def test_rows_of_a_batch_do_not_mix(
    change: Callable[[dict[str, Tensor]], dict[str, Tensor]], seed: int
) -> None:
    head, inputs = head_and_inputs(seed, batch=3)
    alone = run(head, {name: tensor[:1] for name, tensor in inputs.items()})
    assert_close(run(head, change(inputs))[:1], alone)


@small_settings
@given(seed=seeds)
def test_order_of_vision_language_tokens_does_not_matter(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    flipped = inputs | {"backbone_features": inputs["backbone_features"].flip(1)}
    assert_close(run(head, flipped), run(head, inputs))


@small_settings
@given(seed=seeds)
def test_all_cross_blocks_leave_action_rows_alone_with_the_image(seed: int) -> None:
    head, inputs = head_and_inputs(seed, interleave=False)
    changed = inputs | {"state": inputs["state"] + 1.0}
    assert_close(run(head, changed), run(head, inputs))
