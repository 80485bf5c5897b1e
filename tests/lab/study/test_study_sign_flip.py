"""The exact sign-flip test against scipy's permutation test, and its interval against its own p values."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from saccade.errors import InputError
from saccade_lab.study.sign_flip import MOST_PAIRS, sign_flip, sign_flip_p
from saccade_lab.study.statistics import verdict

#: Success rates of a hundred episodes: there are ties and zeros among their differences.
RATES = st.integers(-100, 100).map(lambda count: count / 100)


@pytest.mark.parametrize("count", [2, 5, 6, 9, 12])
@pytest.mark.parametrize("digits", [1, 15])
def test_p_values_are_those_of_scipy(count: int, digits: int) -> None:
    values = np.round(np.random.default_rng(count).normal(0.3, 1.0, count), digits)
    expected: Any = stats.permutation_test(
        (values,),
        lambda sample, axis: np.sum(sample, axis=axis),
        permutation_type="samples",
        n_resamples=np.inf,
        vectorized=True,
    )
    assert sign_flip(values).p_value == pytest.approx(expected.pvalue)


@given(st.lists(RATES, min_size=1, max_size=8))
def test_p_value_counts_all_patterns(values: list[float]) -> None:
    counts = [round(100 * value) for value in values]  # exact
    sums = [
        abs(sum(map(int.__mul__, counts, signs))) for signs in itertools.product((1, -1), repeat=len(counts))
    ]
    expected = sum(found >= abs(sum(counts)) for found in sums) / len(sums)
    assert sign_flip(values).p_value == expected
    assert sign_flip([-value for value in values]).p_value == expected
    assert sign_flip(sorted(values)).p_value == expected
    assert sign_flip_p([values, values]).tolist() == [expected, expected]


@settings(max_examples=50)
@given(st.lists(st.floats(-1, 1).map(lambda value: round(value, 6)), min_size=6, max_size=10))
def test_interval_is_what_the_test_does_not_reject(values: list[float]) -> None:
    given_ = np.array(values)
    found = sign_flip(given_).difference
    assert found.low <= found.value + 1e-12
    assert found.value - 1e-12 <= found.high
    apart = 1e-4
    for shift in (found.low + apart, found.high - apart):
        if found.low + apart <= shift <= found.high - apart:
            assert sign_flip(given_ - shift).p_value > 0.05
    for shift in (found.low - apart, found.high + apart, found.low - 1, found.high + 1):
        assert sign_flip(given_ - shift).p_value <= 0.05


@given(st.lists(RATES, min_size=6, max_size=9), st.floats(-3, 3))
def test_interval_moves_with_the_differences(values: list[float], shift: float) -> None:
    before, after = sign_flip(values).difference, sign_flip(np.array(values) + shift).difference
    moved = np.array([before.value, before.low, before.high]) + shift
    np.testing.assert_allclose([after.value, after.low, after.high], moved, atol=1e-9)


def test_six_pairs_are_the_fewest_that_decide() -> None:
    for count in range(1, 6):
        found = sign_flip(np.arange(1.0, count + 1))
        assert found.p_value == 2 / 2**count > 0.05
        assert math.isnan(found.difference.low)
        assert math.isnan(found.difference.high)
        assert verdict(found.difference) == "undecided"
    six = sign_flip(np.arange(1.0, 7.0))
    assert six.p_value == 2 / 64
    assert (six.difference.low, six.difference.high) == (1.0, 6.0)  # the smallest and the largest


def test_equal_differences_have_an_interval_of_no_width() -> None:
    found = sign_flip([0.25] * 8)
    assert (found.difference.low, found.difference.high, found.p_value) == (0.25, 0.25, 2 / 256)
    assert sign_flip([0.0] * 8).p_value == 1.0


def test_the_level_holds_under_no_difference() -> None:
    rng = np.random.default_rng(0)
    p = sign_flip_p(rng.standard_normal((4000, 8)))
    assert p.shape == (4000,)
    for level in (0.05, 0.25):
        assert (p <= level).mean() == pytest.approx(level, abs=4 * math.sqrt(level / 4000))


def test_most_pairs() -> None:
    values = np.random.default_rng(0).normal(0.2, 1.0, MOST_PAIRS)
    found = sign_flip(values)
    student = stats.ttest_1samp(values, 0.0)
    assert found.p_value == pytest.approx(student.pvalue, abs=0.02)
    interval = student.confidence_interval()
    assert (found.difference.low, found.difference.high) == pytest.approx(
        (interval.low, interval.high), abs=0.05
    )


@pytest.mark.parametrize("wrong", [[], [math.nan], [1.0, math.inf], [0.0] * 21, 1.0, [[1.0, 2.0]]])
def test_hostile_input(wrong: npt.ArrayLike) -> None:
    with pytest.raises(InputError, match="differences: "):
        sign_flip(wrong)
