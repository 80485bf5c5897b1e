"""The rules of docs/diagnose.md, on made-up effects; and their numbers, as the page states them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from saccade._internal.bootstrap import Estimate
from saccade.diagnosis import verdicts
from saccade.diagnosis.changes import Kind
from saccade.diagnosis.effects import Measured
from saccade.diagnosis.verdicts import Effect, decided, effect_of, verdict_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "diagnose.md"


def effect(kind: Kind | None, low: float, high: float, episodes: int = 20, of_noise: float = 5.0) -> Effect:
    return Effect(
        kind=kind,
        share=Estimate((low + high) / 2, low, high),
        of_noise=Estimate(of_noise, of_noise, of_noise),
        units={},
        episodes=episodes,
        largest=(0, 0),
    )


SEEN = effect(None, 1, 1)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"a": effect("main", 0.21, 0.4)}, "used"),
        ({"a": effect("main", 0.20, 0.4)}, "undecided"),
        ({"a": effect("main", 0.0, 0.049)}, "ignored"),
        ({"a": effect("main", 0.0, 0.0)}, "ignored"),
        ({"a": effect("main", 0.0, 0.05)}, "undecided"),
        ({"a": effect("main", 0.06, 0.19)}, "barely used"),
        ({"a": effect("main", 0.06, 0.20)}, "undecided"),
        ({"a": effect("main", 0.0, 0.01), "b": effect("natural", 0.06, 0.9)}, "barely used"),
        ({"a": effect("main", 0.0, 0.01), "b": effect("natural", 0.04, 0.06)}, "undecided"),
        ({"a": effect("main", 0.0, 0.01), "b": effect("removal", 0.1, 0.19)}, "ignored"),
        ({"a": effect("main", 0.0, 0.01), "b": effect("removal", 0.1, 0.21)}, "barely used"),
        ({"a": effect("main", 0.3, 0.5), "b": effect("natural", 0.0, 0.01)}, "used"),
        # No main change, or one in too few episodes.
        ({"b": effect("removal", 0.0, 0.04)}, "ignored"),
        ({"b": effect("removal", 0.0, 0.06)}, "undecided"),
        ({"b": effect("natural", 0.8, 0.9)}, "undecided"),
        ({"a": effect("main", 0.8, 0.9, episodes=4)}, "undecided"),
        ({"a": effect("main", 0.8, 0.9, episodes=4), "b": effect("natural", 0.0, 0.01)}, "ignored"),
        ({"a": effect("main", math.nan, math.nan)}, "undecided"),
    ],
)
def test_the_first_rule_that_holds_decides(changes: dict[str, Effect], expected: str) -> None:
    assert decided(changes, SEEN) == expected


def test_few_episodes_and_a_deaf_policy_come_first() -> None:
    used = {"a": effect("main", 0.5, 0.9)}
    assert decided(used, effect(None, 1, 1, episodes=4)) == "undecided"
    assert decided(used, None) == "undecided"
    assert decided(used, effect(None, 1, 1, of_noise=0.009)) == "ignored"
    assert decided({}, effect(None, 1, 1, of_noise=0.009)) == "ignored"
    assert decided({}, SEEN) == "undecided"
    assert decided(used, effect(None, 1, 1, of_noise=0.011)) == "used"


def test_the_page_states_the_numbers() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert f"fewer than {verdicts.FEWEST_EPISODES} episodes" in text
    assert f"main change is above {verdicts.USED:.2f}" in text
    assert f"natural changes are below {verdicts.IGNORED:.2f}" in text
    assert f"removals below {verdicts.REMOVED:.2f}" in text
    assert f"is below {verdicts.DEAF:.2f}" in text


def test_an_effect_is_the_root_of_the_ratio_of_sums() -> None:
    names = np.array(["|noise|", "|whole|", "state|swapped|main"])
    measured = [
        Measured(
            0,
            np.array([1, 3]),
            names,
            np.array([[4.0, 1.0, 0.25], [2.0, 3.0, 0.75]]),
            np.ones((2, 3, 1)),
            0.0,
        ),
        Measured(5, np.array([2]), names, np.array([[8.0, 2.0, np.nan]]), np.zeros((1, 3, 1)), 0.0),
        Measured(7, np.array([2]), names, np.array([[10.0, 4.0, 3.0]]), np.full((1, 3, 1), 4.0), 0.0),
    ]
    found = effect_of(measured, "state|swapped|main", "|whole|", "|noise|", ["hand"], "main")
    assert found is not None
    assert found.share.value == pytest.approx(math.sqrt(4 / 8))  # without the observation that has none
    assert found.of_noise.value == pytest.approx(math.sqrt(4 / 16))
    # Resamples of two episodes: only the first, only the last, or both.
    assert found.share.low == pytest.approx(math.sqrt(1 / 4))
    assert found.share.high == pytest.approx(math.sqrt(3 / 4))
    assert (found.episodes, found.largest, found.units) == (2, (7, 2), {"hand": 2.0})
    assert effect_of(measured, "state|frozen|natural", "|whole|", "|noise|", ["hand"], "natural") is None


def test_a_verdict_shows_the_main_change_or_the_largest_of_the_others() -> None:
    natural, removal = effect("natural", 0.1, 0.3), effect("removal", 0.5, 0.7)
    assert verdict_of({"a": natural, "b": removal}, SEEN).low == 0.5
    assert verdict_of({"a": removal, "m": effect("main", 0.0, 0.1), "b": natural}, SEEN).high == 0.1


def test_a_change_that_few_episodes_allow_is_shown_only_without_others() -> None:
    rare = effect("main", 0.6, 0.8, episodes=4)
    verdict = verdict_of({"m": rare, "a": effect("natural", 0.01, 0.02)}, SEEN)
    assert (verdict.name, verdict.high) == ("ignored", 0.02)
    assert verdict_of({"m": rare}, SEEN).high == 0.8  # all that there is, of no verdict
