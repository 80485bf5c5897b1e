"""Interventions in the Rust head: against the torch reference in float64, and the properties they must have.

Properties I1 to I13 are those of section 6 of the specification. Where the same numbers are computed in the
same order, bits are compared; elsewhere to 1e-5 * max(1, |value|).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from engine_cases import TAME, TOLERANCE, arrays, both, configs, save
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from reference_cases import relative_error, small_config
from released import load_released

import saccade
from saccade import Intervention
from saccade.config import HeadConfig
from saccade.reference import ActionHead as Reference
from saccade.reference.random_weights import random_head, random_inputs

OTHERS = ("state", "action")
ROWS = ("state", "future", "action")


@dataclass(frozen=True)
class Sizes:
    """What the indices of an intervention may point to."""

    config: HeadConfig
    batch: int
    num_vl_tokens: int
    num_steps: int
    num_future: int

    def count(self, group: str) -> int:
        """Tokens of a group."""
        counts = {"state": 1, "future": self.num_future, "action": self.config.action_horizon}
        return counts.get(group, self.num_vl_tokens)


def some_indices(count: int) -> st.SearchStrategy[tuple[int, ...]]:
    return st.lists(st.integers(0, count - 1), unique=True, min_size=1, max_size=4).map(tuple)


def tokens(sizes: Sizes, groups: Sequence[str]) -> st.SearchStrategy[Any]:
    """A group that has tokens, or some of them."""
    group = st.sampled_from([name for name in groups if sizes.count(name) > 0])
    return group | group.flatmap(lambda name: st.tuples(st.just(name), some_indices(sizes.count(name))))


@st.composite
def interventions(draw: st.DrawFn, sizes: Sizes) -> Intervention:
    """Cuts, biases and patches of whole groups and of single tokens, everywhere or not."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31 - 1)))

    def count(chosen: Any) -> int:
        return sizes.count(chosen) if isinstance(chosen, str) else len(chosen[1])

    def bias(chosen: Any) -> float | NDArray[np.float32]:
        if draw(st.booleans()):
            return draw(st.sampled_from([-math.inf, -1.5, 0.0, 0.7, 2.0]))
        values = rng.standard_normal(count(chosen)).astype(np.float32)
        return np.where(rng.random(values.shape) < 0.2, np.float32(-np.inf), values)

    def rows(chosen: Any) -> NDArray[np.float32]:
        batch = (sizes.batch,) if draw(st.booleans()) else ()
        return rng.standard_normal((*batch, count(chosen), sizes.config.width)).astype(np.float32)

    def limit(count: int) -> tuple[int, ...] | None:
        return draw(st.none() | some_indices(count))

    config = sizes.config
    pairs = st.tuples(tokens(sizes, ROWS), tokens(sizes, (*ROWS, "vl")))
    places = st.tuples(st.integers(0, sizes.num_steps - 1), st.integers(0, config.num_layers - 1))
    patched = draw(st.lists(st.tuples(places, tokens(sizes, ROWS)), max_size=2))
    biased = draw(st.lists(tokens(sizes, (*ROWS, "vl")), max_size=3))
    blocks = limit(config.num_layers)
    return Intervention(
        cut=[pair for pair in draw(st.lists(pairs, max_size=3)) if acts_somewhere(config, pair[1], blocks)],
        key_bias={chosen: bias(chosen) for chosen in biased if acts_somewhere(config, chosen, blocks)},
        patch={place: {chosen: rows(chosen)} for place, chosen in patched},
        blocks=blocks,
        steps=limit(sizes.num_steps),
        heads=limit(config.num_heads),
    )


def acts_somewhere(config: HeadConfig, keys: Any, blocks: Sequence[int] | None) -> bool:
    """Whether these keys exist in any of these blocks: `vl` in cross-attention, others in self-attention."""
    group = keys if isinstance(keys, str) else keys[0]
    chosen = range(config.num_layers) if blocks is None else blocks
    is_self = {block % 2 == 1 and config.interleave_self_attention for block in chosen}
    return (group != "vl") in is_self


# The instruction set is set once for all of a test's examples.
per_isa = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=25
)


@dataclass(frozen=True)
class Case:
    """A head twice, one call of it, and what to change."""

    head: saccade.ActionHead
    reference: Reference
    inputs: dict[str, Any]  # tensors: features, state, noise, embodiment_id
    drop_vl: NDArray[np.bool_] | None
    num_steps: int
    interventions: list[Intervention]


@st.composite
def cases(draw: st.DrawFn, max_steps: int) -> Case:
    """Any sizes; 100 and 200 tokens are more than the attention kernel takes in one block of keys."""
    config, seed = draw(configs()), draw(st.integers(0, 2**31 - 1))
    batch, num_vl_tokens = draw(st.integers(1, 3)), draw(st.sampled_from([1, 2, 7, 33, 100, 200]))
    num_future = draw(st.none() | st.sampled_from([0, 1, 3, 9]))
    num_steps = draw(st.integers(1, max_steps))
    head, reference = both(config, seed)
    rng = np.random.default_rng(seed)
    replaced = []
    if num_future is not None:
        replaced = [Intervention(future_tokens=rng.standard_normal((num_future, head.config.width)))]
    count = head.config.num_future_tokens if num_future is None else num_future
    sizes = Sizes(head.config, batch, num_vl_tokens, num_steps, count)
    return Case(
        head,
        reference,
        random_inputs(head.config, seed, batch=batch, num_vl_tokens=num_vl_tokens),
        rng.random((batch, num_vl_tokens)) < 0.4 if draw(st.booleans()) else None,
        num_steps,
        draw(st.lists(interventions(sizes), min_size=1, max_size=2)) + replaced,
    )


def in_float64_if_tame(
    case: Case, run: Callable[[], Any], differences: Callable[..., Iterator[float]]
) -> Any:
    """What the reference gives; the example is passed over if torch's own float32 is far from it."""
    with torch.no_grad():
        expected = run()
        case.reference.float()
        assume(max(differences(run(), expected)) <= TAME)
    return expected


@per_isa
@given(case=cases(max_steps=3))
def test_random_interventions_equal_the_reference(isa: str, case: Case) -> None:
    assert case.head.isa == isa
    options: dict[str, Any] = {"intervention": case.interventions, "num_steps": case.num_steps}
    recorded: dict[str, Any] = options | {"record": ("attention", "hidden")}
    given_arrays = arrays(case.inputs)
    context = case.head.encode(given_arrays.pop("backbone_features"), drop_vl=case.drop_vl)
    trace = case.head.trace(context, **given_arrays, **recorded)
    np.testing.assert_array_equal(case.head.sample(context, **given_arrays, **options), trace.actions)

    def run() -> Any:
        rest = dict(case.inputs)
        vl_embs = case.reference.encode(rest.pop("backbone_features"), drop_vl=case.drop_vl)
        return case.reference.trace(vl_embs, **rest, drop_vl=case.drop_vl, **recorded)

    def differences(one: Any, other: Any) -> Iterator[float]:
        yield relative_error(one.actions, other.actions)
        for kept, expected in ((one.attention, other.attention), (one.hidden, other.hidden)):
            assert list(kept) == list(expected)
            for place, array in kept.items():
                yield relative_error(array, expected[place])

    expected = in_float64_if_tame(case, run, differences)
    assert trace.rows == expected.rows
    assert max(differences(trace, expected)) <= TOLERANCE
    for place, probabilities in trace.attention.items():
        exactly_zero = np.asarray(expected.attention[place]) == 0
        assert (np.asarray(probabilities)[exactly_zero] == 0).all()


@settings(per_isa, max_examples=10)
@given(case=cases(max_steps=1), buckets=st.lists(st.integers(0, 999), min_size=3, max_size=3))
def test_velocity_with_interventions_equals_the_reference(isa: str, case: Case, buckets: list[int]) -> None:
    assert case.head.isa == isa
    names = ("backbone_features", "state", "embodiment_id", "noise")
    features, *arguments = (case.inputs[name] for name in names)
    arguments.append(np.array(buckets[: len(features)]))
    context = case.head.encode(features, drop_vl=case.drop_vl)
    velocity = case.head.velocity(context, *arguments, intervention=case.interventions)

    def run() -> Any:
        vl_embs = case.reference.encode(features, drop_vl=case.drop_vl)
        options: dict[str, Any] = {"drop_vl": case.drop_vl, "intervention": case.interventions}
        return case.reference.velocity(vl_embs, *arguments, **options)

    def difference(one: Any, other: Any) -> Iterator[float]:
        yield relative_error(one, other)

    expected = in_float64_if_tame(case, run, difference)
    assert relative_error(velocity, expected) <= TOLERANCE


# A head whose sizes all differ, on every instruction set

Head = saccade.ActionHead
Inputs = dict[str, Any]


@pytest.fixture
def head(isa: str) -> Head:
    head, _ = both(small_config(num_layers=4, vl_num_layers=1), seed=11)
    assert head.isa == isa
    return head


@pytest.fixture
def inputs(head: Head) -> Inputs:
    given_arrays = arrays(random_inputs(head.config, 12, batch=3, num_vl_tokens=6))
    given_arrays["context"] = head.encode(given_arrays.pop("backbone_features"))
    return given_arrays


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
    assert equal(head(**inputs, intervention=none), saccade.ActionHead.load(tmp_path)(**inputs))


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


def everything(head: Head, batch: int) -> list[Intervention]:
    """All kinds of changes at once, for this batch."""
    rng = np.random.default_rng(1)
    width, horizon = head.config.width, head.config.action_horizon
    return [
        Intervention(cut=[("action", ("vl", [0, 3])), (("future", [1]), "action")], heads=[0, 2]),
        Intervention(key_bias={"state": 0.5, ("vl", (1,)): -1.0}, steps=[0, 2]),
        Intervention(future_tokens=rng.standard_normal((6, width))),
        Intervention(
            patch={
                (0, 2): {("future", (4, 0)): rng.standard_normal((2, width))},
                (2, 3): {"action": rng.standard_normal((batch, horizon, width))},
                (1, 1): {"state": rng.standard_normal((batch, 1, width))},
            }
        ),
    ]


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
        saccade.ActionHead.load(released.path, config=released.config, num_threads=threads)
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


# What does not fit


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
