"""Every kind of head against other code: N1, N1.5, N1.6, N1.7, forks, a bias on future tokens.

The Rust head against the released code's outputs, against the torch reference in float64 and against the same
rounding in torch, on each instruction set.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator, union-attr"

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

import saccade
from benches.precision_groups import DIT, VL, bfloat16, int4_weight, int8_rows, int8_weight, round_group
from saccade import Chunking, Intervention
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import (
    TAME,
    TOLERANCE,
    arrays,
    both,
    random_masks,
    rms,
    same,
    save,
    variant_configs,
)
from tests.helpers.intervention_cases import Sizes, interventions
from tests.helpers.reference_cases import relative_error, variant_config
from tests.helpers.released import VARIANTS, load_released

# The instruction set is set once for all of a test's examples.
per_isa = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=20
)


@dataclass(frozen=True)
class Case:
    """A head twice, and one call of it."""

    head: saccade.ActionHead
    reference: Reference
    inputs: dict[str, Any]  # tensors: features, state, noise, embodiment_id
    masks: dict[str, Any]  # arrays
    options: dict[str, Any]  # of `sample`
    interventions: list[Intervention]


@st.composite
def cases(draw: st.DrawFn, max_steps: int = 3) -> Case:
    config, seed = draw(variant_configs()), draw(st.integers(0, 2**31 - 1))
    batch, num_vl_tokens = draw(st.integers(1, 3)), draw(st.sampled_from([2, 3, 9, 40, 130]))
    num_steps = draw(st.integers(1, max_steps))
    head, reference = both(config, seed)
    rng = np.random.default_rng(seed)
    inputs = random_inputs(head.config, seed, batch=batch, num_vl_tokens=num_vl_tokens)
    masks = random_masks(head.config, rng, batch, num_vl_tokens)
    inputs = {name: tensor for name, tensor in inputs.items() if name not in masks}
    num_future = draw(st.none() | st.sampled_from([0, 1, 3]))
    replaced = []
    if num_future is not None:
        replaced = [Intervention(future_tokens=rng.standard_normal((num_future, head.config.width)))]
    sizes = Sizes(
        head.config,
        batch,
        num_vl_tokens,
        num_steps,
        head.config.num_future_tokens if num_future is None else num_future,
    )
    changes = draw(st.lists(interventions(sizes), max_size=2))
    return Case(head, reference, inputs, masks, {"num_steps": num_steps}, changes + replaced)


@st.composite
def ways(draw: st.DrawFn, case: Case) -> dict[str, Any]:
    """How the flow is followed: midpoint, held rows, and on from a previous chunk."""
    config, rng = case.head.config, np.random.default_rng(draw(st.integers(0, 2**31 - 1)))
    options: dict[str, Any] = {
        "integrator": draw(st.sampled_from(["euler", "midpoint"])),
        "future_refresh": draw(st.none() | st.integers(1, 3)),
    }
    if draw(st.booleans()):
        horizon = draw(st.integers(0, config.action_horizon))
        overlap = draw(st.integers(0, horizon))
        options["chunking"] = Chunking(
            overlap=overlap,
            frozen=draw(st.integers(0, overlap)),
            ramp_rate=draw(st.sampled_from([1e-6, 0.5, 6.0, 50.0])),
            horizon=draw(st.sampled_from([None, horizon])) if horizon else None,
        )
        dims = draw(st.sampled_from([config.action_dim, config.encoder_action_dim]))
        shape = (len(case.inputs["noise"]), config.action_horizon, dims)
        options["previous_chunk"] = rng.standard_normal(shape, np.float32)
    return options


def without_patches(case: Case) -> list[Intervention]:
    """The case's interventions without patches: rows that do not run cannot be patched."""
    return [
        Intervention(cut=one.cut, key_bias=one.key_bias, heads=one.heads, future_tokens=one.future_tokens)
        for one in case.interventions
    ]


# The released code


@pytest.mark.parametrize("name", VARIANTS)
def test_released_outputs(isa: str, name: str) -> None:
    released = load_released(name)
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config)
    assert head.isa == isa
    actions = head(**released.arguments)
    assert (np.abs(actions - released.actions_f64) <= released.tolerance).all()
    masks = {key: value for key, value in released.options.items() if key.endswith("_mask")}
    vl_embs = head.encode(released.backbone_features, **masks).vl_embs
    assert relative_error(vl_embs, released.vl_embs) <= 4e-6


# Largest error over the largest action, of all instruction sets: measured. Twice that is allowed, as a change
# in the order of a sum moves it.
MEASURED = {
    ("n17_tiny", "bfloat16"): 3.3e-3,
    ("n17_tiny", "int8"): 1.2e-2,
    ("n17_rtc", "bfloat16"): 4.4e-3,
    ("n17_rtc", "int8"): 1.4e-2,
    ("fork_two_decoders", "bfloat16"): 6.5e-3,
    ("fork_two_decoders", "int8"): 2.8e-2,
}


@pytest.mark.parametrize(("name", "precision"), MEASURED)
def test_released_outputs_in_fewer_bits(isa: str, name: str, precision: str) -> None:
    released = load_released(name)
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config, precision=precision)
    error = np.abs(np.asarray(head(**released.arguments)) - released.actions_f64).max()
    assert 0 < error / np.abs(released.actions_f64).max() <= 2 * MEASURED[name, precision]


# The reference, on random configurations


def error_of(case: Case, given_arrays: Any, expected: Any, again: Callable[[], Any]) -> float:
    """The example is passed over if torch's own float32 is far from it."""
    case.reference.float()
    with torch.no_grad():
        assume(relative_error(again(), expected) <= TAME)
    return relative_error(given_arrays, expected)


@per_isa
@given(data=st.data(), case=cases())
def test_sample_equals_the_reference(isa: str, data: st.DataObject, case: Case) -> None:
    assert case.head.isa == isa
    assert case.head.config == case.reference.config
    options = case.options | data.draw(ways(case))
    options["intervention"] = (
        case.interventions if options["future_refresh"] in (None, 1) else without_patches(case)
    )

    def run() -> Tensor:
        return case.reference(**case.inputs, **case.masks, **options)

    with torch.no_grad():
        expected = run()
    given_actions = case.head(**arrays(case.inputs), **case.masks, **options)
    assert error_of(case, given_actions, expected, run) <= TOLERANCE


@settings(per_isa, max_examples=15)
@given(case=cases())
def test_trace_equals_the_reference(isa: str, case: Case) -> None:
    given_arrays = arrays(case.inputs)
    options: dict[str, Any] = case.options | {"intervention": case.interventions}
    recorded: dict[str, Any] = options | {"record": ("attention", "hidden")}
    context = case.head.encode(given_arrays.pop("backbone_features"), **case.masks)
    trace = case.head.trace(context, **given_arrays, **recorded)
    assert same(case.head.sample(context, **given_arrays, **options), trace.actions)

    def run() -> Any:
        rest = dict(case.inputs)
        vl_embs = case.reference.encode(rest.pop("backbone_features"), drop_vl=case.masks["drop_vl"])
        return vl_embs, case.reference.trace(vl_embs, **rest, **case.masks, **recorded)

    def numbers(vl_embs: Any, of: Any) -> Any:
        kept = [vl_embs, of.actions, *of.attention.values(), *of.hidden.values()]
        return np.concatenate([np.ravel(np.asarray(array, np.float64)) for array in kept])

    with torch.no_grad():
        vl_embs, expected = run()
    kept = np.asarray(context.vl_embs).copy()
    kept[case.masks["drop_vl"]] = 0  # dropped positions have no meaning
    given_numbers = numbers(kept, trace)
    assert error_of(case, given_numbers, numbers(vl_embs, expected), lambda: numbers(*run())) <= TOLERANCE
    assert trace.rows == expected.rows
    for place, probabilities in trace.attention.items():
        removed = np.asarray(expected.attention[place]) == 0
        assert (np.asarray(probabilities)[removed] == 0).all(), "exactly"


@settings(per_isa, max_examples=10)
@given(case=cases(max_steps=1), buckets=st.lists(st.integers(0, 999), min_size=3, max_size=3))
def test_velocity_equals_the_reference(isa: str, case: Case, buckets: list[int]) -> None:
    names = ("backbone_features", "state", "embodiment_id", "noise")
    features, *arguments = (case.inputs[name] for name in names)
    arguments.append(np.array(buckets[: len(features)]))
    context = case.head.encode(features, **case.masks)
    velocity = case.head.velocity(context, *arguments, intervention=case.interventions)

    def run() -> Tensor:
        vl_embs = case.reference.encode(features, drop_vl=case.masks["drop_vl"])
        return case.reference.velocity(vl_embs, *arguments, **case.masks, intervention=case.interventions)

    with torch.no_grad():
        expected = run()
    assert error_of(case, velocity, expected, run) <= TOLERANCE


# Rounding


DECODERS = r"action_(arm_|left_arm_|right_arm_|claw_)?decoder"


def rounded(reference: Reference, precision: str) -> Reference:
    """The reference with the rounding of this precision written out in torch; sums stay float64."""
    by_precision = {"bfloat16": (bfloat16, bfloat16), "int8": (int8_weight, int8_rows)}
    weights, rows = (by_precision | {"int4": (int4_weight, int8_rows)})[precision]
    assert round_group(reference, rf"({VL}|{DIT})(attn1|ff)\..*", weights, rows)
    others = rf"model\.proj_out_2|state_encoder\..*|action_encoder\.W3|{DECODERS}\..*"
    assert round_group(reference, others, bfloat16, bfloat16)
    for name, module in reference.named_modules():
        if re.fullmatch(rf"({VL}|{DIT})attn1\.to_[qkv]", name):
            module.register_forward_hook(lambda _, args, output: bfloat16(output))
    return reference


@pytest.mark.parametrize("precision", ["bfloat16", "int8", "int4"])
@pytest.mark.parametrize("kind", ["n1", "n1.6", "n1.7", "split-arms"])
def test_errors_are_those_of_the_rounding(isa: str, kind: str, precision: str, tmp_path: Path) -> None:
    """As far from float64 as the same rounding in torch is, within a factor of 2 over many numbers."""
    config = variant_config(kind, num_layers=6, num_heads=2, head_dim=33, context_dim=62, hidden_dim=51)
    reference = random_head(config, 1).double()
    save(tmp_path, reference, config)
    inputs = random_inputs(reference.config, 2, batch=8, num_vl_tokens=33)
    head = saccade.ActionHead.from_pretrained(tmp_path, precision=precision)
    with torch.no_grad():
        exact = reference(**inputs).numpy()
        emulated = rounded(reference, precision)(**inputs).numpy() - exact
    error = np.asarray(head(**arrays(inputs))) - exact
    steps = 2 if precision in ("int8", "int4") and isa in ("avx2", "avx512f") else 1
    assert rms(emulated) / 2 <= rms(error) <= 2 * steps * rms(emulated)
