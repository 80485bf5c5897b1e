"""A diagnosis: each change is made alone, on the same noise; policies made deaf are found out."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import InputError, Policy
from saccade.diagnosis.changes import Neighbours, camera_of, changed, replacement
from saccade.diagnosis.effects import measure_episode
from saccade.diagnosis.plan import default_episodes, partners_of, planned, steps_of
from saccade.observations import ParsedObservation, read
from saccade_lab.random_checkpoint.whole import small_backbone, small_head, write
from tests.helpers.recorded_cases import Recorded, demo_policy, made_up, still

LENGTHS = (9, 5, 8, 1, 12)


@pytest.fixture(scope="module")
def data() -> Recorded:
    return made_up(LENGTHS)


def parsed(data: Recorded, episode: int, step: int) -> ParsedObservation:
    return read(data.observation(episode, step), demo_policy().requirements)


def near(data: Recorded, episode: int, partner: int | None = 1) -> Neighbours:
    return Neighbours(
        first=parsed(data, episode, 0),
        partner=None if partner is None else parsed(data, partner, 0),
        instructions={"reach the green ball": 9, "open the drawer": 8, "press the button": 7},
        spread=np.array([0.1, 0, 0, 0.2], np.float32),
        rng=np.random.default_rng(0),
    )


def test_every_change_changes_its_input_only(data: Recorded) -> None:
    before = parsed(data, 0, 4)
    made = dict(changed(before, near(data, 0)))
    cameras = ("left", "right", "top")
    assert [str(change) for change in made] == [
        *(f"instruction: {name}" for name in ("replaced", "emptied", "shuffled")),
        *(f"camera.{camera}: {name}" for camera in cameras for name in ("swapped", "frozen", "blanked")),
        *(f"state: {name}" for name in ("swapped", "frozen", "shifted")),
    ]
    for change, after in made.items():
        assert after is not None
        differ = {
            "instruction": after.instructions != before.instructions,
            "state": not np.array_equal(after.state, before.state),
            **{
                f"camera.{camera}": not np.array_equal(after.frames[0][camera], before.frames[0][camera])
                for camera in cameras
            },
        }
        assert [name for name, is_new in differ.items() if is_new] == [change.input]
    by_name = {str(change): after for change, after in made.items()}
    assert by_name["instruction: replaced"].instructions == ("open the drawer",)  # type: ignore[union-attr]
    shuffled = by_name["instruction: shuffled"].instructions[0]  # type: ignore[union-attr]
    assert sorted(str(shuffled).split()) == ["ball", "green", "reach", "the"]
    assert not by_name["camera.top: blanked"].frames[0]["top"].any()  # type: ignore[union-attr]
    assert np.allclose(by_name["state: shifted"].state - before.state, [0.1, 0, 0, 0.2])  # type: ignore[union-attr]


def test_what_would_change_nothing_is_left_out(data: Recorded) -> None:
    first = parsed(data, 0, 0)
    told = {str(text): 9 for text in first.instructions}
    alone = dataclasses.replace(near(data, 0, None), instructions=told, spread=np.zeros(4, np.float32))
    left = [str(change) for change, after in changed(first, alone) if after is not None]
    assert left == [
        "instruction: emptied",
        "instruction: shuffled",
        *(f"camera.{camera}: blanked" for camera in ("left", "right", "top")),
    ]


def test_an_input_that_is_always_the_same_is_undecided_and_not_left_out() -> None:
    """A black camera and a state that stands still: the recordings cannot show whether they are used."""
    data = still((1, 1, 1, 1, 1))
    report = saccade.diagnose(demo_policy(), data)
    assert set(report.inputs) == {"instruction", "camera.left", "camera.right", "camera.top", "state"}
    for name in ("camera.top", "state"):
        verdict = report.inputs[name]
        assert (verdict.name, dict(verdict.changes)) == ("undecided", {})
        assert math.isnan(verdict.effect)
    assert report.to_json()["inputs"]["state"]["name"] == "undecided"


def test_a_history_is_replaced_by_the_newest() -> None:
    data = made_up((3,))
    base = parsed(data, 0, 1)
    frames = {
        f"{camera}[{time}]": parsed(data, 0, time).frames[0][camera]
        for time in (0, 1)
        for camera in ("left", "top")
    }
    state = np.concatenate([parsed(data, 0, time).state for time in (0, 1)], axis=1)
    long = dataclasses.replace(base, frames=(frames,), state=state)
    made = {str(change): after for change, after in changed(long, near(data, 0, None))}
    after = made["history: repeated"]
    assert after is not None
    for view, found in after.frames[0].items():
        assert np.array_equal(found, frames[f"{camera_of(view, list(frames))}[1]"])
    assert np.array_equal(after.state, np.repeat(state[:, 1:], 2, axis=1))
    blank = made["camera.left: blanked"]
    assert blank is not None
    assert [view for view, found in blank.frames[0].items() if not found.any()] == ["left[0]", "left[1]"]
    assert "history: repeated" not in {str(change) for change, _ in changed(base, near(data, 0, None))}


def test_the_replacement_has_other_words_and_as_many_tokens() -> None:
    told = {"a b c": 9, "a b d": 9, "x y z u": 10, "x y z": 12, "c x": 10}
    # Half of the words of "a b d" are those of "a b c"; of the nearest others, one has fewer.
    assert replacement("a b c", told) == "x y z u"
    assert replacement("a b c", {"a b c": 9, "a d e": 9, "x": 30}) == "a d e"
    assert replacement("a b c", {"a b c": 9, "a b c d": 9}) == "a b c d"  # there is no other
    assert replacement("a b", {"a b": 3}) is None
    assert replacement("", {"": 1, "a": 2}) == "a"


@pytest.mark.parametrize("count", [2, 3, 20])
def test_partners_are_other_episodes_each_once(count: int) -> None:
    found = partners_of(range(count), 3)
    assert sorted(found) == sorted(found.values()) == list(range(count))
    assert all(one != other for one, other in found.items())
    assert partners_of([4], 0) == {}
    assert steps_of(1) == [0]
    assert default_episodes(5) == [0, 1, 2, 3, 4]
    assert len(default_episodes(999)) == 20


def test_effects_are_those_of_single_calls(data: Recorded) -> None:
    """Reuse, batches and contexts change no bit: each effect is that of two plain calls of the policy."""
    policy = demo_policy()
    width, normalizer = policy.normalizer.head_action_width, policy.normalizer
    plan = planned(policy, data, range(len(LENGTHS)), 0)
    assert set(plan.instructions) == {
        data.seen[one][0]["language"][key][0][0] for one in range(3) for key in data.seen[0][0]["language"]
    }
    found = measure_episode(policy, data, 4, plan, float)
    assert found.steps.tolist() == [1, 4, 7, 10]
    step, partner = 4, plan.partners[4]
    noise = np.random.default_rng((0, 4, step)).standard_normal(
        (1, 2, 16, policy.head.config.encoder_action_dim), dtype=np.float32
    )

    def act(observation: Any) -> Any:
        parts = [observation["state"][key] for key in normalizer.state_slices]
        state, context = normalizer.state(np.concatenate(parts, axis=-1)), policy.encode(observation).context
        found = policy.head.sample(context, state, policy.embodiment_id, noise=noise, num_samples=2)
        return np.asarray(found[0])

    before = data.observation(4, step)
    base = act(before)
    told = {key: [[replacement(text[0][0], plan.instructions)]] for key, text in before["language"].items()}
    theirs = data.observation(partner, step * LENGTHS[partner] // 12)
    black = {**before["video"], "left": np.zeros_like(before["video"]["left"])}
    shifted = np.split(np.asarray(plan.spread, np.float32), [3])
    moved = {key: value + shift for (key, value), shift in zip(before["state"].items(), shifted, strict=True)}
    expected = {
        "instruction|replaced|main": {**before, "language": told},
        "camera.left|blanked|removal": {**before, "video": black},
        "camera.top|swapped|main": {**before, "video": {**before["video"], "top": theirs["video"]["top"]}},
        "state|shifted|natural": {**before, "state": moved},
        "|another observation|": theirs,
    }
    for name, observation in expected.items():
        place = found.names.tolist().index(name)
        other = act(observation)
        square = np.mean((other.astype(np.float64) - base)[..., :width] ** 2)
        assert found.squares[1, place] == pytest.approx(square, rel=1e-12)
        units = np.abs(np.float64(normalizer.actions(other)) - normalizer.actions(base))
        by_key = [np.mean(units[..., where]) for where in normalizer.action_slices.values()]
        assert found.units[1, place].tolist() == pytest.approx(by_key, rel=1e-12)


class Deaf(Policy):
    """The bundled policy, blind on some cameras, deaf, or without a sense of its state."""

    def __init__(self, lost: Sequence[str]) -> None:
        whole = demo_policy()
        super().__init__(
            whole.head,
            whole.normalizer,
            whole.embodiment_id,
            backbone=whole.backbone,
            processor=whole.processor,
            requirements=whole.requirements,
        )
        self.lost = lost

    def encode(self, observation: Any, **options: Any) -> Any:
        several = list(observation) if isinstance(observation, list) else [observation]
        return super().encode([self.without(one) for one in several], **options)

    def without(self, one: ParsedObservation) -> ParsedObservation:
        frames = {
            name: np.zeros_like(frame) if f"camera.{name}" in self.lost else frame
            for name, frame in one.frames[0].items()
        }
        told = ("act",) if "instruction" in self.lost else one.instructions
        return dataclasses.replace(one, frames=(frames,), instructions=told)


def test_what_a_policy_lost_is_ignored_and_nothing_else() -> None:
    data = made_up((2, 1, 2, 1, 2))
    for lost in (["instruction"], ["camera.left", "camera.top"]):
        found = saccade.diagnose(Deaf(lost), data)
        ignored = [name for name, one in found.inputs.items() if one.name == "ignored"]
        assert ignored == lost
        assert all(found.inputs[name].high == 0 for name in lost)


def test_the_report_is_json_and_names_what_was_done() -> None:
    data = made_up((2, 1, 2, 1, 2))
    done: list[int] = []
    found = saccade.diagnose(demo_policy(), data, episodes=[4, 0, 2], on_episode=done.append)
    assert done == [1, 2, 3]
    values = found.to_json()
    assert values["episodes"] == [0, 2, 4]
    assert {one["name"] for one in values["inputs"].values()} == {"undecided"}  # of three episodes
    assert {one["rule"] for one in values["inputs"].values()} == {1}
    assert values["inputs"]["instruction"]["changes"]["replaced"]["kind"] == "main"
    assert set(found.edges) == {"text", "images"}
    assert all(one.share.value > 0 for one in found.edges.values())


def test_one_episode_has_no_partner(data: Recorded) -> None:
    found = saccade.diagnose(demo_policy(), data, episodes=[0])
    assert found.observation is None
    assert {one.name for one in found.inputs.values()} == {"undecided"}
    with pytest.raises(InputError, match="at least one episode"):
        saccade.diagnose(demo_policy(), Recorded([], {}))
    with pytest.raises(InputError, match="seed"):
        saccade.diagnose(demo_policy(), data, seed=-1)


@pytest.mark.parametrize("indices", [list(range(1, 17)), list(range(0, 32, 2))])
def test_chunks_that_leave_steps_out_are_refused(indices: list[int], tmp_path: Path) -> None:
    """They would be compared with actions of other steps."""
    folder = tmp_path / "small"
    write(folder, "n1.6", backbone=small_backbone("n1.6"), head=small_head("n1.6"), seed=1)
    file = folder / "processor_config.json"
    values = json.loads(file.read_text())
    for robot in values["processor_kwargs"]["modality_configs"].values():
        robot["action"]["delta_indices"] = indices
    file.write_text(json.dumps(values))
    policy = Policy.from_pretrained(folder, num_threads=1)
    with pytest.raises(InputError, match="policy: expected action_indices 0, 1, 2"):
        saccade.evaluate(policy, made_up((2,), policy=policy))


@pytest.mark.parametrize("version", ["n1.6", "n1.7"])
def test_other_releases_are_evaluated_and_diagnosed(version: str, tmp_path: Path) -> None:
    """Heads without future tokens, whose blocks see text or images, and that denoise more than they give."""
    write(tmp_path / "small", version, backbone=small_backbone(version), head=small_head(version), seed=1)
    policy = Policy.from_pretrained(tmp_path / "small", num_threads=1)
    data = made_up((2, 1), policy=policy)
    assert policy.requirements.action_indices == tuple(range(16))
    report = saccade.evaluate(policy, data)
    assert report.horizon == 16 < policy.head.config.action_horizon
    found = saccade.diagnose(policy, data)
    assert set(found.inputs) == {"instruction", "camera.front", "camera.wrist", "state"}
    assert all(one.share.value > 0 for one in found.edges.values())
    assert set(found.edges) == {"text", "images"}
