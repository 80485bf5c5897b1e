"""The options of a request: Euler steps, real-time chunking, and what an answer says of them."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zmq

import saccade
from saccade.errors import InputError
from saccade.observations import Camera, ParsedObservation
from saccade.serve import Client, Server, ServerError, engine, modalities
from saccade.serve.transport import bind
from tests.helpers import whole_checkpoints
from tests.helpers.released import load_released
from tests.helpers.serve_cases import (
    BUCKETS,
    HORIZON,
    MemoryLog,
    MemoryPolicy,
    answer,
    ask,
    flat_observation,
    get_action,
    observation,
    post,
    requester,
    serving,
    wait_until,
)

#: Real-time chunking in the words of the released head.
RELEASED = {"action_horizon": 6, "rtc_overlap_steps": 4, "rtc_frozen_steps": 2, "rtc_ramp_rate": 2.5}


def told(client: Client, **options: Any) -> dict[str, Any]:
    """What an answer says besides the actions, without its time."""
    _, info = client.get_action(observation(), options)
    assert isinstance(info.pop("latency_ms"), float)
    return info


def test_an_answer_says_what_was_applied_and_how_long_it_took() -> None:
    with serving(seed=3) as running, Client(port=running.port) as client:
        assert told(client) == {"applied_options": {}}
        assert told(client, seed=1, client_id="x") == {
            "applied_options": {"seed": 1},
            "ignored_options": ["client_id"],
        }
        assert told(client, seed=None, num_steps=2) == {"applied_options": {"num_steps": 2}}
        own = {"session": "a", "executed": 5, "frozen": 9, "ramp_rate": 2}
        assert told(client, **own) == {
            "applied_options": {"session": "a"},
            "session": "a",
            "continued": False,
        }
        # Not more actions can be frozen than are left.
        assert told(client, **own) == {
            "applied_options": own | {"frozen": HORIZON - 5},
            "session": "a",
            "continued": True,
        }


def test_the_latency_is_from_receipt_to_answer() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running, requester(running.port, zmq.DEALER) as client:
        post(client, get_action())
        policy.gate.set()
        latency = answer(client)[1]["latency_ms"]
        wait_until(lambda: len(running.log.requests()) == 2)
        line = running.log.requests()[-1]
        parts = line["milliseconds"]
        assert sum(parts[part] for part in engine.PARTS) - 0.1 <= latency <= parts["total"] + 0.1


def test_a_bare_request_gets_the_actions_only() -> None:
    with serving() as running, requester(running.port) as made:
        answer = ask(made, {"endpoint": "get_action", "data": flat_observation()})
        assert answer.keys() == {"action.arm", "action.gripper"}


def test_steps_of_the_server_and_of_a_request() -> None:
    with serving(num_steps=3) as running, Client(port=running.port) as client:
        for options in ({}, {"num_steps": 1}, {"num_steps": BUCKETS}, {"num_steps": None}):
            client.get_action(observation(), options)
        client.call("get_action", flat_observation())
        assert running.policy.steps == [3, 1, BUCKETS, 3, 3]
    with serving() as running, Client(port=running.port) as client:
        client.get_action(observation())
        assert running.policy.steps == [None]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (0, "options: num_steps: expected at least 1, got 0"),
        (BUCKETS + 1, "options: num_steps: expected at most 1000 (num_timestep_buckets), got 1001"),
        (2.0, "options: num_steps: expected an integer, got 2.0"),
        ("4", "options: num_steps: expected an integer, got '4'"),
        (True, "options: num_steps: expected an integer, got True"),
    ],
)
def test_steps_out_of_range_are_refused(value: Any, message: str) -> None:
    with serving() as running, Client(port=running.port) as client:
        with pytest.raises(ServerError, match=f"^{re.escape(message)}$"):
            client.get_action(observation(), {"num_steps": value})
        assert running.policy.batches == []
    listener = bind("127.0.0.1", 0)
    with listener, pytest.raises(InputError, match=r"^num_steps: expected"):
        Server(MemoryPolicy(), listener, MemoryLog(), num_steps=value)  # type: ignore[arg-type]


def test_the_guidance_of_the_server_and_of_a_request() -> None:
    with serving(guidance=3.0) as running, Client(port=running.port) as client:
        for options in ({}, {"guidance": 0}, {"guidance": 1}, {"guidance": 1.5}, {"guidance": None}):
            assert told(client, **options)["applied_options"] == {
                name: value for name, value in options.items() if value is not None
            }
        client.call("get_action", flat_observation())
        assert running.policy.weights == [3.0, 0.0, None, 1.5, 3.0, 3.0]
        # Features of the words, and of the observation without them where they are needed.
        assert running.policy.batches == [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    with serving() as running, Client(port=running.port) as client:
        client.get_action(observation())
        assert running.policy.weights == [None]


@pytest.mark.parametrize("value", [-1, math.nan, math.inf, 1e39, "2", True, [2.0]], ids=str)
def test_guidance_that_is_no_weight_is_refused(value: Any) -> None:
    with serving() as running, Client(port=running.port) as client:
        with pytest.raises(ServerError, match=r"^(options: guidance: expected a finite number|request)"):
            client.get_action(observation(), {"guidance": value})
        assert running.policy.batches == []
    listener = bind("127.0.0.1", 0)
    with listener, pytest.raises(InputError, match=r"^guidance: expected a finite number"):
        Server(MemoryPolicy(), listener, MemoryLog(), guidance=value)  # type: ignore[arg-type]
    with listener, pytest.raises(InputError, match=r"^without: expected 'default' or 'empty', got 'no'"):
        Server(MemoryPolicy(), listener, MemoryLog(), without="no")  # type: ignore[arg-type]


def test_requests_with_other_weights_are_sampled_apart() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    weights = [None, 2, 0.5, 2, 1, 0.5]
    with serving(policy) as running, ExitStack() as stack:
        clients = [stack.enter_context(requester(running.port, zmq.DEALER)) for _ in weights]
        for number, client in enumerate(clients):
            post(client, get_action(observation(number), seed=number, guidance=weights[number]))
            if number == 0:  # it is being computed, and waits no more
                wait_until(lambda: policy.begun == [1])
        policy.gate.set()
        applied = [answer(client)[1]["applied_options"] for client in clients]
    assert policy.batches == [1, 5, 4]
    assert sorted(policy.weights[1:], key=str) == [0.5, 2.0, None]
    assert [one.get("guidance") for one in applied] == weights


def test_a_request_without_words_gets_an_error_and_the_others_actions() -> None:
    bare = {key: value for key, value in observation().items() if key != "language"}
    with serving() as running, Client(port=running.port) as client:
        with pytest.raises(ServerError, match=r"^guidance: expected an instruction"):
            client.get_action(bare, {"guidance": 2.0})
        client.get_action(observation(), {"guidance": 2.0})


def test_requests_with_other_steps_are_sampled_apart() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    steps = [None, 2, 4, 2, None, 4]
    with serving(policy) as running, ExitStack() as stack:
        clients = [stack.enter_context(requester(running.port, zmq.DEALER)) for _ in steps]
        for number, client in enumerate(clients):
            post(client, get_action(observation(number), seed=number, num_steps=steps[number]))
            if number == 0:  # it is being computed, and waits no more
                wait_until(lambda: policy.begun == [1])
        policy.gate.set()
        applied = [answer(client)[1]["applied_options"] for client in clients]
    assert policy.batches == [1, 5]
    assert sorted(policy.steps[1:], key=str) == [2, 4, None]
    assert [one.get("num_steps") for one in applied] == steps


def test_released_chunking_continues_the_sessions_last_chunk() -> None:
    with serving() as running, Client(port=running.port) as client:
        first, info = client.get_action(observation(), {"session": "a", **RELEASED})
        assert (info["applied_options"], info["continued"]) == ({"session": "a"}, False)
        assert "ignored_options" not in info
        second, info = client.get_action(observation(), {"session": "a", **RELEASED})
        assert (info["applied_options"], info["continued"]) == ({"session": "a", **RELEASED}, True)
        assert running.policy.chunkings == [None, saccade.Chunking(4, 2, 2.5, 6)]
        np.testing.assert_array_equal(second["arm"][:, :2], first["arm"][:, 2:4])
        # No overlap is a chunk of its own.
        assert told(client, session="a", **RELEASED | {"rtc_overlap_steps": 0, "rtc_frozen_steps": 0}) == {
            "applied_options": {"session": "a"},
            "session": "a",
            "continued": False,
        }


def test_released_chunking_without_a_session_is_ignored() -> None:
    with serving() as running, Client(port=running.port) as client:
        for _ in range(2):
            info = told(client, seed=1, x=None, **RELEASED)
            assert info == {"applied_options": {"seed": 1}, "ignored_options": ["x", *RELEASED]}
        assert told(client, rtc_overlap_steps=-5)["ignored_options"] == ["rtc_overlap_steps"]
        assert running.policy.chunkings == [None] * 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rtc_ramp_rate": None}, "without rtc_ramp_rate"),
        ({"action_horizon": None, "rtc_frozen_steps": None}, "without action_horizon, rtc_frozen_steps"),
        ({"executed": 2}, "got executed, action_horizon, rtc_overlap_steps, rtc_frozen_steps, rtc_ramp_rate"),
        ({"frozen": 2, "action_horizon": None}, "got frozen, rtc_overlap_steps"),
        ({"rtc_overlap_steps": 7}, "rtc_overlap_steps: expected at most 6 (action_horizon), got 7"),
        ({"rtc_frozen_steps": 5}, "rtc_frozen_steps: expected at most 4 (rtc_overlap_steps), got 5"),
        ({"rtc_frozen_steps": -1}, "rtc_frozen_steps: expected at least 0, got -1"),
        ({"rtc_overlap_steps": 1.0}, "rtc_overlap_steps: expected an integer, got 1.0"),
        (
            {"action_horizon": 0, "rtc_overlap_steps": 0, "rtc_frozen_steps": 0},
            "action_horizon: expected at least 1",
        ),
        ({"rtc_ramp_rate": 0}, "rtc_ramp_rate: expected a finite number above 0, got 0"),
        ({"rtc_ramp_rate": float("inf")}, "rtc_ramp_rate: expected a finite number above 0, got inf"),
        (
            {"action_horizon": 9},
            "action_horizon: expected at most 8, the actions of the session's last chunk",
        ),
    ],
)
def test_released_chunking_that_cannot_be_followed_is_refused(change: dict[str, Any], message: str) -> None:
    with serving() as running, Client(port=running.port) as client:
        client.get_action(observation(), {"session": "a"})
        with pytest.raises(ServerError, match=re.escape(message)):
            client.get_action(observation(), {"session": "a", **RELEASED, **change})
        assert client.get_action(observation(), {"session": "a", **RELEASED})[1]["continued"]


class ReleasedPolicy(MemoryPolicy):
    """The head of the file `n17_rtc` on the inputs of its run; the first chunk is the run's previous one."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.released = load_released("n17_rtc")
        head = saccade.ActionHead.from_pretrained(self.released.path, config=self.released.config)
        self.head = SimpleNamespace(config=head.config, source=None, num_threads=1, encode=self.head.encode)
        self.call = head

    def sample(self, encoded: Any, observations: Sequence[ParsedObservation], **options: Any) -> list[Any]:
        self.chunkings.append(options.get("chunking"))
        actions = self.released.options["previous_chunk"]
        if options.get("chunking") is not None:
            (previous,) = options["previous_chunk"]
            changed = {
                "previous_chunk": np.concatenate([previous["arm"], previous["gripper"]], -1),
                "chunking": options["chunking"],
                "noise": options["noise"],
                "num_steps": options["num_steps"],
            }
            actions = self.call(**self.released.arguments | changed)
        parts = {"arm": actions[..., :2], "gripper": actions[..., 2:]}
        return [parsed.format.write_actions(parts, parsed) for parsed in observations]


def test_released_chunking_gives_the_released_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = ReleasedPolicy()
    released = policy.released
    monkeypatch.setattr(engine, "noise_or_draw", lambda *arguments: released.noise)
    with serving(policy) as running, Client(port=running.port) as client:
        rtc = released.options["chunking"]
        options = {
            "session": 1,
            "action_horizon": rtc.horizon,
            "rtc_overlap_steps": rtc.overlap,
            "rtc_frozen_steps": rtc.frozen,
            "rtc_ramp_rate": rtc.ramp_rate,
        }
        client.get_action(observation(rows=2), options)
        actions, info = client.get_action(observation(rows=2), options)
    assert info["continued"]
    found = np.concatenate([actions["arm"], actions["gripper"]], -1)
    assert (np.abs(found - released.actions_f64) <= released.tolerance).all()


def test_errors_are_one_line() -> None:
    with serving() as running, Client(port=running.port) as client:
        seen = observation()
        seen["state"]["arm\n\x1b[2Jleg"] = seen["state"].pop("arm")
        with pytest.raises(ServerError) as caught:
            client.get_action(seen)
    message = str(caught.value)
    assert message.isprintable()
    assert message.endswith(
        "needs cameras front; state keys arm (2), gripper (1); language key annotation.task"
    )


def test_modality_configs_of_a_data_config() -> None:
    """As the released servers of N1.5 answer: words have the steps of observations, too."""
    groups = [SimpleNamespace(key=key) for key in ("arm", "gripper")]
    needs = SimpleNamespace(
        embodiment="robot",
        cameras=(Camera("wrist"), Camera("front")),
        state_history=2,
        video_horizon=2,
        language_key="annotation.human.task_description",
        language_keys=("annotation.human.action.task_description",),
        observation_indices=(-3, 0),
        action_indices=(0, 2, 4),
    )
    policy: Any = SimpleNamespace(
        head=SimpleNamespace(config=SimpleNamespace(action_horizon=3), source=None),
        normalizer=SimpleNamespace(state_groups=groups, action_groups=groups[:1], action_horizon=3),
        requirements=needs,
    )
    text = {name: json.loads(one["as_json"]) for name, one in modalities.answers(policy)["text"].items()}
    assert text == {
        "video": {"delta_indices": [-3, 0], "modality_keys": ["video.wrist", "video.front"]},
        "state": {"delta_indices": [-3, 0], "modality_keys": ["state.arm", "state.gripper"]},
        "action": {"delta_indices": [0, 2, 4], "modality_keys": ["action.arm"]},
        "language": {
            "delta_indices": [-3, 0],
            "modality_keys": ["annotation.human.action.task_description"],
        },
    }
    plain = {name: one["as_json"] for name, one in modalities.answers(policy)["map"].items()}
    assert plain["video"] == {"delta_indices": [-3, 0], "modality_keys": ["wrist", "front"]}
    assert plain["language"] == text["language"]
    policy.normalizer.action_horizon = 2  # fewer than are denoised, as lerobot policies may say
    assert modalities.answers(policy)["map"]["action"]["as_json"]["delta_indices"] == [0, 2]


def test_modality_configs_of_fewer_actions_than_lerobot_says() -> None:
    """The config has as many steps as the answers have actions."""
    policy = saccade.Policy.from_pretrained(
        whole_checkpoints.whole("lerobot"), action_horizon=3, num_threads=1
    )
    assert policy.normalizer.action_horizon is not None
    assert policy.normalizer.action_horizon > 3
    (lengths,) = {chunk.shape[1] for chunk in policy.act(policy.example_observation(), seed=0).values()}
    found = modalities.answers(policy)["map"]["action"]["as_json"]["delta_indices"]
    assert (lengths, found) == (3, [0, 1, 2])


def test_modality_configs_in_the_folder_processor(tmp_path: Path) -> None:
    checkpoint = whole_checkpoints.whole("n17")
    file = json.loads((checkpoint / "processor_config.json").read_text())
    expected = file["processor_kwargs"]["modality_configs"][whole_checkpoints.EMBODIMENT]
    policy: Any = SimpleNamespace(
        head=SimpleNamespace(source=str(tmp_path)),
        requirements=SimpleNamespace(embodiment=whole_checkpoints.EMBODIMENT),
    )
    (tmp_path / "processor").mkdir()
    shutil.copy(checkpoint / "processor_config.json", tmp_path / "processor")
    found = modalities.answers(policy)["map"]
    assert {name: config["as_json"] for name, config in found.items()} == expected
    # The one in the folder itself counts, if there is one.
    (tmp_path / "processor" / "processor_config.json").write_text("{}")
    shutil.copy(checkpoint / "processor_config.json", tmp_path)
    assert modalities.answers(policy)["map"] == found
