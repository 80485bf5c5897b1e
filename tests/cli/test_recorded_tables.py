"""The tables of `saccade evaluate` and `saccade diagnose` over few episodes say so, and have no "nan"."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

import saccade
from saccade.cli import against, diagnose, evaluate
from saccade.cli.output import Section
from tests.helpers.recorded_cases import Recorded, demo_policy, made_up


@pytest.fixture(scope="module")
def data() -> Recorded:
    return made_up((5, 2, 1))


def cells(sections: Sequence[Section]) -> list[str]:
    return [cell for section in sections for row in section.rows for cell in row]


def test_one_episode_has_dashes_for_intervals(data: Recorded) -> None:
    report, coarse = (
        saccade.evaluate(demo_policy(), data, episodes=[0], stride=4, num_steps=count) for count in (None, 1)
    )
    (errors,) = evaluate.tables(report)
    assert [row[2] for row in errors.rows] == ["–"] * 6
    assert errors.note == "One episode has no interval."
    compared = against.sections(report, report.compare(coarse), coarse, "coarse")
    assert [row[4] for row in compared[0].rows] == ["–"] * 4
    verdicts, effects = diagnose.tables(saccade.diagnose(demo_policy(), data, episodes=[0]))
    assert verdicts.rows[0] == ["instruction", "undecided", "–", "–"]
    assert effects.note == "One episode has no interval."
    assert not any("nan" in cell for cell in cells([errors, *compared, verdicts, effects]))


def test_few_episodes_are_named(data: Recorded) -> None:
    (errors,) = evaluate.tables(saccade.evaluate(demo_policy(), data, stride=4))
    assert errors.note == "The intervals are over 3 episodes: with fewer than 10 they are too narrow."
    _, effects = diagnose.tables(saccade.diagnose(demo_policy(), data, episodes=[0, 1]))
    assert "with fewer than 10 they are too narrow" in effects.note
    assert {row[5] for row in effects.rows} <= {"1", "2"}
