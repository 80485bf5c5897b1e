"""Observations of Isaac-GR00T's two forms and of lerobot mean the same, and what does not fit is refused."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import saccade
from saccade import DtypeError, InputError, Policy, ShapeError
from saccade.observations import Requirements, read
from tests.helpers import whole_checkpoints
from tests.helpers.policy_cases import inputs_of, noise, policy

Observation = dict[str, Any]

ISAAC = ("nvidia", "isaac", "n16", "n17")


def nested(made: Policy, batch: int = 1) -> Observation:
    """An observation of this batch size in the nested form, each row another one."""
    rows = [made.example_observation(seed) for seed in range(batch)]
    language = next(iter(rows[0]["language"]))
    return {
        "video": {name: np.concatenate([row["video"][name] for row in rows]) for name in rows[0]["video"]},
        "state": {
            key: np.concatenate([row["state"][key] + np.float32(0.01 * n) for n, row in enumerate(rows)])
            for key in rows[0]["state"]
        },
        "language": {language: [[f"push {'very ' * row}hard"] for row in range(batch)]},
    }


def flat(observation: Observation, key: str | None = None) -> Observation:
    """The flat form of a nested observation. The instructions are lists of one."""
    (language, texts), *_ = observation["language"].items()
    return {
        **{f"video.{name}": frames for name, frames in observation["video"].items()},
        **{f"state.{name}": values for name, values in observation["state"].items()},
        key or language: texts,
    }


def lerobot(observation: Observation) -> Observation:
    """lerobot's form of a nested observation with one frame and one state, in torch tensors."""
    (_, texts), *_ = observation["language"].items()
    frames = {
        f"observation.images.{name}": torch.from_numpy(frames[:, 0].transpose(0, 3, 1, 2) / np.float32(255))
        for name, frames in observation["video"].items()
    }
    state = np.concatenate(list(observation["state"].values()), axis=-1)[:, 0]
    return frames | {"observation.state": torch.from_numpy(state), "task": [text for (text,) in texts]}


def row(observation: Observation, index: int) -> Observation:
    """One row of an observation of any form, without the batch axis."""
    return {
        key: row(value, index) if isinstance(value, dict) else value[index]
        for key, value in observation.items()
    }


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_the_three_forms_have_one_meaning(layout: str) -> None:
    made = policy(layout)
    given = nested(made, batch=2)
    start = noise(made, 2)
    key = made.requirements.language_key
    actions = made.act(given, noise=start)
    assert list(actions) == list(made.normalizer.action_slices)
    horizon = made.normalizer.action_horizon or made.head.config.action_horizon
    widths = {group.key: group.size for group in made.normalizer.action_groups}
    assert {name: found.shape for name, found in actions.items()} == {
        name: (2, horizon, width) for name, width in widths.items()
    }
    assert all(found.dtype == np.float32 and found.flags.c_contiguous for found in actions.values())
    flattened = made.act(flat(given, key), noise=start)
    assert list(flattened) == [f"action.{name}" for name in actions]
    assert all(np.array_equal(flattened[f"action.{name}"], actions[name]) for name in actions)
    joined = made.act(lerobot(given), noise=start)
    assert isinstance(joined, torch.Tensor)
    assert torch.equal(joined, torch.from_numpy(np.concatenate(list(actions.values()), axis=-1)))
    # The same without torch, and with the colours last.
    arrays = {key: value.numpy() if key != "task" else value for key, value in lerobot(given).items()}
    for name, frames in given["video"].items():
        arrays[f"observation.images.{name}"] = frames[:, 0]
    found = made.act(arrays, noise=start)
    assert isinstance(found, np.ndarray)
    assert np.array_equal(found, joined.numpy())


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_without_a_batch_axis_the_answer_has_none(layout: str) -> None:
    made = policy(layout)
    given, start = nested(made, batch=2), noise(made, 2)
    together = made.act(given, noise=start)
    for index in range(2):
        alone = made.act(row(given, index), noise=start[index])
        assert all(np.array_equal(alone[name], together[name][index]) for name in together)
        flattened = made.act(row(flat(given, made.requirements.language_key), index), noise=start[index])
        assert all(np.array_equal(flattened[f"action.{name}"], alone[name]) for name in alone)
        joined = made.act(row(lerobot(given), index), noise=start[index : index + 1])
        assert np.array_equal(joined, np.concatenate(list(alone.values()), axis=-1))
    samples = made.act(row(given, 0), seed=1, num_samples=3)
    assert all(found.shape == (3, *together[name].shape[1:]) for name, found in samples.items())


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_several_observations_are_answered_as_if_alone(layout: str) -> None:
    made = policy(layout)
    given, start = nested(made, batch=3), noise(made, 5)
    several = [row(given, 2), given, row(lerobot(given), 1)]
    answers = made.act(several, noise=start)
    expected = [
        made.act(several[0], noise=start[:1]),
        made.act(given, noise=start[1:4]),
        made.act(several[2], noise=start[4:]),
    ]
    assert all(np.array_equal(answers[0][name], expected[0][name]) for name in expected[0])
    assert all(np.array_equal(answers[1][name], expected[1][name]) for name in expected[1])
    assert torch.equal(answers[2], expected[2])
    context = made.encode(several)
    assert context.batch == 5
    again = made.sample(context, several, noise=start)
    assert torch.equal(again[2], answers[2])
    with pytest.raises(InputError, match="expected 5, as many as in context, got 3"):
        made.sample(context, given)


def test_what_was_read_stands_for_the_observation() -> None:
    made = policy("nvidia")
    given = [nested(made), flat(nested(made, batch=2)), lerobot(nested(made))]
    parsed = [read(one, made.requirements) for one in given]
    expected = made.act(given, seed=3)
    context = made.encode(parsed)
    for found in (
        made.act(parsed, seed=3),
        made.act([given[0], parsed[1], given[2]], seed=3),
        made.sample(context, parsed, seed=3),
    ):
        for one, other in zip(found, expected, strict=True):
            assert len(one) == len(other)
            for key in one if isinstance(one, dict) else (0,):
                np.testing.assert_array_equal(one[key], other[key])
    np.testing.assert_equal(made.act(parsed[0], seed=4), made.act(given[0], seed=4))
    read(given[1], made.requirements, 2)
    with pytest.raises(InputError, match="expected at most 1 rows, got 2"):
        read({"state": nested(made, batch=2)["state"]}, made.requirements, 1)  # before frames are looked at


def test_what_was_read_for_another_policy_is_refused() -> None:
    made, other = policy("nvidia"), policy("nvidia", Requirements())
    given = nested(made)
    parsed = read(given, made.requirements)
    context = made.encode(given)
    assert made.sample(context, parsed, seed=0).keys() == made.sample(context, given, seed=0).keys()
    for call in (other.encode, other.act, lambda one: other.sample(context, one)):
        with pytest.raises(
            InputError, match=r"expected what was read for this policy, got what was read for another"
        ):
            call(parsed)
        with pytest.raises(
            InputError, match=r"expected what was read for this policy, got what was read for another"
        ):
            call([parsed])


def test_one_string_a_row_of_a_batch_is_plain() -> None:
    made = policy("isaac")
    given = nested(made, batch=2)
    parsed = read(flat(given) | {"annotation.human.action.task_description": ["a", "b"]}, made.requirements)
    assert (parsed.instructions, parsed.is_plain) == (("a", "b"), True)
    for texts in ([["a"], ["b"]], np.array([["a"], ["b"]]), (["a"], ("b",))):
        parsed = read(flat(given) | {"annotation.human.action.task_description": texts}, made.requirements)
        assert (parsed.instructions, parsed.is_plain) == (("a", "b"), False)
    for text in ("a", ["a"], np.array(["a"])):
        parsed = read(
            row(flat(given), 0) | {"annotation.human.action.task_description": text}, made.requirements
        )
        assert (parsed.instructions, parsed.is_plain) == (("a",), False)


def test_every_row_keeps_its_own_instruction_and_none_is_the_released_default() -> None:
    made = policy("lerobot")
    given = lerobot(nested(made, batch=2))
    processor: Any = made.processor
    for task, expected in (
        (["a", ""], ["a", None]),
        ("a", ["a", "a"]),
        (["a"], ["a", "a"]),
        (None, [None, None]),
    ):
        processor.seen.clear()
        with contextlib.ExitStack() as stack:
            if None in expected:
                stack.enter_context(pytest.warns(UserWarning, match="task: .*released default"))
            made.act(given | {"task": task}, seed=0)
        assert processor.seen == [(text, False) for text in expected]
    # Sorted by name, whatever the order of the observation.
    assert inputs_of(made, given)[0].view_names == ("front", "wrist")
    isaac = policy("isaac")
    observation = flat(nested(isaac))
    del observation["annotation.human.action.task_description"]
    with pytest.warns(UserWarning, match="released default is used") as warned:
        assert read(observation, isaac.requirements).instructions == (None,)
    assert [Path(warning.filename).name for warning in warned] == [Path(__file__).name]
    observation["task"] = ["go"]
    assert read(observation, isaac.requirements).instructions == ("go",)


def test_float_frames_become_uint8_as_in_lerobot() -> None:
    made = policy("lerobot")
    values = np.arange(256, dtype=np.uint8).reshape(1, 16, 16, 1).repeat(3, axis=-1)
    frames = np.zeros((1, 3, 40, 48), np.float32)
    frames[:, :, :16, :16] = values.transpose(0, 3, 1, 2) / np.float32(255)
    frames[:, :, 20, :3] = [-0.2, 1.2, 0.5]
    given = lerobot(nested(made))
    for kind in (frames, torch.from_numpy(frames), torch.from_numpy(frames).double()):
        parsed = read(given | {"observation.images.front": kind}, made.requirements)
        found = parsed.frames[0]["front"]
        assert np.array_equal(found[:16, :16], values[0])
        assert found[20, :3, 0].tolist() == [0, 255, 127]
    for scale in (255.0, np.nan, -255.0):
        with pytest.raises(InputError, match="float frames from 0 to 1"):
            made.act(given | {"observation.images.front": frames * np.float32(scale)})


def test_frames_along_time_come_before_cameras() -> None:
    made = policy("n17", Requirements(video_horizon=2))
    video = np.random.default_rng(0).integers(0, 256, (2, 2, 8, 8, 3), np.uint8)
    given = nested(policy("n17"))
    given["video"] = {"a": video[:1], "b": video[1:]}
    frames = read(given, made.requirements).frames[0]
    assert list(frames) == ["a[0]", "b[0]", "a[1]", "b[1]"]
    assert np.array_equal(frames["b[1]"], video[1, 1])
    given["video"] = {"a": video[:1, :1], "b": video[1:, :1]}
    with pytest.raises(ShapeError, match="time axis: expected 2, got a 1, b 1"):
        made.act(given)


def test_unnamed_cameras_keep_their_order_or_are_sorted() -> None:
    made = policy("isaac", Requirements())
    given = nested(policy("isaac"))
    given["video"] = dict.fromkeys(("z", "a"), given["video"]["wrist"])
    assert list(read(given, made.requirements).frames[0]) == ["z", "a"]
    assert list(read(lerobot(given), made.requirements).frames[0]) == ["a", "z"]
    assert list(made.example_observation()["video"]) == ["front"]


def test_a_chunk_goes_on_in_the_form_of_the_answer() -> None:
    made = policy("isaac")
    given, start = nested(made), noise(made, 1)
    before = made.act(given, seed=3)
    chunking = saccade.Chunking(overlap=9, frozen=4)
    array = np.concatenate(list(before.values()), axis=-1)
    state = np.concatenate(list(given["state"].values()), axis=-1)
    expected = made.sample(made.encode(given), state, noise=start, previous_chunk=array, chunking=chunking)
    found = made.act(given, noise=start, previous_chunk=before, chunking=chunking)
    assert np.array_equal(np.concatenate(list(found.values()), axis=-1), expected)
    alone = row(given, 0)
    single = {name: part[0] for name, part in before.items()}
    found = made.act(alone, noise=start, previous_chunk=single, chunking=chunking)
    assert np.array_equal(np.concatenate(list(found.values()), axis=-1), expected[0])
    flattened = {f"action.{name}": part for name, part in before.items()}
    found = made.act(flat(given), noise=start, previous_chunk=flattened, chunking=chunking)
    assert np.array_equal(np.concatenate(list(found.values()), axis=-1), expected)
    del before["arm"]
    with pytest.raises(InputError, match="previous_chunk: expected actions arm, hand, got hand"):
        made.act(given, previous_chunk=before, chunking=chunking)


NEEDS = (
    r"embodiment 'new_embodiment' needs cameras wrist \(40 x 48\), front \(40 x 48\); state keys arm \(5\), "
    r"hand \(2\)"
)


def without(part: str, key: str) -> Callable[[Observation], None]:
    return lambda given: given[part].pop(key)


def change(part: str, key: str, value: Callable[[Any], Any]) -> Callable[[Observation], None]:
    def changed(given: Observation) -> None:
        given[part][key] = value(given[part].get(key))

    return changed


@pytest.mark.parametrize(
    ("broken", "error", "message"),
    [
        (without("video", "front"), InputError, "video.front: expected cameras wrist, front, got wrist"),
        (
            change("video", "front", lambda found: found[..., :2]),
            ShapeError,
            r"got shape \(1, 1, 40, 48, 2\)",
        ),
        (change("video", "front", lambda found: found[:, :, ::2]), ShapeError, "40 x 48 pixels, got 20 x 48"),
        (change("video", "front", lambda found: found[0]), ShapeError, "uint8 of 5 axes"),
        (change("video", "front", lambda found: found[:0]), ShapeError, "uint8 of 5 axes"),
        (change("video", "front", lambda found: found / 255), DtypeError, "got float64"),
        (change("video", "front", lambda found: found.tolist()), DtypeError, "got list"),
        (change("video", "front", lambda found: found.repeat(2, axis=0)), ShapeError, "front 2"),
        (change("video", "front", lambda found: found.repeat(2, axis=1)), ShapeError, "time axis"),
        (without("state", "hand"), InputError, "state.hand: expected hand too, got arm"),
        (change("state", "arm", lambda found: found[..., :4]), ShapeError, "the last of 5"),
        (change("state", "arm", lambda found: found[0]), ShapeError, r"arm \(1, 5\), hand \(1, 1, 2\)"),
        (
            change("state", "arm", lambda found: np.full(found.shape, 2**24 + 1)),
            DtypeError,
            "got int64 16777217",
        ),
        (change("state", "arm", lambda found: found > 0), DtypeError, "state.arm: expected floating point"),
        (change("state", "arm", lambda found: [[[1], [1, 2]]]), ShapeError, "state.arm: expected an array"),
        (
            change("state", "arm", lambda found: found * [1, 1, np.nan, 1, np.inf]),
            InputError,
            "state.arm: expected finite numbers, got NaN or infinity in columns 2, 4",
        ),
        (change("state", "arm", lambda found: found.repeat(2, axis=1)), ShapeError, "1 along the time axis"),
        (change("state", "arm", lambda found: "zero"), ShapeError, "(batch, time, width)"),
        (change("language", "other", lambda _: [["b"]]), InputError, "expected one instruction"),
        (lambda given: given.update(language={"a": [["b"], ["c"]]}), ShapeError, "language.a 2"),
        (lambda given: given.update(language={"a": [["b", "c"]]}), InputError, "one instruction for each"),
        (lambda given: given.update(language={"a": [[5]]}), InputError, "got 5"),
        (lambda given: given.update(language={"a": [["\ud800"]]}), InputError, "valid Unicode"),
        (
            lambda given: given.update(language="go"),
            InputError,
            "language: expected a mapping of names, got str",
        ),
        (lambda given: given.pop("video"), InputError, "video: expected a mapping of names, got nothing"),
        (lambda given: given.update(state=[1.0]), InputError, "state: expected a mapping of names, got list"),
    ],
)
def test_what_does_not_fit_is_an_error_that_lists_what_does(
    broken: Callable[[Observation], None], error: type[Exception], message: str
) -> None:
    made = policy("isaac")
    given = nested(made)
    broken(given)
    with pytest.raises(error, match=f"{message if '(' in message else re.escape(message)}.*; {NEEDS}"):
        made.act(given)


def test_lerobots_form_is_checked_too() -> None:
    made = policy("lerobot")
    given = lerobot(nested(made, batch=2))
    needs = "; embodiment 'new_embodiment' needs cameras front, wrist .*; state keys state"
    for changes, error, message in (
        ({"observation.images.front": given["observation.images.front"][:1]}, ShapeError, "front 1"),
        ({"observation.images.front": given["observation.images.front"][0]}, ShapeError, "front 1"),
        (
            {"observation.images.front": given["observation.images.front"][:, :1]},
            ShapeError,
            "3, height, width",
        ),
        ({"observation.images.front": given["observation.images.front"].long()}, DtypeError, "got int64"),
        ({"observation.images.front": torch.zeros(2, 3, 40, 48, device="meta")}, DtypeError, "on meta"),
        ({"observation.images.front": "front.png"}, DtypeError, "got str"),
        ({"observation.state": given["observation.state"][:, :6]}, ShapeError, "the last of 7"),
        ({"observation.state": given["observation.state"].bool()}, DtypeError, "got torch.bool"),
        (
            {"observation.state": given["observation.state"] * np.nan},
            InputError,
            "columns 0, 1, 2, 3, 4, 5, 6",
        ),
        ({"observation.state": None}, InputError, "expected the state, 7 numbers"),
        ({"task": ["a", "b", "c"]}, ShapeError, "task 3"),
        ({"task": ["a", 0]}, InputError, "got 0"),
        ({"task": ["a", 1]}, InputError, "got 1"),
        ({"task": 5}, InputError, "got 5"),
    ):
        with pytest.raises(error, match=f"{message}.*{needs}"):
            made.act({**given, **changes})


def test_what_is_no_observation_is_an_error() -> None:
    made = policy("isaac")
    others: tuple[Any, ...] = ({}, {"image": 1}, {1: 2}, None, [], "state", [None], np.zeros((1, 7)))
    for given in others:
        with pytest.raises(InputError, match="observation: expected"):
            made.act(given)
    with pytest.raises(InputError, match="previous: expected what encode returns, got str"):
        made.act(nested(made), previous="yes")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="seed: expected at least 0"):
        made.example_observation(-1)


def test_a_head_alone_samples_for_observations_and_does_not_look() -> None:
    whole = policy("isaac")
    alone = saccade.Policy(whole.head, embodiment="new_embodiment")
    assert (alone.backbone, alone.processor) == (None, None)
    given = nested(whole)
    for call in (alone.act, alone.encode):
        with pytest.raises(InputError, match=r"saccade\.Policy\.from_pretrained"):
            call(given)
    context = whole.encode(given)
    expected = whole.sample(context, given, seed=2)
    found = alone.sample(context.context, {"state": given["state"]}, seed=2)
    assert all(np.array_equal(found[name], expected[name]) for name in expected)
    state = np.concatenate(list(given["state"].values()), axis=-1)
    found = alone.sample(context, state, seed=2)
    assert np.array_equal(found, np.concatenate(list(expected.values()), axis=-1))
