"""Open-loop errors: Isaac-GR00T's rule to the last digit, and numbers that a loop finds."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import InputError, Policy, ShapeError
from saccade.evaluation import Evaluation
from tests.helpers.recorded_cases import Recorded, by_the_policy, demo_policy, made_up

LENGTHS = (9, 5, 16)  # with a tail; shorter than a chunk; whole chunks


@pytest.fixture(scope="module")
def data() -> Recorded:
    return made_up(LENGTHS)


@pytest.fixture(scope="module")
def report(data: Recorded) -> Evaluation:
    return saccade.evaluate(demo_policy(), data, stride=4)


def chunk_at(data: Recorded, episode: int, step: int, seed: int = 0) -> dict[str, Any]:
    """What the documentation says that a prediction is."""
    found = demo_policy().act(data.observation(episode, step), seed=(seed, episode, step))
    return {f"action.{key}": part[0] for key, part in found.items()}


def as_the_script(data: Recorded, episode: int, horizon: int, keys: list[str]) -> tuple[Any, Any]:
    """MSE and MAE of an episode as N1.6's and N1.7's script computes them, step by step."""
    length, predicted = len(data.seen[episode]), []
    for step in range(0, length, horizon):
        chunk = chunk_at(data, episode, step)
        for j in range(horizon):
            predicted.append(np.concatenate([np.atleast_1d(chunk[f"action.{key}"][j]) for key in keys]))
    recorded = np.concatenate([np.vstack(list(data.done[key][episode])) for key in keys], axis=-1)
    apart = recorded - np.array(predicted)[:length]
    return np.mean(apart**2), np.mean(np.abs(apart))


def as_n15(data: Recorded, episode: int, steps: int, horizon: int, keys: list[str]) -> Any:
    """MSE of an episode as N1.5's function computes it: actions from the data point of each chunk."""
    recorded, predicted = [], []
    for step in range(steps):
        if step % horizon == 0:
            chunk, point = chunk_at(data, episode, step), data.actions(episode, step, horizon)
            for j in range(horizon):
                predicted.append(np.concatenate([chunk[f"action.{key}"][j] for key in keys]))
                recorded.append(np.concatenate([point[key][j] for key in keys]))
    return np.mean((np.array(recorded)[:steps] - np.array(predicted)[:steps]) ** 2)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("stride", [3, 16])
def test_the_mse_is_isaac_gr00ts_to_the_last_digit(dtype: Any, stride: int) -> None:
    data = made_up(LENGTHS, dtype)
    found = saccade.evaluate(demo_policy(), data, stride=stride)
    keys = list(demo_policy().normalizer.action_slices)
    expected = [as_the_script(data, episode, stride, keys) for episode in range(len(data))]
    assert {type(mse) for mse, _ in expected} == {dtype}
    assert found.mse == float(np.mean(np.array([mse for mse, _ in expected])))
    assert found.mae == float(np.mean(np.array([mae for _, mae in expected])))
    older = [as_n15(data, episode, length, stride, keys) for episode, length in enumerate(LENGTHS)]
    assert found.mse == float(np.mean(np.array(older)))


def test_the_default_stride_is_the_chunk(data: Recorded) -> None:
    found = saccade.evaluate(demo_policy(), data, episodes=[2])
    assert (found.stride, found.horizon, found.num_chunks) == (16, 16, 1)
    assert saccade.evaluate(demo_policy(), data, episodes=[2], stride=16).mse == found.mse


def test_errors_by_key_and_step_are_those_of_loops(data: Recorded, report: Evaluation) -> None:
    normalizer = demo_policy().normalizer
    by_key: dict[str, list[float]] = {key: [] for key in normalizer.action_slices}
    by_step: dict[int, list[float]] = {step: [] for step in range(16)}
    normalized: list[float] = []
    for episode, length in enumerate(LENGTHS):
        squares: dict[str, list[float]] = {key: [] for key in by_key}
        steps: dict[int, list[float]] = {step: [] for step in by_step}
        scaled: list[float] = []
        for step in range(0, length, 4):
            chunk, state = chunk_at(data, episode, step), data.seen[episode][step]["state"]
            told = np.concatenate([state[key][0, 0] for key in normalizer.state_slices])
            truth = {key: data.done[key][episode] for key in by_key}
            joined = [
                np.concatenate([part[key] for key in by_key], axis=-1)
                for part in ({key: chunk[f"action.{key}"] for key in by_key}, data.actions(episode, step, 16))
            ]
            one, other = (np.asarray(normalizer.normalize_actions(part, told)) for part in joined)
            for j in range(min(16, length - step)):
                for key in by_key:
                    difference = np.float64(chunk[f"action.{key}"][j]) - truth[key][step + j]
                    steps[j].extend(difference**2)
                    if j < 4:
                        squares[key].extend(difference**2)
                if j < 4:
                    scaled.extend((np.float64(one[j]) - other[j]) ** 2)
        for key in by_key:
            by_key[key].append(float(np.mean(squares[key])))
        for j, found in steps.items():
            if found:
                by_step[j].append(float(np.mean(found)))
        normalized.append(float(np.mean(scaled)))
    for key, values in by_key.items():
        assert report.by_key[key].mse == pytest.approx(np.mean(values), rel=1e-5)
    for j, values in by_step.items():
        assert report.by_step[j].mse == pytest.approx(np.mean(values), rel=1e-5)
    assert report.errors.normalized_mse == pytest.approx(np.mean(normalized), rel=1e-5)


def test_the_table_has_every_episode_step_and_key(report: Evaluation) -> None:
    assert [(row["episode"], row["step"], row["key"]) for row in report.table] == [
        (episode, step, key)
        for episode, length in enumerate(LENGTHS)
        for step in range(0, length, 4)
        for key in demo_policy().normalizer.action_slices
    ]
    for key, where in demo_policy().normalizer.action_slices.items():
        rows = [row for row in report.table if row["key"] == key and row["episode"] == 0]
        assert [row["actions"] for row in rows] == [4, 4, 1]
        whole = np.average([row["mse"] for row in rows], weights=[row["actions"] for row in rows])
        one = report.predictions[0]
        path = one.predicted[:, 0, :4].reshape(-1, 4)[:9]
        assert whole == pytest.approx(np.mean((path[:, where] - one.recorded[:, where]) ** 2), rel=1e-5)


def test_the_noise_floor_is_that_of_two_samples_of_one_call(data: Recorded, report: Evaluation) -> None:
    both = demo_policy().act(data.observation(1, 4), seed=(0, 1, 4), num_samples=2)
    joined = np.concatenate(list(both.values()), axis=-1)[0]
    assert np.array_equal(report.predictions[1].predicted[1], joined)
    apart = [
        np.mean((path[:, 0, :4] - path[:, 1, :4]).reshape(-1, 4)[: len(one.recorded)] ** 2)
        for one in report.predictions
        for path in [one.predicted]
    ]
    assert report.baselines["noise"].mse == pytest.approx(np.mean(apart), rel=1e-6)


def test_the_policys_own_actions_have_no_error_and_other_noise_has_the_floors() -> None:
    data = by_the_policy(demo_policy(), (12, 20, 7, 9, 16, 11), stride=4, seed=3)
    same = saccade.evaluate(demo_policy(), data, stride=4, seed=3)
    assert same.mse == same.mae == 0
    assert same.errors.normalized_mse == 0
    other = saccade.evaluate(demo_policy(), data, stride=4, seed=8)
    low, high = other.baselines["noise"].intervals["mse"]
    assert 0 < low <= other.mse <= high


@pytest.mark.parametrize(("still", "choice"), [(False, "zero"), (True, "state")])
def test_holding_still_repeats_the_state_or_nothing(still: bool, choice: str) -> None:
    data = made_up((8, 6))
    keys = demo_policy().normalizer.state_slices
    done = {
        key: [
            np.stack([step["state"][key][0, 0] * np.float32(still) for step in episode])
            for episode in data.seen
        ]
        for key in keys
    }
    found = saccade.evaluate(demo_policy(), Recorded(data.seen, done), stride=1)
    assert set(found.hold.values()) == {choice}
    assert found.baselines["hold"].mse == 0
    everything = np.concatenate([np.concatenate([done[key][one] for key in keys], -1) for one in range(2)])
    if still:
        expected = np.mean(
            [np.mean((everything[part] - everything.mean(0)) ** 2) for part in (slice(8), slice(8, 14))]
        )
        assert found.baselines["mean"].mse == pytest.approx(expected, rel=1e-4)


def test_intervals_are_over_episodes(report: Evaluation, data: Recorded) -> None:
    low, high = report.intervals["mse"]
    assert low < report.mse < high
    alone = saccade.evaluate(demo_policy(), data, episodes=[1], stride=4)
    assert all(math.isnan(bound) for pair in alone.intervals.values() for bound in pair)
    assert alone.mse == pytest.approx(
        float(
            np.mean(
                (alone.predictions[0].recorded - alone.predictions[0].predicted[:, 0, :4].reshape(-1, 4)[:5])
                ** 2
            )
        )
    )


def test_two_evaluations_are_compared_chunk_by_chunk(data: Recorded, report: Evaluation) -> None:
    same = report.compare(saccade.evaluate(demo_policy(), data, stride=4))
    assert same.equal
    assert (same.mse.value, same.mse.low, same.mse.high) == (0, 0, 0)
    coarse = saccade.evaluate(demo_policy(), data, stride=4, num_steps=1)
    found = coarse.compare(report)
    assert not found.equal
    assert found.mse.value == pytest.approx(coarse.mse - report.mse, rel=1e-4)
    for key, one in found.mse_by_key.items():
        assert one.value == pytest.approx(coarse.by_key[key].mse - report.by_key[key].mse, rel=1e-4)
        # The interval is that of differences within episodes: with three, of the smallest and the largest.
        where = report.layout.keys[key]
        errors = []
        for run in (coarse, report):
            paths = [
                done.predicted[:, 0, :4].reshape(-1, 4)[: len(done.recorded)] for done in run.predictions
            ]
            errors.append(
                [
                    np.mean((path - done.recorded)[:, where] ** 2)
                    for path, done in zip(paths, run.predictions, strict=True)
                ]
            )
        apart = np.asarray(errors[0], np.float64) - np.asarray(errors[1], np.float64)
        assert (one.low, one.high) == pytest.approx((apart.min(), apart.max()), rel=1e-5)


def test_what_two_evaluations_do_not_share_is_named(data: Recorded, report: Evaluation) -> None:
    assert report.noise_shape == (16, demo_policy().head.config.encoder_action_dim)
    layout = report.layout
    wider = dataclasses.replace(layout, keys={"hand": slice(0, 2), "gripper": slice(2, 4)})
    one, *rest = report.predictions
    others = dataclasses.replace(one, recorded=one.recorded + 1)
    for name, other in (
        ("seed of this run, 0, got 1", saccade.evaluate(demo_policy(), data, stride=4, seed=1)),
        ("stride of this run, 4, got 5", saccade.evaluate(demo_policy(), data, stride=5)),
        (
            r"episodes of this run, \[0, 1, 2\], got \[0, 1\]",
            saccade.evaluate(demo_policy(), data, stride=4, episodes=[0, 1]),
        ),
        ("horizon of this run, 16, got 8", dataclasses.replace(report, horizon=8)),
        # The same seed gives a head of another width other noise.
        (
            r"noise_shape of this run, \(16, .*\), got \(16, 99\)",
            dataclasses.replace(report, noise_shape=(16, 99)),
        ),
        (
            r"action_keys of this run, \[\['hand', 3\], .* got \[\['hand', 2\], ",
            dataclasses.replace(report, layout=wider),
        ),
    ):
        with pytest.raises(InputError, match=f"^compare: expected the {name}"):
            report.compare(other)
    with pytest.raises(InputError, match=r"^compare: episode 0: expected the recorded actions of this run"):
        report.compare(dataclasses.replace(report, predictions=[others, *rest]))


def test_bad_arguments_and_recordings_are_named(data: Recorded) -> None:
    policy = demo_policy()
    with pytest.raises(InputError, match="stride: expected at most 16"):
        saccade.evaluate(policy, data, stride=17)
    with pytest.raises(InputError, match="stride"):
        saccade.evaluate(policy, data, stride=0)
    with pytest.raises(InputError, match="0 to 2, got 1, 3"):
        saccade.evaluate(policy, data, episodes=[3, 1])
    with pytest.raises(InputError, match="got none"):
        saccade.evaluate(policy, data, episodes=[])
    with pytest.raises(InputError, match="at least one episode"):
        saccade.evaluate(policy, Recorded([], {}))
    with pytest.raises(
        InputError, match=r"episode 0, from step 0: actions: expected the keys .*hand, gripper"
    ):
        saccade.evaluate(policy, Recorded(data.seen, {"arm": data.done["hand"]}))
    broken = made_up((9,))
    broken.done["hand"][0][7, 1] = np.nan
    with pytest.raises(InputError, match="episode 0, step 7: actions: expected finite"):
        saccade.evaluate(policy, broken)
    with pytest.raises(ShapeError, match="episode 0, from step 0: actions: hand: expected shape"):
        saccade.evaluate(policy, Recorded(data.seen, {**data.done, "hand": data.done["gripper"]}))
    blind = made_up((9,))
    del blind.seen[0][4]["video"]["left"]
    with pytest.raises(InputError, match=r"episode 0, step 4: video.left"):
        saccade.evaluate(policy, blind, stride=4)


@pytest.mark.parametrize("name", ["action", "other"])
def test_one_key_of_the_whole_width_need_not_be_the_action(name: str, data: Recorded) -> None:
    whole = [np.concatenate(parts, -1) for parts in zip(*data.done.values(), strict=True)]
    with pytest.raises(InputError, match=rf"expected the keys of the policy, hand, gripper, got {name}"):
        saccade.evaluate(demo_policy(), Recorded(data.seen, {name: whole}), stride=4)


class InLerobotsForm(Recorded):
    """The recordings as lerobot's policies take them."""

    def observation(self, episode: int, step: int, form: str = "isaac") -> dict[str, Any]:
        assert form == "lerobot"
        given = self.seen[episode][step]
        (told,) = given["language"].values()
        return {
            **{
                f"observation.images.{name}": frames[0].transpose(0, 3, 1, 2)
                for name, frames in given["video"].items()
            },
            "observation.state": np.concatenate([part[0] for part in given["state"].values()], axis=-1),
            "task": told[0][0],
        }


def test_policies_of_lerobot_are_asked_in_their_form(data: Recorded) -> None:
    whole = demo_policy()
    pipeline: Any = object()  # that there is one says that lerobot trained the policy
    policy = Policy(
        whole.head,
        dataclasses.replace(whole.normalizer, pipeline=pipeline),
        backbone=whole.backbone,
        processor=whole.processor,
        requirements=whole.requirements,
    )
    given = InLerobotsForm(
        data.seen, {"action": [np.concatenate(one, -1) for one in zip(*data.done.values(), strict=True)]}
    )
    found = saccade.evaluate(policy, given, stride=4)
    expected = policy.act(given.observation(0, 4, "lerobot"), seed=(0, 0, 4))
    # Its parts of the action have names that a data set does not know: the one key has all of them.
    assert [group.key for group in policy.normalizer.action_groups] == ["hand", "gripper"]
    assert np.array_equal(found.predictions[0].predicted[1, 0], expected[0])
    assert np.array_equal(found.predictions[0].recorded, given.done["action"][0])


def test_a_data_set_is_read_for_the_policy(data: Recorded, report: Evaluation) -> None:
    class Wide(Recorded):
        def for_policy(self, policy: Policy) -> Recorded:
            assert policy is demo_policy()
            return data

    assert saccade.evaluate(demo_policy(), Wide([], {}), stride=4).mse == report.mse
