"""`future_refresh`: the Rust head against the torch reference in float64, and what must be exact."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

import saccade
from saccade import Intervention
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import TAME, TOLERANCE, arrays, both, same, three_observations, tiny_head
from tests.helpers.intervention_cases import Case, cases, everything, per_isa
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import load_released

PRECISIONS = ("float32", "bfloat16", "int8", "int4")

#: The action rows read no other rows: what the others hold cannot matter.
BLIND = Intervention(cut=[("action", "state"), ("action", "future")])


def runs(case: Case, refresh: int) -> list[Intervention]:
    """The case's interventions without patches of rows at steps at which they do not run."""

    def kept(one: Any) -> Intervention:
        patch = {
            (step, block): {
                of: rows for of, rows in groups.items() if step % refresh == 0 or of[0] == "action"
            }
            for (step, block), groups in (one.patch or {}).items()
        }
        changed: Intervention = replace(one, patch=patch)
        return changed

    return [kept(one) for one in case.interventions]


def patched(place: tuple[int, int], tokens: Any, rows: Any) -> Intervention:
    return Intervention(patch={place: {tokens: rows}})


@per_isa
@given(case=cases(max_steps=5), refresh=st.integers(1, 5), bare=st.booleans())
def test_random_configurations_equal_the_reference(isa: str, case: Case, refresh: int, bare: bool) -> None:
    assert case.head.isa == isa
    options: dict[str, Any] = {
        "intervention": [] if bare else runs(case, refresh),
        "num_steps": case.num_steps,
        "future_refresh": refresh,
        "drop_vl": case.drop_vl,
    }
    with torch.no_grad():
        expected = case.reference(**case.inputs, **options)
        case.reference.float()
        assume(relative_error(case.reference(**case.inputs, **options), expected) <= TAME)
    assert relative_error(case.head(**arrays(case.inputs), **options), expected) <= TOLERANCE


@pytest.fixture
def head() -> saccade.ActionHead:
    return tiny_head()


@pytest.fixture
def inputs(head: saccade.ActionHead) -> dict[str, Any]:
    return three_observations(head)


def test_one_is_exact_and_two_is_not(isa: str) -> None:
    released = load_released("n15_tiny")
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config)
    given_arrays = (released.backbone_features, released.state, released.embodiment_id)
    exact = head(*given_arrays, noise=released.noise)
    for refresh in (None, 1):
        assert same(head(*given_arrays, noise=released.noise, future_refresh=refresh), exact)
    held = {r: head(*given_arrays, noise=released.noise, future_refresh=r) for r in (2, 3, 4, 7)}
    for one, other in ((held[2], exact), (held[2], held[3]), (held[3], held[4])):
        assert not same(one, other)
    assert same(held[4], held[7]), "4 steps: the others run at the first one only"
    # A call of another kind leaves nothing behind.
    assert same(head(*given_arrays, noise=released.noise), exact)
    assert same(head(*given_arrays, noise=released.noise, future_refresh=2), held[2])


def test_one_step_has_nothing_to_hold(head: saccade.ActionHead, inputs: dict[str, Any]) -> None:
    assert same(head.sample(**inputs, num_steps=1, future_refresh=5), head.sample(**inputs, num_steps=1))


@pytest.mark.parametrize("refresh", [2, 3])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_exact_where_action_rows_read_no_others(inputs: dict[str, Any], refresh: int, precision: str) -> None:
    released = load_released("n15_tiny")
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config, precision=precision)
    inputs["context"] = head.encode(np.asarray(inputs["context"].vl_embs))
    blind = head.sample(**inputs, num_steps=5, intervention=BLIND)
    assert same(head.sample(**inputs, num_steps=5, future_refresh=refresh, intervention=BLIND), blind)
    sighted = Intervention(cut=[("action", "future")])  # the state's row is still read
    chunks = [
        head.sample(**inputs, num_steps=5, future_refresh=r, intervention=sighted) for r in (None, refresh)
    ]
    assert not same(*chunks)


def test_exact_where_no_block_reads_rows(isa: str) -> None:
    config = small_config(interleave=False)
    reference = random_head(config, 3)
    with torch.no_grad():
        given_inputs: dict[str, Any] = random_inputs(reference.config, 4, batch=2, num_vl_tokens=5)
        torch.testing.assert_close(
            reference(**given_inputs, future_refresh=2), reference(**given_inputs), rtol=0, atol=1e-5
        )
    engine, _ = both(config, 3)
    exact = engine(**arrays(given_inputs))
    assert same(engine(**arrays(given_inputs), future_refresh=2), exact)


def test_the_rows_of_the_state_are_held_too() -> None:
    """Without future tokens the state's row is all there is to hold."""
    engine, reference = both(small_config(num_future_tokens=0, num_steps=4), 5)
    given_inputs: dict[str, Any] = random_inputs(reference.config, 6, batch=2, num_vl_tokens=5)
    exact, held = (engine(**arrays(given_inputs), future_refresh=r) for r in (1, 2))
    assert not same(exact, held)
    with torch.no_grad():
        assert relative_error(held, reference(**given_inputs, future_refresh=2)) <= TOLERANCE


def test_the_reference_holds_what_was_read() -> None:
    """By hand: at step 1 of 2 the rows of state and future tokens are those of step 0, patched back in."""
    reference = random_head(small_config(num_layers=2), 8, dtype=torch.float64)
    given_inputs: dict[str, Any] = random_inputs(reference.config, 9, batch=1, num_vl_tokens=5)
    with torch.no_grad():
        vl_embs = reference.encode(given_inputs.pop("backbone_features"))
        block: Any = reference.model.transformer_blocks[1]
        read: list[torch.Tensor] = []
        block.norm1.register_forward_hook(lambda _module, _inputs, output: read.append(output.clone()))
        reference.sample(vl_embs, **given_inputs, num_steps=2, future_refresh=2)
        first, second = read
        rows = 1 + reference.config.num_future_tokens
        assert first.shape[1] == rows + reference.config.action_horizon
        assert second.shape[1] == reference.config.action_horizon, "only the action rows run"

        def hold(_module: Any, _inputs: Any, output: torch.Tensor) -> torch.Tensor:
            return torch.cat((first[:, :rows], output[:, rows:]), dim=1)

        held = reference.sample(vl_embs, **given_inputs, num_steps=2, future_refresh=2)
        actions = reference.sample(vl_embs, **given_inputs, num_steps=2, future_refresh=1)
        assert not torch.allclose(held, actions)
        # All rows run, and block 1's norm gives those of the others as they were. It is the last block, so
        # what they become after it is read by nobody.
        block.norm1.register_forward_hook(hold)
        assert torch.allclose(
            reference.sample(vl_embs, **given_inputs, num_steps=2), held, rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("precision", PRECISIONS)
def test_bits_do_not_depend_on_batch_samples_or_threads(isa: str, precision: str) -> None:
    released = load_released("n15_tiny")
    heads = [
        saccade.ActionHead.from_pretrained(
            released.path, config=released.config, precision=precision, num_threads=threads
        )
        for threads in (1, 3)
    ]
    head = heads[0]
    config = head.config
    rng = np.random.default_rng(7)
    features = rng.standard_normal((3, 8, config.context_dim), np.float32)
    state = rng.standard_normal((3, config.state_dim), np.float32)
    noise = rng.standard_normal((3, 2, config.action_horizon, config.encoder_action_dim), np.float32)
    changes = everything(head, 3)[:-1]
    options: dict[str, Any] = {"intervention": changes, "num_steps": 4, "future_refresh": 3}

    def chunks(of: saccade.ActionHead, rows: slice, **more: Any) -> Any:
        return of.sample(of.encode(features[rows]), state[rows], 1, **options, **more)

    everyone = slice(None)
    together = chunks(head, everyone, noise=noise, num_samples=2)
    assert same(chunks(heads[1], everyone, noise=noise, num_samples=2), together)
    for sample in range(2):
        assert same(chunks(head, everyone, noise=noise[:, sample].copy()), together[:, sample])
    for element in range(3):
        rows = slice(element, element + 1)
        assert same(chunks(head, rows, noise=noise[rows, 0]), together[rows, 0])


def test_a_patch_of_rows_that_do_not_run_is_refused(head: saccade.ActionHead, inputs: dict[str, Any]) -> None:
    width = head.config.width
    for group in ("state", ("future", (2,))):
        late = patched((1, 0), group, np.zeros((1, width), np.float32))
        head.sample(**inputs, intervention=late)
        with pytest.raises(
            saccade.InputError, match=r"patch\[\(1, 0\)\]: expected action tokens, since with f"
        ):
            head.sample(**inputs, intervention=late, future_refresh=2)
    for place in ((0, 1), (2, 0)):
        early = patched(place, ("future", (2,)), np.full((1, width), 0.5, np.float32))
        assert not same(
            head.sample(**inputs, intervention=early, future_refresh=2),
            head.sample(**inputs, future_refresh=2),
        )
    actions = np.zeros((head.config.action_horizon, width), np.float32)
    head.sample(**inputs, intervention=patched((1, 0), "action", actions), future_refresh=2)


def test_the_reference_refuses_it_too() -> None:
    reference = random_head(small_config(), 1)
    given_inputs: dict[str, Any] = random_inputs(reference.config, 2, batch=1, num_vl_tokens=3)
    late = patched((1, 0), "state", np.zeros((1, reference.config.width), np.float32))
    with pytest.raises(saccade.InputError, match="expected action tokens, got state tokens"):
        reference(**given_inputs, intervention=late, future_refresh=2)


@pytest.mark.parametrize(
    ("given_value", "message"),
    [
        (0, "future_refresh: expected at least 1, got 0"),
        (-2, "future_refresh: expected at least 1, got -2"),
        (1.5, "future_refresh: expected an integer, got 1.5"),
        (True, "future_refresh: expected an integer, got True"),
        ("2", "future_refresh: expected an integer, got '2'"),
        (2**63, "future_refresh: expected a number below"),
    ],
)
def test_what_is_not_a_number_of_steps_is_refused(
    head: saccade.ActionHead, inputs: dict[str, Any], given_value: Any, message: str
) -> None:
    with pytest.raises(saccade.InputError, match=message):
        head.sample(**inputs, future_refresh=given_value)
    with pytest.raises(saccade.InputError, match=message):
        head.warmup(8, future_refresh=given_value)
    reference = Reference(head.config)
    features = torch.zeros(1, 2, head.config.context_dim)
    noise = torch.zeros(1, head.config.action_horizon, head.config.action_dim)
    with pytest.raises(saccade.InputError, match=message):
        reference(features, torch.zeros(1, 64), 0, noise=noise, future_refresh=given_value)


def test_warmup_takes_it(head: saccade.ActionHead) -> None:
    head.warmup(8, batch=3, num_samples=2, future_refresh=2)
