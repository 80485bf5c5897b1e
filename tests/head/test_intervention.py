"""Interventions in the Rust head: the properties they must have.

Where the same numbers are computed in the same order, bits are compared; elsewhere to 1e-5 * max(1, |value|).
"""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import ArrayLike, NDArray

import saccade
from saccade import Intervention
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import TOLERANCE, arrays, both, save
from tests.helpers.intervention_cases import ROWS, Head, Inputs, everything, inputs_of, small_head
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import load_released

OTHERS = ("state", "action")

# A head whose sizes all differ, on every instruction set


@pytest.fixture
def head(isa: str) -> Head:
    return small_head(isa)


@pytest.fixture
def inputs(head: Head) -> Inputs:
    return inputs_of(head)


@pytest.fixture
def learned(head: Head) -> NDArray[np.float32]:
    """The head's own future tokens."""
    _, reference = both(small_config(num_layers=4, vl_num_layers=1), seed=11)
    return reference.future_tokens.weight.detach().numpy().astype(np.float32)


def close(given_values: ArrayLike, expected: ArrayLike) -> bool:
    return relative_error(given_values, expected) <= TOLERANCE


def equal(given_values: ArrayLike, expected: ArrayLike) -> bool:
    return np.array_equal(given_values, expected)


def cut_future(*readers: str) -> Intervention:
    return Intervention(cut=[(reader, "future") for reader in readers])


def test_what_changes_nothing_changes_no_bit(head: Head, inputs: Inputs, learned: Any) -> None:
    plain = head.sample(**inputs)
    hidden = head.trace(**inputs, record=("hidden",)).hidden
    for intervention in (
        None,
        (),
        Intervention(),
        Intervention(key_bias={"future": 0.0, "vl": np.zeros(6)}),
        Intervention(future_tokens=learned),
        Intervention(patch={(2, 3): {"state": hidden[0, 0][:, :1], "future": hidden[0, 0][:, 1:5]}}),
        [
            Intervention(patch={place: dict.fromkeys(["action"], rows[:, 5:])})
            for place, rows in hidden.items()
        ],
    ):
        assert equal(head.sample(**inputs, intervention=intervention), plain)


def test_order_of_future_tokens_does_not_matter(head: Head, inputs: Inputs, learned: Any) -> None:
    permuted = head.sample(**inputs, intervention=Intervention(future_tokens=learned[[2, 0, 3, 1]]))
    assert close(permuted, head.sample(**inputs))  # I1


@pytest.mark.parametrize("copies", [2, 5])
def test_copies_of_a_token_are_one_of_more_weight(
    head: Head, inputs: Inputs, learned: Any, copies: int
) -> None:
    repeated = Intervention(future_tokens=np.concatenate([learned, *[learned[1:2]] * (copies - 1)]))
    heavier = Intervention(key_bias={("future", 1): math.log(copies)})
    actions = head.sample(**inputs, intervention=repeated)
    assert close(actions, head.sample(**inputs, intervention=heavier))  # I2
    assert not close(actions, head.sample(**inputs))


def test_equal_mass(head: Head, inputs: Inputs, learned: Any) -> None:
    one = head.sample(**inputs, intervention=Intervention(future_tokens=learned[:1]))
    many = Intervention(future_tokens=np.repeat(learned[:1], 8, axis=0))
    lighter = Intervention(key_bias={"future": -math.log(8)})
    assert close(head.sample(**inputs, intervention=[many, lighter]), one)  # I3
    heavier = Intervention(future_tokens=learned[:1], key_bias={"future": math.log(8)})
    assert close(head.sample(**inputs, intervention=many), head.sample(**inputs, intervention=heavier))


def test_future_tokens_act_through_what_state_and_actions_read(head: Head, inputs: Inputs) -> None:
    none = head.sample(**inputs, intervention=Intervention(future_tokens=np.zeros((0, head.config.width))))
    assert close(head.sample(**inputs, intervention=cut_future(*OTHERS)), none)  # I5
    half = head.sample(**inputs, intervention=cut_future("action"))
    assert not close(half, none)  # the way over the state row is still open
    limited = Intervention(cut=[(reader, "future") for reader in OTHERS], blocks=[1, 3])
    assert equal(
        head.sample(**inputs, intervention=limited),
        head.sample(**inputs, intervention=cut_future(*OTHERS)),
    )


def test_no_future_tokens_is_the_head_without_them(isa: str, tmp_path: Path) -> None:
    """I6: the same weights, and no tokens in the checkpoint."""
    head, reference = both(small_config(num_future_tokens=5), seed=3)
    config = small_config(num_future_tokens=0)
    without = random_head(config, seed=0, dtype=torch.float64)
    tensors = reference.state_dict() | {"future_tokens.weight": torch.zeros(0, head.config.width)}
    without.load_state_dict(tensors)
    save(tmp_path, without, config)
    inputs = arrays(random_inputs(head.config, 4, batch=2, num_vl_tokens=6))
    none = Intervention(future_tokens=np.zeros((0, head.config.width)))
    assert equal(head(**inputs, intervention=none), saccade.ActionHead.from_pretrained(tmp_path)(**inputs))


def test_what_future_rows_depend_on(head: Head, inputs: Inputs) -> None:
    """On the tokens and the time alone: after block 0 (I7, I13), and throughout if they read no other row."""
    others = inputs | {
        "state": inputs["state"] + 1.0,
        "noise": inputs["noise"][::-1].copy(),
        "embodiment_id": (inputs["embodiment_id"] + 1) % 3,
    }

    def future_rows(arguments: Inputs, intervention: Intervention | None = None) -> list[Any]:
        trace = head.trace(**arguments, record=("hidden",), intervention=intervention, steps=1)
        return [trace.hidden[1, block][:, trace.rows["future"]] for block in range(4)]

    same = [equal(*pair) for pair in zip(future_rows(inputs), future_rows(others), strict=True)]
    assert same == [True, False, False, False]
    alone = Intervention(cut=[("future", "state"), ("future", "action")])
    for one, other in zip(future_rows(inputs, alone), future_rows(others, alone), strict=True):
        assert equal(one, other)


def test_a_dropped_position_is_a_cut_key_where_positions_do_not_mix(isa: str) -> None:
    config = small_config(use_vlln=False)
    head, _ = both(config, seed=5)
    given_arrays = arrays(random_inputs(head.config, 6, batch=2, num_vl_tokens=6))
    dropped = np.zeros((2, 6), bool)
    dropped[:, [1, 4]] = True
    cut = Intervention(cut=[(row, ("vl", [1, 4])) for row in ROWS])
    removed = Intervention(key_bias={("vl", (1, 4)): -math.inf})
    actions = head(**given_arrays, drop_vl=dropped)
    absent = given_arrays | {"backbone_features": given_arrays["backbone_features"][:, [0, 2, 3, 5]]}
    assert equal(head(**absent), actions)
    # A removed key is still one of those that are summed over, so that only rounding differs (I9).
    assert close(head(**given_arrays, intervention=cut), actions)
    assert equal(head(**given_arrays, intervention=removed), head(**given_arrays, intervention=cut))


def test_a_row_without_keys_gets_the_output_bias(head: Head, inputs: Inputs) -> None:
    _, reference = both(small_config(num_layers=4, vl_num_layers=1), seed=11)
    blind = Intervention(cut=[("state", "vl")], blocks=[0])
    trace = head.trace(**inputs, intervention=blind, record=("attention", "hidden"), blocks=0, steps=0)
    weights = np.asarray(trace.attention[0, 0])
    assert (weights[:, :, 0] == 0).all()
    np.testing.assert_allclose(weights[:, :, 1:].sum(-1), 1, atol=1e-6)
    block: Any = reference.model.transformer_blocks[0]
    with torch.no_grad():
        state = torch.as_tensor(inputs["state"]).double().flatten(1)[:, None]
        row = reference.state_encoder(state, torch.as_tensor(inputs["embodiment_id"]))
        row = row + block.attn1.to_out[0].bias
        row = row + block.ff(torch.nn.functional.layer_norm(row, row.shape[-1:], eps=1e-5))
    assert close(np.asarray(trace.hidden[0, 0])[:, :1], row)


def test_cuts_act_in_their_heads_blocks_and_steps(head: Head, inputs: Inputs) -> None:
    cut = Intervention(cut=[("action", ("vl", [2, 5]))], heads=[1], blocks=[2], steps=[1])
    trace, plain = head.trace(**inputs, intervention=cut), head.trace(**inputs)
    for place in [(0, 0), (0, 2), (1, 0), (1, 1)]:
        assert equal(trace.attention[place], plain.attention[place])
    weights, before = np.asarray(trace.attention[1, 2]), np.asarray(plain.attention[1, 2])
    actions = trace.rows["action"]
    assert (weights[:, 1, actions][..., [2, 5]] == 0).all()
    assert (weights != 0).sum() == weights.size - 3 * 5 * 2
    assert equal(weights[:, [0, 2]], before[:, [0, 2]])
    kept = before[:, 1, actions][..., [0, 1, 3, 4]]
    assert close(weights[:, 1, actions][..., [0, 1, 3, 4]], kept / kept.sum(-1, keepdims=True))


def test_biases_of_several_add_up(head: Head, inputs: Inputs) -> None:
    per_token = np.array([0.5, -1.0, 0.25, 2.0])
    together = Intervention(key_bias={"future": per_token, "vl": -0.5, ("future", (3, 0)): [-0.5, 1.0]})
    separate = [
        Intervention(key_bias={("future", (0, 1, 2, 3)): per_token}),
        Intervention(key_bias={("vl", (5, 1, 2, 3, 4, 0)): -0.5, ("future", 3): -0.5}),
        Intervention(key_bias={("future", (0,)): np.array(1.0)}),
    ]
    actions = head.sample(**inputs, intervention=together)
    assert equal(head.sample(**inputs, intervention=separate), actions)
    assert not close(actions, head.sample(**inputs))


def test_the_later_patch_counts(head: Head, inputs: Inputs) -> None:
    rng = np.random.default_rng(0)
    first, second = rng.standard_normal((2, 4, head.config.width), np.float32)
    patched = [Intervention(patch={(1, 1): {"future": rows}}) for rows in (first, second)]
    one_row = Intervention(patch={(1, 1): {("future", (2,)): first[2:3]}})
    trace = head.trace(**inputs, intervention=[*patched, one_row], record=("hidden",), steps=1, blocks=1)
    expected = np.concatenate([second[:2], first[2:3], second[3:]])
    for element in range(3):
        assert equal(np.asarray(trace.hidden[1, 1])[element, trace.rows["future"]], expected)


@pytest.mark.parametrize("block", [0, 1, 2, 3])
def test_all_rows_patched_are_the_other_run(head: Head, inputs: Inputs, block: int) -> None:
    """Activation patching: what comes after a block depends on its rows alone."""
    other = inputs | {"state": inputs["state"] * 2.0 - 1.0}
    source = head.trace(**other, record=("hidden",), num_steps=1, blocks=block)
    rows = np.asarray(source.hidden[0, block])
    patch = Intervention(patch={(0, block): {group: rows[:, source.rows[group]] for group in ROWS}})
    assert equal(head.sample(**inputs, num_steps=1, intervention=patch), source.actions)
    assert not close(head.sample(**inputs, num_steps=1), source.actions)


def test_velocity_is_step_0(head: Head, inputs: Inputs) -> None:
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((1, head.config.width), np.float32)
    given_interventions = [
        Intervention(cut=[("action", "future")], steps=[0], key_bias={"state": 1.0}),
        Intervention(patch={(0, 1): {"state": rows}}),
    ]
    arguments = {name: inputs[name] for name in ("context", "state", "embodiment_id")}
    velocity = head.velocity(
        **arguments, actions=inputs["noise"], timestep=0, intervention=given_interventions
    )
    stepped = inputs["noise"] + np.asarray(velocity)
    assert equal(head.sample(**inputs, num_steps=1, intervention=given_interventions), stepped)
    late = Intervention(cut=[("action", "vl")], steps=[1])
    with pytest.raises(saccade.InputError, match="steps: expected 0 to 0, got 1"):
        head.velocity(**arguments, actions=inputs["noise"], timestep=0, intervention=late)


def element_of(given_interventions: list[Intervention], element: int) -> list[Intervention]:
    """The same for one element of the batch."""

    def one_of(rows: Any) -> Any:
        return rows[element : element + 1] if rows.ndim == 3 else rows

    patch: Any = given_interventions[-1].patch
    alone = {place: {of: one_of(rows) for of, rows in groups.items()} for place, groups in patch.items()}
    return [*given_interventions[:-1], Intervention(patch=alone)]


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
    dropped = np.array([[False] * 8, [True, True] + [False] * 6, [True] * 8])
    state = rng.standard_normal((3, config.state_dim), np.float32)
    noise = rng.standard_normal((3, 2, config.action_horizon, config.encoder_action_dim), np.float32)
    changes = everything(head, 3)

    def chunks(of: Head, **options: Any) -> Any:
        context = of.encode(features, drop_vl=dropped)
        return of.sample(context, state, 1, intervention=changes, **options)

    together = chunks(head, noise=noise, num_samples=2)
    assert np.isfinite(together).all()
    assert equal(chunks(heads[1], noise=noise, num_samples=2), together)
    for sample in range(2):
        assert equal(chunks(head, noise=noise[:, sample].copy()), together[:, sample])
    for element in range(3):
        rows = slice(element, element + 1)
        context = head.encode(features[rows], drop_vl=dropped[rows])
        alone = element_of(changes, element)
        one = head.sample(context, state[rows], 1, noise=noise[rows, 0], intervention=alone)
        assert equal(one, together[rows, 0])


def test_many_threads_share_an_intervention(head: Head, inputs: Inputs) -> None:
    changes = everything(head, 3)
    expected, wrong = head.sample(**inputs, intervention=changes), []

    def work() -> None:
        for _ in range(10):
            if not equal(head.sample(**inputs, intervention=changes), expected):
                wrong.append(threading.get_ident())

    workers = [threading.Thread(target=work) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


def test_torch_arrays(head: Head, inputs: Inputs) -> None:
    rows = torch.randn(1, head.config.width, generator=torch.Generator().manual_seed(0)).bfloat16()
    as_torch = Intervention(
        key_bias={"future": torch.arange(4.0)},
        patch={(0, 0): {"state": rows}},
        future_tokens=torch.ones(4, head.config.width),
    )
    as_numpy = Intervention(
        key_bias={"future": np.arange(4.0)},
        patch={(0, 0): {"state": rows.float().numpy()}},
        future_tokens=np.ones((4, head.config.width), order="F"),
    )
    assert equal(head.sample(**inputs, intervention=as_torch), head.sample(**inputs, intervention=as_numpy))
