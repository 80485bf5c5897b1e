"""The picture of errors by step: the policy's and the baselines', as loops over the chunks find them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import saccade
from saccade.evaluation import Evaluation
from saccade_lab.recordings import pictures
from saccade_lab.recordings.baselines import baselines_by_step
from tests.helpers.recorded_cases import Recorded, demo_policy, made_up

LENGTHS = (9, 5, 8)
STRIDE = 4


@pytest.fixture(scope="module")
def data() -> Recorded:
    """Recordings in which one key of the action is the state, so that holding still repeats it."""
    given = made_up(LENGTHS)
    hand = [np.stack([seen["state"]["hand"][0, 0] for seen in episode]) for episode in given.seen]
    return Recorded(given.seen, {**given.done, "hand": hand})


@pytest.fixture(scope="module")
def report(data: Recorded) -> Evaluation:
    return saccade.evaluate(demo_policy(), data, stride=STRIDE)


def by_loops(data: Recorded, report: Evaluation) -> dict[str, list[float]]:
    """Errors of the baselines by step, one chunk after the other."""
    keys = list(demo_policy().normalizer.action_slices)
    recorded = [np.concatenate([data.done[key][one] for key in keys], axis=-1) for one in range(len(data))]
    mean = np.mean(np.concatenate(recorded).astype(np.float64), axis=0)
    found: dict[str, list[float]] = {"hold": [], "mean": [], "noise": []}
    for step in range(report.horizon):
        episodes: dict[str, list[float]] = {name: [] for name in found}
        for episode, length in enumerate(LENGTHS):
            chunks: dict[str, list[float]] = {name: [] for name in found}
            for place, start in enumerate(range(0, length - step, STRIDE)):
                truth, one = recorded[episode][start + step], report.predictions[episode].predicted[place]
                still = [
                    data.seen[episode][start]["state"][key][0, 0]
                    if report.hold[key] == "state"
                    else np.zeros_like(data.done[key][episode][0])
                    for key in keys
                ]
                chunks["hold"].append(float(np.mean((np.concatenate(still) - truth) ** 2)))
                chunks["mean"].append(float(np.mean((mean - truth) ** 2)))
                chunks["noise"].append(float(np.mean((one[1, step] - one[0, step]) ** 2)))
            for name, values in chunks.items():
                if values:
                    episodes[name].append(float(np.mean(values)))
        for name, values in episodes.items():
            found[name].append(float(np.mean(values)) if values else math.nan)
    return found


def test_the_baselines_are_at_the_steps_of_the_curve(data: Recorded, report: Evaluation) -> None:
    assert report.hold == {"hand": "state", "gripper": "zero"}
    expected = by_loops(data, report)
    lasts = max(LENGTHS)  # no chunk has a later step
    assert all(math.isnan(value) for values in expected.values() for value in values[lasts:])
    found = baselines_by_step(report)
    assert list(found) == list(report.baselines)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-5)
    (axes,) = pictures.by_step(report).axes
    drawn: dict[Any, Any] = {line.get_label(): line for line in axes.lines}
    assert set(drawn) == {"policy", *report.baselines}
    for line in drawn.values():
        np.testing.assert_array_equal(line.get_xdata(), np.arange(lasts))
    np.testing.assert_array_equal(drawn["policy"].get_ydata(), [one.mse for one in report.by_step[:lasts]])
    for name, values in found.items():
        np.testing.assert_array_equal(drawn[name].get_ydata(), values[:lasts])


def test_chunks_that_are_carried_out_as_a_whole_have_the_baselines_of_the_report() -> None:
    whole = saccade.evaluate(demo_policy(), made_up((32, 16)), stride=16)
    for name, values in baselines_by_step(whole).items():
        assert np.mean(values) == pytest.approx(whole.baselines[name].mse, rel=1e-5)


def test_one_episode_is_drawn_without_an_interval(data: Recorded) -> None:
    alone = saccade.evaluate(demo_policy(), data, episodes=[2], stride=STRIDE)
    figure = pictures.by_step(alone)
    (axes,) = figure.axes
    assert len(axes.lines) == 4
    assert axes.get_ylim()[1] >= max(one.mse for one in alone.by_step[: LENGTHS[2]])
    assert pictures.png(figure).startswith(b"\x89PNG")
