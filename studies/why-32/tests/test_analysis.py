"""The analysis by hand: tests, findings and power."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from made_tables import FEWER, MORE, rows_of

from saccade.errors import InputError
from saccade_lab.study.sign_flip import sign_flip
from saccade_lab.study.statistics import holm
from why_32.contrasts import CONFIRMATORY, EXPLORATORY, difference, in_parts, slope
from why_32.power import power
from why_32.results import changes, confirmed, judged, over_seeds

RATES = {
    "n-0": [0.1, 0.3, 0.2, 0.4, 0.2, 0.3, 0.1],
    "n-4": [0.4, 0.5, 0.6, 0.5, 0.7, 0.5, 0.4],
    "n-32": [0.5, 0.6, 0.5, 0.8, 0.6, 0.7, 0.6],
}


def test_the_analysis_by_hand() -> None:
    found = judged(rows_of(RATES), ("a", "b"), range(10))
    assert not found.missing
    rates = np.array([RATES[name] for name in ("n-0", "n-4", "n-32")])
    x = np.log2([1.0, 5.0, 33.0])
    slopes = [np.polyfit(x, one, 1)[0] for one in rates.T]
    expected = [sign_flip(rates[2] - rates[0]), sign_flip(rates[2] - rates[1]), sign_flip(slopes)]
    tests = confirmed(found)
    assert [one.contrast for one in tests] == list(CONFIRMATORY)
    for one, test in zip(tests, expected, strict=True):
        assert one.test is not None
        assert one.test.p_value == test.p_value
        assert one.test.difference.value == pytest.approx(test.difference.value)
        assert (one.test.difference.low, one.test.difference.high) == pytest.approx(
            (test.difference.low, test.difference.high)
        )
    assert [one.corrected for one in tests] == holm([test.p_value for test in expected])


def test_what_is_incomplete_is_not_used() -> None:
    table = rows_of({**RATES, "n-32": RATES["n-32"][:-1]})
    table = table.drop(table[(table["policy"] == "n-4-seed-2") & (table["seed"] == 3)].index[:1])
    found = judged(table, ("a", "b"), range(10))
    assert [(one.policy, one.done, one.all) for one in found.missing] == [("n-4-seed-2", 19, 20)]
    tests = confirmed(found)
    assert [list(one.seeds) for one in tests] == [[0, 1, 2, 3, 4, 5], [0, 1, 3, 4, 5], [0, 1, 3, 4, 5]]
    assert [list(one.unpaired) for one in tests] == [[6], [2, 6], [2, 6]]
    none = over_seeds(found, slope({"n-0": 0, "n-64": 64}))
    assert none.test is None
    assert not none.seeds
    twice = pd.concat([table, table[table["kind"] == "episodes"].tail(1)])
    with pytest.raises(InputError, match="are not distinct ones of the plan"):
        judged(twice, ("a", "b"), range(10))
    with pytest.raises(InputError, match="are not distinct ones of the plan"):
        judged(table, ("a",), range(10))
    only = judged(table[table["kind"] == "training"].drop(columns=["arm"]), ("a", "b"), range(10))
    assert not only.rates
    assert [one.test for one in confirmed(only)] == [None] * 3


def test_a_confirmatory_finding_needs_the_corrected_test() -> None:
    """The interval excludes zero, and after Holm's correction the test does not reject."""
    rates = {"n-0": [0.1] * 6, "n-4": [0.2, 0.0] * 3, "n-32": [0.2, 0.3, 0.4, 0.2, 0.3, 0.4]}
    found = confirmed(judged(rows_of(rates), ("a", "b"), range(10)))[0]
    assert found.test is not None
    assert found.corrected is not None
    assert found.test.difference.low > 0
    assert found.test.p_value < 0.05 < found.corrected
    assert found.finding == "undecided"
    assert replace(found, corrected=None).finding == "more"  # as an exploratory contrast


def test_pairs_that_were_added_are_tested_alone() -> None:
    first, new = [0.3, -0.1, 0.2, 0.1, 0.2, 0.3], [0.1, 0.1, 0.2, 0.1, 0.3, 0.2]
    rates = {"n-0-long": [0.4] * 12, "n-32-long": [round(0.4 + one, 1) for one in (*first, *new)]}
    parts = in_parts(difference("n-32-long", "n-0-long"))
    assert [one.use for one in parts] == ["interval", "test", "estimate"]
    found = judged(rows_of(rates), ("a", "b"), range(10))
    results = [over_seeds(found, one) for one in parts]
    assert [list(one.seeds) for one in results] == [[*range(6)], [*range(6, 12)], [*range(12)]]
    for one, values in zip(results, (first, new, [*first, *new]), strict=True):
        assert one.test is not None
        assert one.test.difference.value == pytest.approx(np.mean(values))
        assert one.test.p_value == sign_flip(values).p_value
    assert [one.finding for one in results] == ["undecided", "more", "estimate"]
    # One difference of the other sign, and the test does not reject.
    rates["n-32-long"][7] = 0.3
    found = judged(rows_of(rates), ("a", "b"), range(10))
    assert over_seeds(found, parts[1]).finding == "undecided"
    # Equal policies are undecided by the test, whose rule knows nothing of a margin.
    same = judged(rows_of({"n-0-long": [0.4] * 12, "n-32-long": [0.4] * 12}), ("a", "b"), range(10))
    assert [over_seeds(same, one).finding for one in parts] == ["small", "undecided", "estimate"]
    # The test and the estimate wait for all their pairs.
    some = judged(rows_of({**rates, "n-32-long": rates["n-32-long"][:11]}), ("a", "b"), range(10))
    results = [over_seeds(some, one) for one in parts]
    assert [one.finding for one in results] == ["undecided", "not measured", "not measured"]
    assert [list(one.unpaired) for one in results] == [[], [11], [11]]


def test_nothing_is_concluded_from_pairs_that_were_run_because_of_others() -> None:
    """Whatever holds for one of the policies that are trained for longer holds for a contrast of them."""
    pairs = {"n-32-long", "n-0-long"}
    both = [one for one in EXPLORATORY["compute"] if pairs <= set(one.recipes)]
    assert [(one.use, len(one.seeds)) for one in both] == [
        ("interval", 6),
        ("test", 6),
        ("estimate", 12),
        ("estimate", 12),
    ]


def test_changes_of_arms_are_those_of_the_same_policies() -> None:
    table = rows_of({"n-4": FEWER, "n-32": MORE})
    cut = rows_of({"n-4": MORE, "n-32": [0.0] * 8})
    cut = cut[(cut["kind"] == "episodes") & (cut["policy"] != "n-4-seed-7")].assign(arm="future-unread")
    table = pd.concat([table, cut])
    found = changes(table, judged(table, ("a", "b"), range(10)), ("a", "b"), range(10))
    assert [(one.recipe, one.arm, one.test.pairs) for one in found] == [
        ("n-4", "future-unread", 7),
        ("n-32", "future-unread", 8),
    ]
    expected = sign_flip(-np.array(MORE))
    assert found[1].test.p_value == expected.p_value
    assert found[1].test.difference.value == pytest.approx(expected.difference.value)


def test_tasks_have_equal_weight() -> None:
    table = rows_of({"n-0": [0.0]})
    table.loc[table["task"] == "a", "success"] = True
    assert judged(table, ("a", "b"), range(10)).rates == {"n-0": {0: 0.5}}


def test_power_is_the_rate_of_rejection() -> None:
    known: dict[str, Any] = {"run_deviation": 0.06, "correlation": 0.3, "rate": 0.5, "episodes": 100}
    none = power(**known, num_seeds=10, effects=(0, 0, 0), draws=4000)
    assert all(share < 0.03 for share in none.values())  # Holm's correction
    few = power(**known, num_seeds=6, effects=(0, 0.2, 0.4), draws=200)
    assert set(few.values()) == {0.0}  # p is at least 2 / 64, and corrected three times that
    large = power(**known, num_seeds=8, effects=(-0.3, 0, 0.3), draws=200)
    assert min(large.values()) > 0.95
    less = power(**known, num_seeds=12, effects=(0, 0.05, 0.1), draws=2000)
    more = power(**{**known, "correlation": 0.9}, num_seeds=12, effects=(0, 0.05, 0.1), draws=2000)
    assert all(more[name] > less[name] for name in less)
    for wrong in ({"rate": 1.5}, {"correlation": -1}, {"episodes": 0}, {"run_deviation": math.nan}):
        with pytest.raises(InputError, match="rate, correlation"):
            power(**{**known, **wrong}, num_seeds=6, effects=(0, 0, 0))
    with pytest.raises(InputError, match="effects: given 2"):
        power(**known, num_seeds=6, effects=(0, 0))


def test_power_agrees_with_the_analysis_of_tables() -> None:
    """One simulated study, analysed through its table, gives the verdicts that `power` counts."""
    rng = np.random.default_rng(0)
    rejected = np.zeros(3)
    for _ in range(40):
        true = np.clip(0.5 + np.array([0, 0.1, 0.2]) + 0.05 * rng.standard_normal((7, 3)), 0, 1)
        rates = rng.binomial(20, true) / 20
        table = rows_of(dict(zip(("n-0", "n-4", "n-32"), rates.T.tolist(), strict=True)), 20)
        tests = confirmed(judged(table, ("a", "b"), range(20)))
        rejected += [one.corrected is not None and one.corrected <= 0.05 for one in tests]
    # The two tasks of `rows_of` succeed in the same episodes, so a policy has 20 of them.
    known: Any = {"run_deviation": 0.05, "correlation": 0.0, "rate": 0.5, "episodes": 20, "num_seeds": 7}
    expected = list(power(**known, effects=(0, 0.1, 0.2)).values())
    np.testing.assert_allclose(rejected / 40, expected, atol=4 * 0.5 / math.sqrt(40))
