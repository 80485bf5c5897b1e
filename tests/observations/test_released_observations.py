"""Observations that the released N1.6 and N1.7 take or refuse: every line that was tried with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saccade import SaccadeError
from saccade.observations import Camera, Requirements, read

Observation = dict[str, Any]
Change = Callable[[Observation], Any]

LINES = Path(__file__).parents[1] / "data" / "observations" / "n16_n17.txt"

NEEDS = Requirements(
    embodiment="robot",
    cameras=(Camera("front"), Camera("wrist")),
    state=(("arm", 5), ("grip", 1)),
    state_history=2,
    video_horizon=1,
    language_keys=("task",),
    requires_language=True,
)
TWO_KEYS = replace(NEEDS, language_keys=("task", "annotation.human.subtask"))
COARSE = "annotation.human.coarse_action"

#: What we take and the releases refuse, or the other way round, and why.
TAKEN = {
    "float64 state": "rounded to float32, as a client would do it",
    "int state": "the same numbers, since float32 holds them",
    "state as a list": "the same numbers",
    "language strings (B,)": "one text a row has one meaning",
    "language tuple of lists": "one text a row has one meaning",
    "language list of tuples": "one text a row has one meaning",
    "language array (B,1)": "one text a row has one meaning",
    "language characters in str rows": "one text a row has one meaning",
    "language list of lists": "one text a row has one meaning",
    "language array (B,)": "N1.7 takes it, N1.6 does not",
    "one string for B=1": "N1.7 takes it, N1.6 does not",
}
REFUSED = {
    "state of another width": "the releases fail later, or take other numbers than were meant",
    "NaN in a state": "the releases pass it on to the head",
}


def observation(form: str = "nested") -> Observation:
    """Two rows by modality, with the words as the form has them."""
    rng = np.random.default_rng(0)
    return {
        "video": {name: rng.integers(0, 256, (2, 1, 6, 8, 3), np.uint8) for name in ("front", "wrist")},
        "state": {key: rng.integers(-9, 9, (2, 2, width)).astype(np.float32) for key, width in NEEDS.state},
        "language": {"task": [["x"], ["y"]] if form == "nested" else ["x", "y"]},
    }


def put(part: str, key: str, value: Any) -> Change:
    return lambda given: given[part].update({key: value})


def change(part: str, key: str, how: Callable[[Any], Any]) -> Change:
    return lambda given: given[part].update({key: how(given[part][key])})


def told(value: Any) -> Change:
    return put("language", "task", value)


#: What a line means for both forms. Words are those of the form.
BOTH: dict[str, Change] = {
    "as configured": lambda given: None,
    "an extra camera, other size and batch": put("video", "top", np.zeros((1, 1, 3, 3, 3), np.uint8)),
    "an extra state key": put("state", "base", np.zeros((2, 2, 3), np.int8)),
    "a missing camera": lambda given: given["video"].pop("wrist"),
    "a missing state": lambda given: given["state"].pop("grip"),
    "float64 state": change("state", "arm", lambda found: found.astype(np.float64)),
    "int state": change("state", "arm", lambda found: found.astype(np.int64)),
    "state without batch": change("state", "arm", lambda found: found[0]),
    "state with one step instead of two": change("state", "arm", lambda found: found[:, :1]),
    "state of another width": change("state", "arm", lambda found: found[..., :4]),
    "NaN in a state": change("state", "arm", lambda found: found * np.nan),
    "state as a list": change("state", "arm", lambda found: found.tolist()),
    "float frames": change("video", "front", lambda found: found.astype(np.float32) / 255),
    "frames channels first": change("video", "front", lambda found: np.moveaxis(found, -1, -3)),
    "frames of 4 channels": change("video", "front", lambda found: found[..., [0, 1, 2, 2]]),
    "two frames instead of one": change("video", "front", lambda found: found.repeat(2, axis=1)),
    "cameras of different sizes": change("video", "front", lambda found: found[:, :, ::2]),
    "batch sizes differ (state)": change("state", "arm", lambda found: found[:1]),
    "batch sizes differ (video)": change("video", "front", lambda found: found[:1]),
}
NESTED: dict[str, Change] = BOTH | {
    "an extra language key": put("language", "other", 5),
    "an extra modality": lambda given: given.update(depth={"front": "none"}),
    "language strings (B,)": told(["x", "y"]),
    "language tuple of lists": told((["x"], ["y"])),
    "language list of tuples": told([("x",), ("y",)]),
    "language array (B,1)": told(np.array([["x"], ["y"]])),
    "language two texts a row": told([["x", "z"], ["y", "z"]]),
    "language empty rows": told([[], []]),
    "language one row for two": told([["x"]]),
    "language bytes": told([[b"x"], [b"y"]]),
    "language one string": told("x"),
    "language characters in str rows": told(("x", "y")),
    "language empty text": told([[""], ["y"]]),
    "language None": told([[None], [None]]),
}
FLAT: dict[str, Change] = BOTH | {
    "language tuple (B,)": told(("x", "y")),
    "language list (B,)": told(["x", "y"]),
    "language array (B,)": told(np.array(["x", "y"])),
    "language array (B,1)": told(np.array([["x"], ["y"]])),
    "language one string for B=2": told("x"),
    "language list of lists": told([["x"], ["y"]]),
    "language empty": told([]),
    "language ints after a text": told(["x", 5]),
    "language one text for B=2": told(["x"]),
}
#: Lines about other robots: the robot, and the language part of the observation.
ROBOTS: dict[str, tuple[Requirements, Observation]] = {
    "two language keys configured, only the second given": (
        TWO_KEYS,
        {TWO_KEYS.language_keys[1]: [["x"], ["y"]]},
    ),
    "two language keys configured, only the first given": (TWO_KEYS, {"task": [["x"], ["y"]]}),
    "two language keys configured and given": (
        TWO_KEYS,
        {TWO_KEYS.language_keys[1]: [["z"], ["z"]], "task": [["x"], ["y"]]},
    ),
    "configured task, given annotation.human.coarse_action": (NEEDS, {COARSE: ["x", "y"]}),
    "configured annotation.human.coarse_action, given task": (
        replace(NEEDS, language_keys=(COARSE,)),
        {"task": ["x", "y"]},
    ),
    "configured another annotation, given task": (
        replace(NEEDS, language_keys=("annotation.human.action.task_description",)),
        {"task": ["x", "y"]},
    ),
}


def flat(given: Observation) -> Observation:
    return {
        **{f"video.{name}": frames for name, frames in given["video"].items()},
        **{f"state.{name}": values for name, values in given["state"].items()},
        **given["language"],
    }


def lines() -> list[Any]:
    found = []
    for line in LINES.read_text().splitlines():
        verdict, _, what = line.strip().partition(" ")
        if not line.startswith(" "):
            release, form = line.split()[:2]
        elif verdict in ("accepted", "refused"):
            name, _, _ = what.strip().partition(": ")
            found.append(
                pytest.param(form.strip(","), name, verdict, id=f"{release} {form.strip(',')}: {name}")
            )
    assert len(found) == 136
    return found


def given_for(form: str, name: str) -> tuple[Requirements, Observation]:
    """The robot and the observation of a line."""
    needs, given = NEEDS, observation(form)
    if name in ROBOTS:
        needs, given["language"] = ROBOTS[name]
    elif name == "one string for B=1":
        given = {part: {key: value[:1] for key, value in given[part].items()} for part in given}
        given["language"]["task"] = "x"
    else:
        (NESTED if form == "nested" else FLAT)[name](given)
    return needs, flat(given) if form == "flat" else given


@pytest.mark.parametrize(("form", "name", "verdict"), lines())
def test_what_the_releases_take_is_taken_and_what_they_refuse_is_refused(
    form: str, name: str, verdict: str
) -> None:
    needs, given = given_for(form, name)
    if name in REFUSED or (verdict == "refused" and name not in TAKEN):
        with pytest.raises(SaccadeError, match="; embodiment 'robot' needs cameras front, wrist"):
            read(given, needs)
        return
    parsed = read(given, needs)
    expected = observation()
    states = np.concatenate([expected["state"]["arm"], expected["state"]["grip"]], axis=-1)
    np.testing.assert_array_equal(parsed.state, states[: len(parsed)])
    assert all(tuple(frames) == ("front", "wrist") for frames in parsed.frames)
    for row, frames in enumerate(parsed.frames):
        np.testing.assert_array_equal(frames["wrist"], expected["video"]["wrist"][row, 0])
    texts = {"language ints after a text": ("x", "5"), "language empty text": ("", "y")}
    assert parsed.instructions == texts.get(name, ("x", "y"))[: len(parsed)]


def test_the_coarse_action_counts_where_task_is_configured_and_both_are_given() -> None:
    assert "both given, used: {'task': [['x'], ['y']]}" in LINES.read_text()
    given = flat(observation("flat")) | {"task": ["a", "b"], COARSE: ["x", "y"]}
    assert read(given, NEEDS).instructions == ("x", "y")


def test_a_missing_instruction_is_refused_where_the_release_has_no_default() -> None:
    for form in (observation(), flat(observation())):
        form.pop("language", None)
        form.pop("task", None)
        with pytest.raises(SaccadeError, match="task: expected an instruction, got none"):
            read(form, NEEDS)
