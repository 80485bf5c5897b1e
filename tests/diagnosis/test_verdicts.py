"""The rules of docs/diagnose.md, on made-up effects; and their numbers, as the page states them."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

from saccade.diagnosis import Effect, verdicts
from saccade.diagnosis.effects import Measured
from saccade.diagnosis.verdicts import decided, effect_of, verdict_of
from tests.helpers.effect_cases import SEEN, effect

PAGE = Path(__file__).resolve().parents[2] / "docs" / "diagnose.md"


@pytest.mark.parametrize(
    ("changes", "expected", "rule"),
    [
        ({"a": effect("main", 0.21, 0.4)}, "used", 5),
        ({"a": effect("main", 0.20, 0.4)}, "undecided", 8),
        ({"a": effect("main", 0.0, 0.049)}, "ignored", 6),
        ({"a": effect("main", 0.0, 0.0)}, "ignored", 6),
        ({"a": effect("main", 0.0, 0.05)}, "undecided", 8),
        ({"a": effect("main", 0.06, 0.19)}, "barely used", 7),
        ({"a": effect("main", 0.06, 0.20)}, "undecided", 8),
        ({"a": effect("main", 0.0, 0.01), "b": effect("natural", 0.06, 0.9)}, "barely used", 7),
        ({"a": effect("main", 0.0, 0.01), "b": effect("natural", 0.04, 0.06)}, "undecided", 8),
        ({"a": effect("main", 0.0, 0.01), "b": effect("removal", 0.1, 0.19)}, "ignored", 6),
        ({"a": effect("main", 0.0, 0.01), "b": effect("removal", 0.1, 0.21)}, "barely used", 7),
        ({"a": effect("main", 0.3, 0.5), "b": effect("natural", 0.0, 0.01)}, "used", 5),
        # No change, or those of too few episodes.
        ({}, "undecided", 3),
        ({"a": effect("main", 0.8, 0.9, episodes=4)}, "undecided", 3),
        # No main change, or one in too few episodes.
        ({"b": effect("removal", 0.0, 0.04)}, "ignored", 4),
        ({"b": effect("removal", 0.0, 0.06)}, "undecided", 4),
        ({"b": effect("natural", 0.8, 0.9)}, "undecided", 4),
        ({"a": effect("main", 0.8, 0.9, episodes=4), "b": effect("natural", 0.0, 0.01)}, "ignored", 4),
        ({"a": effect("main", math.nan, math.nan)}, "undecided", 8),
    ],
)
def test_the_first_rule_that_holds_decides(changes: dict[str, Effect], expected: str, rule: int) -> None:
    assert decided(changes, SEEN) == (expected, rule)
    assert verdict_of(changes, SEEN).rule == rule


def test_few_episodes_and_a_deaf_policy_come_first() -> None:
    used = {"a": effect("main", 0.5, 0.9)}
    assert decided(used, effect(None, 1, 1, episodes=4)) == ("undecided", 1)
    assert decided(used, None) == ("undecided", 1)
    assert decided(used, effect(None, 1, 1, of_noise=0.009)) == ("ignored", 2)
    assert decided({}, effect(None, 1, 1, of_noise=0.009)) == ("ignored", 2)
    assert decided(used, effect(None, 1, 1, of_noise=0.011)) == ("used", 5)


def test_the_page_has_the_rules_with_their_numbers_and_names() -> None:
    text = PAGE.read_text(encoding="utf-8")
    listed = re.findall(r"^(\d)\. \*\*(used|barely used|ignored|undecided)\*\*", text, re.MULTILINE)
    assert [int(number) for number, _ in listed] == [rule.value for rule in verdicts.Rule]
    assert [name for _, name in listed] == [
        "undecided",
        "ignored",
        "undecided",
        "ignored",  # or undecided
        "used",
        "ignored",
        "barely used",
        "undecided",
    ]


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
