"""The Rust head against the torch reference in float64, on random configurations and on each instruction set.

Tolerance: 1e-5 * max(1, |value|), as the engine computes in float32.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from torch import Tensor

import saccade
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference.random_weights import random_head, random_inputs
from tests.helpers.engine_cases import TAME, TOLERANCE, arrays, both, configs, save
from tests.helpers.reference_cases import relative_error, small_config
from tests.helpers.released import Released

# The instruction set is set once for all of a test's examples.
per_isa = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=40
)


@per_isa
@given(
    config=configs(),
    seed=st.integers(0, 2**31 - 1),
    batch=st.integers(1, 3),
    num_vl_tokens=st.sampled_from([1, 2, 7, 16, 33, 65]),
    num_steps=st.none() | st.integers(1, 9),
)
def test_encode_and_sample_equal_the_reference(
    isa: str, config: dict[str, Any], seed: int, batch: int, num_vl_tokens: int, num_steps: int | None
) -> None:
    head, reference = both(config, seed)
    assert head.isa == isa
    assert head.config == reference.config
    inputs = random_inputs(reference.config, seed, batch=batch, num_vl_tokens=num_vl_tokens)
    given_arrays = arrays(inputs)
    context = head.encode(given_arrays.pop("backbone_features"))
    actions = head.sample(context, **given_arrays, num_steps=num_steps)
    with torch.no_grad():
        vl_embs = reference.encode(inputs["backbone_features"])
        expected = reference(**inputs, num_steps=num_steps)
        assume(relative_error(reference.float()(**inputs, num_steps=num_steps), expected) <= TAME)
    assert relative_error(context.vl_embs, vl_embs) <= TOLERANCE
    assert relative_error(actions, expected) <= TOLERANCE


@per_isa
@given(
    config=configs(),
    seed=st.integers(0, 2**31 - 1),
    timesteps=st.integers(0, 999) | st.lists(st.integers(0, 999), min_size=3, max_size=3),
)
def test_velocity_equals_the_reference(
    isa: str, config: dict[str, Any], seed: int, timesteps: int | list[int]
) -> None:
    head, reference = both(config, seed)
    inputs = random_inputs(reference.config, seed, batch=3, num_vl_tokens=5)
    features, state, ids, actions = (
        inputs[name] for name in ("backbone_features", "state", "embodiment_id", "noise")
    )
    buckets = timesteps if isinstance(timesteps, int) else np.array(timesteps)
    given_velocity = head.velocity(
        head.encode(features.numpy()), state.numpy(), ids.numpy(), actions.numpy(), buckets
    )
    with torch.no_grad():
        expected = reference.velocity(reference.encode(features), state, ids, actions, buckets)
        reference.float()
        in_float32 = reference.velocity(reference.encode(features), state, ids, actions, buckets)
    assume(relative_error(in_float32, expected) <= TAME)
    assert relative_error(given_velocity, expected) <= TOLERANCE


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)
def test_narrow_weights_are_widened_exactly(isa: str, dtype: torch.dtype) -> None:
    head, reference = both(small_config(), seed=1, dtype=dtype)
    inputs = random_inputs(reference.config, seed=2, batch=2, num_vl_tokens=6)
    with torch.no_grad():
        assert relative_error(head(**arrays(inputs)), reference(**inputs)) <= TOLERANCE


def test_one_embodiment_for_all_rows(isa: str) -> None:
    head, reference = both(small_config(), seed=1)
    inputs = random_inputs(reference.config, seed=2, batch=3, num_vl_tokens=6)
    given_arrays = arrays(inputs)
    for embodiment_id in range(reference.config.num_embodiments):
        with torch.no_grad():
            expected = reference(**(inputs | {"embodiment_id": torch.full((3,), embodiment_id)}))
        actions = head(**(given_arrays | {"embodiment_id": embodiment_id}))
        assert relative_error(actions, expected) <= TOLERANCE


@per_isa
@given(
    seed=st.integers(0, 2**31 - 1),
    dropped=st.lists(st.booleans(), min_size=9, max_size=9).filter(lambda d: not all(d)),
)
def test_dropped_positions_are_as_if_never_there(isa: str, seed: int, dropped: list[bool]) -> None:
    head, reference = both(small_config(vl_num_layers=2), seed)
    inputs = random_inputs(reference.config, seed, batch=1, num_vl_tokens=9)
    drop_vl = np.array([dropped])
    actions = head(**arrays(inputs), drop_vl=drop_vl)
    kept = inputs | {"backbone_features": inputs["backbone_features"][:, torch.from_numpy(~drop_vl[0])]}
    with torch.no_grad():
        assert relative_error(actions, reference(**kept)) <= TOLERANCE


def permuted(reference: Reference) -> Tensor:
    return reference.future_tokens.weight.flip(0)


def repeated(reference: Reference) -> Tensor:
    return torch.cat((reference.future_tokens.weight, reference.future_tokens.weight[:1]))


@pytest.mark.parametrize("tokens", [permuted, repeated])
def test_other_future_tokens_equal_the_reference(isa: str, tokens: Callable[[Reference], Tensor]) -> None:
    """More tokens, or others, with all other weights kept: what a resized checkpoint is."""
    reference = random_head(small_config(num_future_tokens=5), seed=3, dtype=torch.float64)
    changed = torch.nn.Parameter(tokens(reference).detach())
    config = small_config(num_future_tokens=len(changed))
    reference.future_tokens.weight = changed
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder), reference, config)
        head = saccade.ActionHead.from_pretrained(folder)
    inputs = random_inputs(reference.config, seed=4, batch=2, num_vl_tokens=6)
    with torch.no_grad():
        assert relative_error(head(**arrays(inputs)), reference(**inputs)) <= TOLERANCE


def test_rust_is_as_close_to_the_released_code_as_it_is_to_itself(isa: str, released: Released) -> None:
    head = saccade.ActionHead.from_pretrained(released.path, config=released.config)
    context = head.encode(released.backbone_features)
    actions = head.sample(context, released.state, released.embodiment_id, noise=released.noise)
    assert head.isa == isa
    assert (np.abs(actions - released.actions_f64) <= released.tolerance).all()
    assert relative_error(context.vl_embs, released.vl_embs) <= 4e-6
