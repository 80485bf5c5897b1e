"""Interventions in the Rust head: random ones on random heads, against the torch reference in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.helpers.engine_cases import TAME, TOLERANCE, arrays
from tests.helpers.intervention_cases import Case, cases, per_isa
from tests.helpers.reference_cases import relative_error


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
