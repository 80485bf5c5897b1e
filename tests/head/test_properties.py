"""Properties that hold exactly for this architecture with any weights.

Each is the ground of something that the engine saves or that an experiment with future tokens relies on. All
in float64, so that what is left is rounding.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, operator, union-attr"

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from saccade import Intervention
from saccade_lab.reference import ActionHead
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.intervention_loops import assert_close
from tests.helpers.reference_cases import small_config

small_settings = settings(max_examples=10, deadline=None)
seeds = st.integers(0, 2**31 - 1)
NOT_READ = Intervention(cut=[("state", "future"), ("action", "future")])
NO_TOKENS = Intervention(future_tokens=np.empty((0, 12), np.float32))


def head_and_inputs(seed: int, *, batch: int = 2, **config: Any) -> tuple[ActionHead, dict[str, Tensor]]:
    head = random_head(small_config(**config), seed, dtype=torch.float64)
    inputs = random_inputs(head.config, seed + 1, batch=batch, num_vl_tokens=6)
    return head, {name: t.double() if t.is_floating_point() else t for name, t in inputs.items()}


def run(head: ActionHead, inputs: dict[str, Tensor], *interventions: Intervention, **options: Any) -> Tensor:
    with torch.no_grad():
        return head(**inputs, intervention=interventions, **options)


def learned(head: ActionHead) -> np.ndarray:
    """The head's future tokens, which `random_head` draws in float32."""
    return head.future_tokens.weight.detach().float().numpy()


def biased(tokens: Any, bias: float) -> list[Intervention]:
    """A bias exact to 1e-14 where one float32 is exact to 1e-8: biases of several interventions add up."""
    coarse = float(np.float32(bias))
    return [Intervention(key_bias={tokens: coarse}), Intervention(key_bias={tokens: bias - coarse})]


# Future tokens: order, number, weight


@small_settings
@given(seed=seeds, permutation=st.permutations(range(4)))
def test_order_of_future_tokens_does_not_matter(seed: int, permutation: list[int]) -> None:
    head, inputs = head_and_inputs(seed)
    permuted = Intervention(future_tokens=learned(head)[permutation])
    assert_close(run(head, inputs, permuted), run(head, inputs))


@small_settings
@given(seed=seeds, copies=st.integers(2, 5))
def test_copies_of_a_token_equal_one_with_a_larger_logit(seed: int, copies: int) -> None:
    head, inputs = head_and_inputs(seed, num_future_tokens=3)
    tokens = learned(head)
    repeated = Intervention(future_tokens=tokens[[0, 1, 2, *[1] * (copies - 1)]])
    assert_close(run(head, inputs, *biased(("future", 1), math.log(copies))), run(head, inputs, repeated))


@small_settings
@given(seed=seeds, copies=st.integers(2, 40))
def test_copies_of_one_token_are_one_token_of_that_weight(seed: int, copies: int) -> None:
    head, inputs = head_and_inputs(seed)
    one = Intervention(future_tokens=learned(head)[:1])
    many = Intervention(future_tokens=learned(head)[[0] * copies])
    assert_close(run(head, inputs, one, *biased("future", math.log(copies))), run(head, inputs, many))


@small_settings
@given(seed=seeds, copies=st.integers(2, 5))
def test_with_equal_mass_the_number_of_copies_does_not_matter(seed: int, copies: int) -> None:
    head, inputs = head_and_inputs(seed)
    repeated = Intervention(future_tokens=np.repeat(learned(head), copies, axis=0))
    expected = run(head, inputs)
    assert_close(run(head, inputs, repeated, *biased("future", -math.log(copies))), expected)
    assert (run(head, inputs, repeated) - expected).abs().max() > 1e-6  # their mass alone changes the result


@small_settings
@given(seed=seeds)
def test_no_future_tokens_run_with_the_same_weights(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    without, _ = head_and_inputs(seed, num_future_tokens=0)
    assert without.state_dict()["future_tokens.weight"].shape == (0, 12)
    names = head.state_dict().keys() - {"future_tokens.weight"}
    without.load_state_dict({name: head.state_dict()[name] for name in names}, strict=False)
    assert torch.equal(run(without, inputs), run(head, inputs, NO_TOKENS))
    # And tokens put into a head that has none are those of the head that has them.
    put_in = Intervention(future_tokens=learned(head))
    assert torch.equal(run(without, inputs, put_in), run(head, inputs))


# Ways to the actions


@small_settings
@given(seed=seeds)
def test_future_tokens_act_only_through_what_state_and_actions_read(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    none_left = run(head, inputs, NO_TOKENS)
    assert_close(run(head, inputs, NOT_READ), none_left)
    assert_close(run(head, inputs, Intervention(cut=NOT_READ.cut, blocks=[1, 3])), none_left)
    actions_only = run(head, inputs, Intervention(cut=[("action", "future")]))
    assert (actions_only - none_left).abs().max() > 1e-6  # the way over the state row is still open


@small_settings
@given(seed=seeds)
def test_blind_future_tokens_tell_nothing_of_the_image(seed: int) -> None:
    """With all vision through the future tokens, blinding them makes the actions blind."""
    head, inputs = head_and_inputs(seed)
    through_future = Intervention(cut=[("state", "vl"), ("action", "vl")])
    other = inputs | {"backbone_features": inputs["backbone_features"].flip(-1)}
    assert (run(head, inputs, through_future) - run(head, other, through_future)).abs().max() > 1e-6
    blind = Intervention(cut=[("future", "vl")])
    assert_close(run(head, inputs, through_future, blind), run(head, other, through_future, blind))


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
def test_first_block_gives_future_rows_that_know_only_image_and_time(seed: int) -> None:
    """So in block 1 their keys and values are the same for every state, noise and embodiment."""
    head, inputs = head_and_inputs(seed)
    keys_and_values = []
    for block in (1, 3):
        for projection in (
            head.model.transformer_blocks[block].attn1.to_k,
            head.model.transformer_blocks[block].attn1.to_v,
        ):
            projection.register_forward_hook(lambda module, args, out: keys_and_values.append(out[:, 1:5]))
    vl_embs = head.encode(inputs.pop("backbone_features"))
    hidden = []
    others: dict[str, Any] = {
        "state": -inputs["state"],
        "noise": inputs["noise"].flip(0),
        "embodiment_id": 1,
    }
    for given_inputs in (inputs, others):
        with torch.no_grad():
            hidden.append(head.trace(vl_embs, **given_inputs, num_steps=1, record=["hidden"]).hidden)
    for rows, same in ((slice(1, 5), True), (slice(0, 1), False), (slice(5, 10), False)):
        difference = (hidden[0][0, 0] - hidden[1][0, 0])[:, rows].abs().max()
        assert (difference < 1e-12) == same
    first, other = keys_and_values[:4], keys_and_values[4:]
    assert_close(first[0], other[0])
    assert_close(first[1], other[1])
    assert (first[2] - other[2]).abs().max() > 1e-6  # in block 3 they know more
    assert (first[3] - other[3]).abs().max() > 1e-6


@small_settings
@given(seed=seeds)
def test_all_cross_blocks_leave_action_rows_alone_with_the_image(seed: int) -> None:
    head, inputs = head_and_inputs(seed, interleave=False)
    changed = inputs | {"state": inputs["state"] + 1.0}
    assert_close(run(head, changed), run(head, inputs))
    assert_close(run(head, inputs, NO_TOKENS), run(head, inputs))


# Vision-language tokens


@small_settings
@given(seed=seeds, dropped=st.sets(st.integers(0, 5), min_size=1, max_size=5))
def test_dropped_tokens_are_as_if_they_had_not_been_there(seed: int, dropped: set[int]) -> None:
    head, inputs = head_and_inputs(seed)
    kept = [token for token in range(6) if token not in dropped]
    drop_vl = torch.tensor([token in dropped for token in range(6)]).expand(2, -1)
    shorter = inputs | {"backbone_features": inputs["backbone_features"][:, kept]}
    assert_close(run(head, inputs, drop_vl=drop_vl), run(head, shorter))
    vl_embs = head.encode(inputs["backbone_features"], drop_vl=drop_vl)
    assert_close(vl_embs[:, kept], head.encode(shorter["backbone_features"]))
    assert not vl_embs[:, list(dropped)].any()


@small_settings
@given(seed=seeds, dropped=st.sets(st.integers(0, 5), min_size=1, max_size=5))
def test_removed_keys_are_removed_alike_in_every_way(seed: int, dropped: set[int]) -> None:
    """In the transformer alone: taken out, dropped, cut, or with a bias of minus infinity."""
    head, tensors = head_and_inputs(seed)
    inputs: dict[str, Any] = tensors
    kept = [token for token in range(6) if token not in dropped]
    with torch.no_grad():
        vl_embs = head.encode(inputs.pop("backbone_features"))
        taken_out = head.sample(vl_embs[:, kept], **inputs)
        drop_vl = torch.tensor([token in dropped for token in range(6)]).expand(2, -1)
        assert_close(head.sample(vl_embs, **inputs, drop_vl=drop_vl), taken_out)
        tokens = ("vl", tuple(dropped))
        for way in (
            Intervention(cut=[(reader, tokens) for reader in ("state", "future", "action")]),
            Intervention(key_bias={tokens: -np.inf}),
        ):
            assert_close(head.sample(vl_embs, **inputs, intervention=way), taken_out)


@small_settings
@given(seed=seeds)
def test_order_of_vision_language_tokens_does_not_matter(seed: int) -> None:
    head, inputs = head_and_inputs(seed)
    flipped = inputs | {"backbone_features": inputs["backbone_features"].flip(1)}
    assert_close(run(head, flipped), run(head, inputs))


# Batches


def change_nothing(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return inputs


def change_other_rows(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.cat((t[:1], t[1:].flip(0))) for name, t in inputs.items()}


def interventions_of_all_kinds() -> Iterable[Intervention]:
    draw = np.random.default_rng(0).standard_normal
    yield Intervention(cut=[("future", ("vl", [0, 3]))], key_bias={"future": draw(5)}, heads=[0, 2])
    yield Intervention(patch={(1, 2): {"action": draw((5, 12))}}, future_tokens=draw((5, 12)))


@pytest.mark.parametrize("change", [change_nothing, change_other_rows])
@small_settings
@given(seed=seeds)
def test_rows_of_a_batch_do_not_mix(
    change: Callable[[dict[str, Tensor]], dict[str, Tensor]], seed: int
) -> None:
    head, inputs = head_and_inputs(seed, batch=3)
    first = {name: tensor[:1] for name, tensor in inputs.items()}
    for interventions in ((), tuple(interventions_of_all_kinds())):
        together = run(head, change(inputs), *interventions)
        assert_close(together[:1], run(head, first, *interventions))
