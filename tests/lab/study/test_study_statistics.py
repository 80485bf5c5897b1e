"""Statistics of studies against published tables, scipy and simulation; verdicts against their intervals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from saccade.errors import InputError
from saccade_lab.study import statistics
from saccade_lab.study.section import effect
from saccade_lab.study.statistics import LOSS_THAT_MATTERS, Estimate, verdict


@given(
    bounds=st.tuples(st.floats(-1, 1), st.floats(-1, 1)).map(sorted),
    share=st.floats(0, 1),
)
def test_a_verdict_follows_from_its_interval(bounds: list[float], share: float) -> None:
    low, high = bounds
    said = verdict(Estimate(low + share * (high - low), low, high))
    assert (said == "better") == (low > 0)
    assert (said == "worse") == (high < 0)
    assert (said == "no worse") == (-LOSS_THAT_MATTERS < low <= 0 <= high)
    assert (said == "undecided") == (low <= -LOSS_THAT_MATTERS and high >= 0)


@pytest.mark.parametrize(
    ("only_first", "only_second", "expected"),
    [
        (17, 7, "better"),
        (7, 17, "worse"),  # -3.3 (-6.9 to -0.1): called "open" before
        (7, 3, "no worse"),  # 1.3 (-0.9 to 3.9): called "loses less than 5 points" before
        (3, 7, "no worse"),
        (7, 16, "undecided"),
    ],
)
def test_verdicts_of_300_pairs(only_first: int, only_second: int, expected: str) -> None:
    found = statistics.tango(only_first, only_second, 300)
    assert verdict(found) == expected
    assert effect("success", found).startswith(f"success: {expected}, {100 * found.value:.1f} points (")


def test_without_an_interval_nothing_is_decided() -> None:
    assert verdict(Estimate(-0.5, math.nan, math.nan)) == "undecided"


def near(estimate: Estimate, value: float, low: float, high: float, digits: int) -> bool:
    return [round(number, digits) for number in (estimate.value, estimate.low, estimate.high)] == [
        value,
        low,
        high,
    ]


def test_wilson_as_published() -> None:
    """Newcombe, Two-sided confidence intervals for the single proportion (1998), table I, method 3."""
    assert near(statistics.wilson(81, 263), round(81 / 263, 4), 0.2553, 0.3662, 4)
    assert near(statistics.wilson(15, 148), round(15 / 148, 4), 0.0624, 0.1605, 4)
    assert near(statistics.wilson(0, 20), 0.0, 0.0, 0.1611, 4)
    assert near(statistics.wilson(1, 29), round(1 / 29, 4), 0.0061, 0.1718, 4)
    nothing = statistics.wilson(0, 0)
    assert math.isnan(nothing.value)
    assert (nothing.low, nothing.high) == (0.0, 1.0)
    with pytest.raises(InputError, match="given 3 of 2"):
        statistics.wilson(3, 2)


def test_paired_difference_as_published() -> None:
    """The examples of chapter 8 of Fagerland, Lydersen, Laake, Statistical Analysis of Contingency Tables, in
    the digits that the R package contingencytables prints.
    """
    cavo = statistics.paired_difference(
        [True] * 65 + [False] * 96, [True] * 59 + [False] * 6 + [True] * 16 + [False] * 80
    )
    assert (cavo.both, cavo.only_first, cavo.only_second, cavo.neither, cavo.pairs) == (59, 6, 16, 80, 161)
    assert near(cavo.difference, -0.0621, -0.1240, -0.0054, 4)
    assert round(cavo.p_value, 6) == 0.052479
    assert near(statistics.tango(1, 7, 21), round(-6 / 21, 3), -0.517, -0.026, 3)


def test_paired_difference_without_a_discordant_pair_is_still_uncertain() -> None:
    same = statistics.paired_difference([True, False] * 30, [True, False] * 30)
    # Where no pair is discordant Tango's limits are z^2 / (n + z^2).
    reach = 1.959964**2 / (60 + 1.959964**2)
    assert same.difference.value == 0.0
    assert same.difference.low == pytest.approx(-reach, abs=1e-6)
    assert same.difference.high == pytest.approx(reach, abs=1e-6)
    assert same.p_value == 1.0


def test_paired_difference_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    truth, held = 0.1, 0
    for _ in range(1000):
        only_first, only_second, _ = rng.multinomial(60, [0.2, 0.1, 0.7])
        found = statistics.tango(int(only_first), int(only_second), 60)
        held += found.low <= truth <= found.high
    assert 0.93 <= held / 1000 <= 0.975


@pytest.mark.parametrize("only_first", [0, 5, 10])
@pytest.mark.parametrize("only_second", [0, 5])
def test_paired_difference_at_the_edges(only_first: int, only_second: int) -> None:
    pairs = 10 + only_second
    found = statistics.tango(only_first, only_second, pairs)
    assert -1 <= found.low <= found.value <= found.high <= 1
    turned = statistics.tango(only_second, only_first, pairs)
    assert [turned.low, turned.high] == pytest.approx([-found.high, -found.low], abs=1e-9)


def test_paired_difference_needs_pairs() -> None:
    with pytest.raises(InputError, match="given 2 and 1 results"):
        statistics.paired_difference([True, False], [True])
    with pytest.raises(InputError, match="given 0 and 0 results"):
        statistics.paired_difference([], [])


def test_holm_by_hand() -> None:
    """The first ten p values of Benjamini and Hochberg (1995)."""
    given = [0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.3240]
    expected = [0.001, 0.0036, 0.0152, 0.0665, 0.1206, 0.139, 0.139, 0.139, 0.139, 0.324]
    assert statistics.holm(given) == pytest.approx(expected)
    assert statistics.holm(given[::-1]) == pytest.approx(expected[::-1])
    assert statistics.holm([]) == []


def test_bootstrap_draws_clusters_and_not_observations() -> None:
    """Forty copies of each of ten numbers are ten observations, whose mean has a known error."""
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=10)
    found = statistics.bootstrap(np.repeat(numbers, 40), np.repeat(np.arange(10), 40).tolist())
    expected = numbers.std() / math.sqrt(10) * stats.norm.ppf(0.975)
    assert found.value == pytest.approx(numbers.mean())
    assert (found.high - found.low) / 2 == pytest.approx(expected, rel=0.1)

    ratio = statistics.bootstrap(
        np.array([[1.0, 2.0], [3.0, 4.0]]),
        [("a", 1), ("a", 2)],
        lambda rows: rows[:, 0].sum() / rows[:, 1].sum(),
    )
    assert (ratio.value, ratio.low, ratio.high) == (4 / 6, 0.5, 0.75)
    assert math.isnan(statistics.bootstrap([1.0, 2.0], ["a", "a"]).low)
    # The fast way to a ratio of sums draws the same clusters as the slow one.
    parts, wholes, clusters = numbers[:9], rng.uniform(1, 2, 9), [0, 0, 1, 2, 3, 4, 4, 4, 5]
    slow = statistics.bootstrap(
        np.stack([parts, wholes], axis=1), clusters, lambda rows: rows[:, 0].sum() / rows[:, 1].sum()
    )
    fast = statistics.bootstrap_ratio(parts, wholes, clusters)
    assert [fast.value, fast.low, fast.high] == pytest.approx([slow.value, slow.low, slow.high], rel=1e-9)
    assert math.isnan(statistics.bootstrap_ratio([1.0], [0.0], ["a"]).value)
    with pytest.raises(InputError, match="given 1 for 2 values"):
        statistics.bootstrap([1.0, 2.0], ["a"])


def test_detectable_difference_is_found_with_the_power_that_is_promised() -> None:
    pairs, discordant = 400, 0.2
    difference = statistics.detectable_difference(pairs, discordant)
    rng = np.random.default_rng(0)
    shares = [(discordant + difference) / 2, (discordant - difference) / 2, 1 - discordant]
    only_first, only_second, _ = rng.multinomial(pairs, shares, size=20_000).T
    significant = np.abs(only_first - only_second) > stats.norm.ppf(0.975) * np.sqrt(only_first + only_second)
    assert significant.mean() == pytest.approx(0.8, abs=0.02)
    assert math.isnan(statistics.detectable_difference(10, 0.05))
    with pytest.raises(InputError, match=r"given 0 and 0\.5"):
        statistics.detectable_difference(0, 0.5)


@pytest.mark.parametrize("runs", [2, 3, 8])
def test_detectable_between_runs_is_found_with_the_power_that_is_promised(runs: int) -> None:
    rate, episodes, deviation = 0.5, 100, 0.03
    difference = statistics.detectable_between_runs(rate, episodes, runs, deviation)
    rng = np.random.default_rng(0)
    # Rates of runs, normal with the variance that is assumed of them, so that none leaves [0, 1].
    spread = math.sqrt(deviation**2 + rate * (1 - rate) / episodes)
    one, two = rng.normal(rate, spread, (2, 20_000, runs))
    test = stats.ttest_ind(one, two + difference, axis=1)
    assert (test.pvalue < 0.05).mean() == pytest.approx(0.8, abs=0.02)


def test_detectable_between_runs_at_the_edges() -> None:
    assert math.isnan(statistics.detectable_between_runs(0.5, 100, 1, 0.0))  # one run tells no variance
    assert math.isnan(statistics.detectable_between_runs(0.5, 2, 2, 0.2))  # more than the whole scale
    assert statistics.detectable_between_runs(1.0, 100, 2, 0.0) == 0.0
    with pytest.raises(InputError, match="rate, episodes, runs, run_deviation: given"):
        statistics.detectable_between_runs(1.2, 100, 2, 0.0)


def test_a_vectorized_bootstrap_is_the_same() -> None:
    values = np.random.default_rng(3).normal(size=(12, 2))

    def product(rows: Any) -> Any:
        return rows.prod(axis=-1).mean(axis=-1)

    assert statistics.bootstrap(values, range(12), product, vectorized=True) == statistics.bootstrap(
        values, range(12), product
    )
    with pytest.raises(InputError, match="clusters: given 6 for 12 values"):
        statistics.bootstrap(values, [*range(6)] * 2, product, vectorized=True)
