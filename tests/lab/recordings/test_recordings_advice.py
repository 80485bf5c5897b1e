"""What the page of a diagnosis advises fits the verdict, by the rule that decided."""

from __future__ import annotations

import math

import pytest

from saccade.diagnosis import Effect
from saccade.diagnosis.verdicts import verdict_of
from saccade_lab.recordings import advice as texts
from saccade_lab.recordings.advice import advice
from tests.helpers.effect_cases import SEEN, effect

DEAF = effect(None, 1, 1, of_noise=0.001)
NAN = math.nan


@pytest.mark.parametrize(
    ("name", "changes", "observation", "verdict", "expected"),
    [
        ("state", {"swapped": effect("main", 0.5, 0.9)}, None, "undecided", texts.FEW),
        ("camera.top", {}, effect(None, 1, 1, episodes=4), "undecided", texts.FEW),
        # The whole policy is deaf: also an input that is the same everywhere is called ignored.
        ("camera.top", {}, DEAF, "ignored", texts.NOTHING_SHOWN),
        ("state", {"swapped": effect("main", 0.0, 0.1)}, DEAF, "ignored", texts.NOTHING_SHOWN),
        ("state", {}, SEEN, "undecided", texts.SAME),
        ("history", {"repeated": effect("main", 0.5, 0.9, episodes=4)}, SEEN, "undecided", texts.SELDOM),
        # One instruction only: more of the same episodes would not help.
        (
            "instruction",
            {"emptied": effect("removal", 0.5, 0.9)},
            SEEN,
            "undecided",
            texts.NO_MAIN["instruction"],
        ),
        (
            "instruction",
            {"emptied": effect("removal", 0, 0.01)},
            SEEN,
            "ignored",
            texts.LITTLE["instruction"],
        ),
        ("camera.top", {"blanked": effect("removal", 0.5, 0.9)}, SEEN, "undecided", texts.NO_MAIN["other"]),
        ("state", {"shifted": effect("natural", 0.5, 0.9)}, SEEN, "undecided", texts.NO_MAIN["other"]),
        ("state", {"swapped": effect("main", 0.1, 0.3)}, SEEN, "undecided", texts.AT_A_LIMIT),
        ("state", {"swapped": effect("main", NAN, NAN)}, SEEN, "undecided", texts.NO_ACTIONS_CHANGE),
        ("state", {"frozen": effect("natural", NAN, NAN)}, SEEN, "undecided", texts.NO_ACTIONS_CHANGE),
        ("state", {"swapped": effect("main", 0, 0.01)}, SEEN, "ignored", texts.LITTLE["state"]),
        ("camera.top", {"swapped": effect("main", 0.06, 0.19)}, SEEN, "barely used", texts.LITTLE["camera"]),
        ("history", {"repeated": effect("main", 0, 0.01)}, SEEN, "ignored", texts.LITTLE["history"]),
        ("camera.top", {"swapped": effect("main", 0.5, 0.9)}, SEEN, "used", ""),
        (
            "state",
            {"swapped": effect("main", 0.5, 0.9), "frozen": effect("natural", 1.1, 1.4)},
            SEEN,
            "used",
            texts.LEAK,
        ),
        (
            "state",
            {"swapped": effect("main", 0.5, 0.9), "frozen": effect("natural", 0.9, 1.4)},
            SEEN,
            "used",
            "",
        ),
    ],
)
def test_the_advice_fits_the_rule(
    name: str, changes: dict[str, Effect], observation: Effect | None, verdict: str, expected: str
) -> None:
    found = verdict_of(changes, observation)
    assert found.name == verdict
    assert advice(name, found) == expected
