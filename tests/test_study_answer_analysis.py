"""The analysis of `saccade study answer` by hand: tests, findings, sentences and power."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

from saccade.errors import InputError
from saccade.study.answer.contrasts import CONFIRMATORY, slope
from saccade.study.answer.power import power
from saccade.study.answer.results import changes, confirmed, judged, over_seeds, relations
from saccade.study.answer.section import relation_grid
from saccade.study.answer.study import Answer
from saccade.study.section import Section
from saccade.study.sign_flip import sign_flip
from saccade.study.statistics import holm
from saccade.study.table import Provenance


def rows_of(rates: dict[str, list[float]], episodes: int = 10) -> pd.DataFrame:
    """A table of policies with these success rates on two tasks of `episodes` episodes."""
    rows: list[dict[str, Any]] = []
    for name, of_recipe in rates.items():
        for seed, rate in enumerate(of_recipe):
            policy = {
                "stage": "core",
                "recipe": name,
                "policy": f"{name}-seed-{seed}",
                "training_seed": seed,
                "num_future_tokens": int(name.split("-")[1]),
            }
            rows.append({"kind": "training", **policy})
            for task in ("a", "b"):
                for episode in range(episodes):
                    result = {"task": task, "seed": episode, "success": episode < round(rate * episodes)}
                    rows.append({"kind": "episodes", "arm": "plain", **policy, **result})
    return pd.DataFrame(rows)


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


def provenance_of(episodes: int = 10) -> Provenance:
    return Provenance("answer", {"tasks": ["a", "b"], "episodes": list(range(episodes))}, 1, 1)


def section_of(rates: dict[str, list[float]]) -> Section:
    table = rows_of(rates)
    return Answer.summarise(table.assign(validation_loss=0.5), provenance_of())


FEWER, MORE = [0.1, 0.2, 0.1, 0.2, 0.1, 0.2, 0.1, 0.2], [0.7, 0.9, 0.8, 0.7, 0.9, 0.8, 0.7, 0.9]


@pytest.mark.parametrize(
    ("zero", "four", "many", "said"),
    [
        (FEWER, FEWER, MORE, ("more", "more", "more")),
        (MORE, MORE, FEWER, ("less", "less", "less")),
        (FEWER, FEWER, FEWER, ("small", "small", "small")),
        (FEWER[:5], FEWER[:5], MORE[:5], ("undecided", "undecided", "undecided")),
        ([0.1, 0.9] * 4, [0.5] * 8, [0.8, 0.2] * 4, ("undecided", "undecided", "undecided")),
        (FEWER, [], MORE, ("more", "not measured", "not measured")),
    ],
)
def test_findings_follow_from_their_rules(
    zero: list[float], four: list[float], many: list[float], said: tuple[str, ...]
) -> None:
    section = section_of({"n-0": zero, "n-4": four, "n-32": many})
    tests = next(grid for grid in section.grids if grid.caption.startswith("Table 1."))
    assert tuple(row[-1] for row in tests.rows) == said
    words = {
        "more": "succeed more often than policies trained without any: by 6",
        "less": "succeed less often than policies trained without any: by -6",
        "small": "there is no difference of 10 points or more: 0.0 points (0.0 to 0.0)",
        "undecided": "is undecided: ",
    }
    assert words[said[0]] in section.concluded[0]
    assert "(table 1)" in section.concluded[0]
    if said[1] == "not measured":
        assert section.concluded[1].startswith("Not measured: ")
    else:
        assert "Mean success is" in section.concluded[3]
    assert len(section.figures) == 1


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


def test_later_stages_have_their_tables() -> None:
    section = section_of(
        {
            "n-0": FEWER,
            "n-4": FEWER,
            "n-32": MORE,
            "n-4-aligned": MORE,
            "n-0-wide": FEWER,
            "n-4-patch-8": FEWER,
            "n-32-patch-8": FEWER,
        }
    )
    captions = [grid.caption for grid in section.grids]
    assert [caption.split(".")[0] for caption in captions] == [f"Table {place}" for place in range(1, 7)]
    by_name = {row[0]: row for grid in section.grids[2:] for row in grid.rows}
    assert by_name["n-4-aligned minus n-4"][-1] == "more"
    assert by_name["n-32-patch-8 minus n-4-patch-8"][-1] == "small"
    assert by_name["(n-32-patch-8 minus n-4-patch-8) minus (n-32 minus n-4)"][-1] == "less"
    (costly,) = [line for line in section.concluded if line.startswith("Exploratory: ")]
    assert "succeed more often than wider policies without tokens that cost as much" in costly
    assert "(table 5)" in costly


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


def test_measures_are_related_to_what_a_cut_costs() -> None:
    plain, cut = (
        {"n-4": FEWER, "n-32": MORE},
        {"n-4": FEWER, "n-32": [0.0, 0.3, 0.1, 0.2, 0.4, 0.5, 0.6, 0.8]},
    )
    table = rows_of(plain)
    changed = rows_of(cut)
    changed = changed[changed["kind"] == "episodes"].assign(arm="future-unread")
    lost = {
        (recipe, seed): round(plain[recipe][seed] - cut[recipe][seed], 6)
        for recipe in plain
        for seed in range(8)
    }
    rng = np.random.default_rng(0)
    trained = table[table["kind"] == "training"]
    measured = trained.assign(
        kind="measures",
        chunk_change=[
            3 * lost[row["recipe"], row["training_seed"]] + 1 for row in trained.to_dict("records")
        ],
        attention_mass=rng.random(len(trained)),
        gradient_share=0.5,
        probe_r2=np.nan,
    )
    table = pd.concat([table, changed, measured[measured["policy"] != "n-4-seed-7"]])
    found = relations(table, judged(table, ("a", "b"), range(10)), ("a", "b"), range(10))
    assert [(one.measure, one.policies) for one in found] == [
        ("chunk_change", 15),
        ("attention_mass", 15),
        ("gradient_share", 15),
    ]
    assert found[0].correlation.value == pytest.approx(1)
    masses = dict(zip(measured["policy"], measured["attention_mass"], strict=True))
    pairs = [(masses[f"{recipe}-seed-{seed}"], lost[recipe, seed]) for recipe in plain for seed in range(8)]
    del pairs[7]
    expected = spearmanr(*zip(*np.round(pairs, 12), strict=True)).statistic
    assert found[1].correlation.value == pytest.approx(expected)
    assert found[1].correlation.low < expected < found[1].correlation.high
    assert math.isnan(found[2].correlation.value)  # the same for all
    section = Answer.summarise(table.assign(validation_loss=0.5), provenance_of())
    assert section.grids[-1].columns[0] == "measure"
    assert [row[1::2] for row in section.grids[-1].rows] == [["15", "15"]] * 3

    # Policies of other stages count in the second number only.
    of_core = table[(table["stage"] == "core") & (table["policy"] != "n-32-seed-3")]
    other = table[table["policy"] == "n-32-seed-3"].assign(
        stage="numbers", policy="n-16-seed-3", recipe="n-16"
    )
    table = pd.concat([of_core, other])
    section = Answer.summarise(table.assign(validation_loss=0.5), provenance_of())
    assert [row[1::2] for row in section.grids[-1].rows] == [["14", "15"]] * 3
    assert section.grids[-1].rows[1][4].startswith(f"{expected:.2f} (")
    alone = relation_grid("", [], found)
    assert [row[1:4] for row in alone.rows] == [["0", "", "15"]] * 3


def test_what_is_measured_has_its_tables() -> None:
    """Means over training seeds by hand; what no policy has is left empty."""
    rows = rows_of({name: [0.5] * 6 for name in ("n-4", "n-32")})
    rows = pd.concat([rows, rows[rows["recipe"] == "n-4"].assign(recipe="n-4-aligned", stage="alignment")])
    rows["policy"] = rows["recipe"] + "-seed-" + rows["training_seed"].astype(str)
    trained = rows[rows["kind"] == "training"].sample(frac=1, random_state=0)
    seeds, many = trained["training_seed"], trained["num_future_tokens"]
    measured = []
    for tokens, weight in itertools.product(("learned", "random"), ("kept", "lost")):
        numbers: dict[str, Any] = {"effective_tokens": 2.0 + seeds, "largest_share": 0.25, "overlap": 0.5}
        if tokens == "learned":
            numbers |= {"overlap": 0.75 + 0.01 * seeds, "effective_tokens": many / 2 + seeds}
        for size in ("two", "half", "all"):
            has_it = (weight == "lost") | ((size == "two") & (seeds > 0)) | ((size == "half") & (many > 4))
            numbers[f"explained_{size}"] = np.where(has_it, 0.5, np.nan)
            numbers[f"ratio_{size}"] = np.where(has_it, 1.5, np.nan)
        measured.append(trained.assign(kind="specialise", tokens=tokens, weight=weight, **numbers))
    for group, share in {"future": 0.1, "state": 0.2, "action": 1.0, "all rows": 1.0}.items():
        for block in ("all", "0"):
            found = share * (1 + 0.1 * seeds) if block == "all" else 9.0
            measured.append(trained.assign(kind="patching", group=group, block=block, share=found))
    table = pd.concat([rows, *measured]).assign(validation_loss=0.5)
    section = Answer.summarise(table, provenance_of())
    assert [figure.name for figure in section.figures] == ["success", "overlap"]
    captions = [grid.caption.split(".")[0] for grid in section.grids]
    assert captions == [f"Table {place}" for place in range(1, len(captions) + 1)]
    maps, removed, sums, patched = section.grids[-4:]
    assert [row[0] for row in maps.rows] == ["n-4", "n-32", "n-4-aligned"]
    overlaps = sign_flip([0.75 + 0.01 * seed for seed in range(6)]).difference
    shown = f"{overlaps.value:.3f} ({overlaps.low:.3f} to {overlaps.high:.3f})"
    assert maps.rows[1] == ["n-32", shown, "0.500 (0.500 to 0.500)", maps.rows[1][3]]
    assert maps.rows[1][3].startswith(f"{overlaps.value - 0.5:.3f} (")
    assert [row[:2] for row in removed.rows[:3]] == [["n-4", "kept"], ["n-4", "lost"], ["n-32", "kept"]]
    assert removed.rows[2][2] == "18.5 (16.0 to 21.0)"
    assert removed.rows[2][4:] == ["14.0 (14.0 to 14.0)", "0.250 (0.250 to 0.250)"]
    assert sums.columns[2:4] == ("two: share explained", "two: ratio")
    assert sums.rows[0][2:] == ["0.50 (no interval)", "1.50 (no interval)", "", "", "", ""]
    assert sums.rows[2][4:] == ["0.50 (0.50 to 0.50)", "1.50 (1.50 to 1.50)", "", ""]
    assert "" not in sums.rows[1]
    assert [cell.split()[0] for cell in patched.rows[0]] == ["n-4", "0.12", "0.25", "1.25", "1.25"]
    assert patched.columns == ("recipe", "future", "state", "action", "all rows")
    only = Answer.summarise(table[~table["kind"].isin(["specialise"])], provenance_of())
    assert only.grids[-1].rows == patched.rows
    assert only.grids[-1].caption.startswith(f"Table {len(only.grids)}. ")


def test_nothing_trained() -> None:
    table = pd.DataFrame([{"kind": "recording", "recording": "tiny"}])
    assert Answer.summarise(table, provenance_of()).concluded == ["Not measured: no policy is trained."]
    pilot = {"stage": "pilot", "recipe": "n-4-pilot", "policy": "n-4-pilot-seed-100", "training_seed": 100}
    table = pd.DataFrame([{"kind": "training", **pilot, "num_future_tokens": 4, "validation_loss": 0.25}])
    section = Answer.summarise(table, provenance_of())
    assert section.concluded == ["Not measured: no policy is trained."]
    assert [list(grid.rows) for grid in section.grids] == [[["n-4-pilot-seed-100", "0.2500", "", ""]]]


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
