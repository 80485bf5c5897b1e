"""Which measures are correlated with what a cut costs: in all, within recipes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from made_tables import rows_of
from scipy.stats import pearsonr, rankdata, spearmanr

from saccade_lab.study.statistics import Estimate
from why_32.correlations import correlated_within, correlation_within, rank_correlation
from why_32.relations import Relation, by_seed, relations
from why_32.results import judged

SEEDS = 12
#: Success without and with the cut, of ten episodes: what it costs is known, and larger for 32 tokens.
PLAIN = {"n-4": [0.9] * SEEDS, "n-32": [1.0] * SEEDS}
CUT = {
    "n-4": [0.9, 0.8, 0.7, 0.8, 0.9, 0.7, 0.8, 0.9, 0.7, 0.8, 0.9, 0.8],
    "n-32": [0.3, 0.1, 0.4, 0.2, 0.0, 0.2, 0.5, 0.4, 0.3, 0.1, 0.2, 0.5],
}
COST = {name: np.round(np.array(PLAIN[name]) - CUT[name], 6) for name in PLAIN}


def measured(**measures: dict[str, list[float]]) -> pd.DataFrame:
    """A table of policies with these measures, by recipe, and others that are not there."""
    table = rows_of(PLAIN)
    cut = rows_of(CUT)
    cut = cut[cut["kind"] == "episodes"].assign(arm="future-unread")
    rows = table[table["kind"] == "training"].assign(kind="measures")
    for name in ("chunk_change", "attention_mass", "gradient_share", "probe_r2"):
        found = measures.get(name, {})
        rows[name] = [
            found[row["recipe"]][row["training_seed"]] if found else np.nan for row in rows.to_dict("records")
        ]
    return pd.concat([table, cut, rows])


def related(table: pd.DataFrame) -> list[Relation]:
    return relations(table, judged(table, ("a", "b"), range(10)), ("a", "b"), range(10))


def test_between_perfect_and_within_nil() -> None:
    """The measure knows N and nothing else: pooled it looks good, within the recipes there is nothing."""
    order = [0, 1, 2, 1, 0, 2]  # one cost of each rank pair: by hand, nil with the measure below
    cost = {"n-4": [0.1 * one for one in order], "n-32": [5 + 0.1 * one for one in order]}
    measure = {"n-4": [1.0, 1.0, 1.0, 2.0, 2.0, 2.0], "n-32": [11.0, 11.0, 11.0, 12.0, 12.0, 12.0]}
    for name in cost:
        assert spearmanr(measure[name], cost[name]).statistic == pytest.approx(0)
    pairs = {
        (name, seed): (measure[name][seed], cost[name][seed]) for name in cost for seed in range(len(order))
    }
    pooled = np.array(list(pairs.values()))
    assert float(rank_correlation(pooled)) == pytest.approx(spearmanr(*pooled.T).statistic)
    assert float(rank_correlation(pooled)) > 0.7
    assert float(correlation_within(by_seed(pairs))) == pytest.approx(0)


@pytest.mark.parametrize("lacking", [[], [("n-4", 3)], [("n-4", 0), ("n-32", 0), ("n-16", 7), ("n-16", 8)]])
def test_within_recipes_as_scipy_has_it(lacking: list[tuple[str, int]]) -> None:
    """Ranks of each recipe, centred, then Pearson's correlation of all; some policies are not there."""
    generator = np.random.default_rng(1)
    numbers = {
        (name, seed): tuple(generator.integers(0, 5, 2).astype(float))
        for name in ("n-4", "n-16", "n-32")
        for seed in range(9)
    }
    for one in lacking:
        del numbers[one]
    numbers = {key: (pair[0] + 100 * len(key[0]), pair[1]) for key, pair in numbers.items()}
    centred = []
    for recipe in ("n-4", "n-16", "n-32"):
        some = np.array([pair for (name, _), pair in numbers.items() if name == recipe])
        ranks = np.column_stack([rankdata(column) for column in some.T])
        centred.append(ranks - (len(some) + 1) / 2)
    expected = pearsonr(*np.concatenate(centred).T).statistic
    values = by_seed(numbers)
    assert float(correlation_within(values)) == pytest.approx(expected)
    # The same for many draws at once, of which one has every seed once, in another order.
    draws = np.stack([values[::-1], values[[0] * 9], values])
    found = correlation_within(draws)
    assert found.shape == (3,)
    np.testing.assert_allclose(found[[0, 2]], expected)
    assert math.isnan(found[1])  # nothing varies within a recipe


def test_the_interval_draws_training_seeds_with_all_their_policies() -> None:
    """The policies of a seed are drawn together: a second recipe that repeats the first adds nothing."""
    generator = np.random.default_rng(2)
    one = generator.normal(size=(12, 1, 2)) + generator.normal(size=(12, 1, 1))
    alone, twice = correlated_within(one), correlated_within(np.concatenate([one, one], axis=1))
    assert (twice.value, twice.low, twice.high) == pytest.approx((alone.value, alone.low, alone.high))
    assert alone.low < alone.value < alone.high


def test_measures_are_related_to_what_a_cut_costs() -> None:
    generator = np.random.default_rng(0)
    noise = {name: list(generator.random(SEEDS)) for name in PLAIN}
    table = measured(
        chunk_change={name: list(3 * COST[name] + 1) for name in PLAIN},
        attention_mass={"n-4": noise["n-4"], "n-32": [2 + one for one in noise["n-32"]]},
        gradient_share={name: [0.5] * SEEDS for name in PLAIN},
    )
    table = table[~((table["kind"] == "measures") & (table["policy"] == "n-4-seed-7"))]
    found = related(table)
    assert [(one.measure, one.policies, one.seeds) for one in found] == [
        ("chunk_change", 23, 12),
        ("attention_mass", 23, 12),
        ("gradient_share", 23, 12),
    ]
    assert found[0].within.value == found[0].together.value == pytest.approx(1)
    policies = [(name, seed) for name in PLAIN for seed in range(SEEDS) if (name, seed) != ("n-4", 7)]
    masses = [noise[name][seed] + (2 if name == "n-32" else 0) for name, seed in policies]
    costs = [COST[name][seed] for name, seed in policies]
    together = spearmanr(masses, costs).statistic
    assert found[1].together.value == pytest.approx(together)
    assert found[1].together.low < together < found[1].together.high
    assert found[1].within.low < 0 < found[1].within.high
    assert math.isnan(found[2].within.value)  # the same for all
    assert math.isnan(found[2].together.value)
    assert [(one.predicts, one.tells_recipes) for one in found] == [
        (True, False),
        (False, True),
        (False, False),
    ]
    assert not replace(found[0], seeds=9).predicts
    assert not replace(found[1], policies=9).tells_recipes


def test_without_intervals() -> None:
    """Few training seeds show nothing, whatever their interval is."""
    certain = Estimate(0.9, 0.8, 1.0)
    few = Relation("probe_r2", 18, 9, certain, certain)
    assert not few.predicts
    assert few.tells_recipes
    none = Estimate(0.9, math.nan, math.nan)
    assert not Relation("probe_r2", 24, 12, none, none).predicts
    assert not Relation("probe_r2", 24, 12, none, none).tells_recipes
