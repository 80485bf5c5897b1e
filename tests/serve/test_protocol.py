"""The protocol of the server: answers by endpoint and release, tokens, limits."""

from __future__ import annotations

import json
import pickle
import re
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from saccade.serve import Client, Limits, ServerError
from tests.helpers.serve_cases import (
    HORIZON,
    PONG,
    MemoryPolicy,
    answer,
    ask,
    flat_observation,
    get_action,
    observation,
    packed,
    ping,
    post,
    requester,
    serving,
    wait_until,
)


def test_ping_and_other_endpoints() -> None:
    with serving() as running, requester(running.port) as made:
        assert ask(made, {"endpoint": "ping"}) == PONG
        assert ask(made, {"endpoint": "reset", "data": {"options": None}}) == {}
        assert ask(made, {"endpoint": "reset", "data": None}) == {}
        assert "expected one of ping, get_action" in ask(made, {"endpoint": "fly"})["error"]
        assert "expected a map" in ask(made, [1])["error"]
        assert "expected a map with the observation" in ask(made, {})["error"]  # get_action, as upstream


def test_n15_gets_the_actions_and_later_releases_a_list() -> None:
    with serving() as running, requester(running.port) as made:
        bare = ask(made, {"endpoint": "get_action", "data": flat_observation()})
        assert {key: value.shape for key, value in bare.items()} == {
            "action.arm": (HORIZON, 2),
            "action.gripper": (HORIZON, 1),
        }
        assert {value.dtype for value in bare.values()} == {np.dtype(np.float32)}
        answer = ask(made, get_action(observation(rows=2)))
        assert isinstance(answer, list)
        actions, info = answer
        assert {key: value.shape for key, value in actions.items()} == {
            "arm": (2, HORIZON, 2),
            "gripper": (2, HORIZON, 1),
        }
        assert info.keys() == {"applied_options", "latency_ms"}


def test_n17_gets_arrays_in_the_form_that_it_sends() -> None:
    def array(value: Any) -> Any:
        return {
            b"nd": True,
            b"type": value.dtype.str,
            b"kind": b"",
            b"shape": value.shape,
            b"data": value.tobytes(),
        }

    with serving() as running, requester(running.port) as made:
        made.send(msgpack.packb(get_action(seed=5), default=array))
        actions, _ = msgpack.unpackb(made.recv())
        fields = actions["arm"]
        assert (fields[b"nd"], fields[b"type"], fields[b"shape"]) == (True, "<f4", [1, HORIZON, 2])
        expected = ask(made, get_action(seed=5))[0]["arm"]
        np.testing.assert_array_equal(np.frombuffer(fields[b"data"], "<f4").reshape(expected.shape), expected)


def test_a_seed_for_clients_that_bring_none() -> None:
    request = {"endpoint": "get_action", "data": flat_observation()}
    with serving(seed=3) as running, requester(running.port) as made:
        first, second = (ask(made, request)["action.arm"] for _ in range(2))
        np.testing.assert_array_equal(first, second)
        seeded = ask(made, get_action(flat_observation(), seed=4))[0]["action.arm"]
        assert not np.array_equal(first, seeded)


def test_modality_configs_by_release() -> None:
    plain = {
        "video": {"delta_indices": [0], "modality_keys": ["front"]},
        "state": {"delta_indices": [0], "modality_keys": ["arm", "gripper"]},
        "action": {"delta_indices": list(range(HORIZON)), "modality_keys": ["arm", "gripper"]},
        "language": {"delta_indices": [0], "modality_keys": ["annotation.task"]},
    }
    marks = {"__ModalityConfig_class__": True, "__ModalityConfig__": True}
    as_maps = {name: {**marks, "as_json": config} for name, config in plain.items()}
    request = {"endpoint": "get_modality_config"}
    with serving(MemoryPolicy(version="n1.7")) as running, requester(running.port) as made:
        assert ask(made, request) == as_maps
        ask(made, {"endpoint": "get_action", "data": flat_observation()})  # a client of N1.5
        text = ask(made, request)
        assert json.loads(text["video"]["as_json"]) == {
            "delta_indices": [0],
            "modality_keys": ["video.front"],
        }
        assert json.loads(text["language"]["as_json"]) == plain["language"]
        with requester(running.port) as other:
            assert ask(other, request) == as_maps
    with serving(MemoryPolicy(version="n1.5")) as running, requester(running.port) as made:
        assert isinstance(ask(made, request)["video"]["as_json"], str)
        ask(made, get_action())
        assert ask(made, request) == as_maps
    with serving(modality_form="map") as running, requester(running.port) as made:
        assert ask(made, request) == as_maps


def test_kill_is_refused_unless_it_is_allowed() -> None:
    with serving() as running, requester(running.port) as made:
        assert "--allow-kill" in ask(made, {"endpoint": "kill"})["error"]
        assert ping(running.port) == PONG
    with serving(allow_kill=True) as running, requester(running.port) as made:
        assert "error" not in ask(made, {"endpoint": "kill"})
        running.thread.join(10)
        assert running.results == ["kill"]


def test_tokens() -> None:
    with serving(api_token="secret") as running, requester(running.port) as made:
        for endpoint in ("ping", "get_action", "reset", "get_modality_config", "kill"):
            for token in (
                {},
                {"api_token": "guess"},
                {"api_token": None},
                {"api_token": ""},
                {"api_token": 5},
            ):
                refused = ask(made, {"endpoint": endpoint} | token)
                assert refused == {"error": "Unauthorized: Invalid API token"}
        assert ask(made, {"endpoint": "ping", "api_token": "secret"}) == PONG
        with Client(port=running.port, api_token="secret") as client:
            assert client.call("ping") == PONG
        with Client(port=running.port) as client, pytest.raises(ServerError, match="Unauthorized"):
            client.call("ping")


@pytest.mark.parametrize(
    ("request_bytes", "match"),
    [
        (b"", "incomplete"),
        (b"\xc1", "not msgpack"),
        (b"\x81", "incomplete"),
        (b"\x91" * 5000, "nested too deeply"),
        (pickle.dumps({"endpoint": "ping"}), "pull request 329"),
        (packed(get_action({"video": 5})), "observation|state|expected"),
        (packed({"endpoint": "get_action", "data": {"observation": {}, "options": 5}}), "options: exp"),
        (packed({"endpoint": "get_action", "data": {"observation": {}, "extra": 5}}), "got also extra"),
        (packed({"endpoint": "get_action", "data": {"observation": 5}}), "expected a map"),
        (packed(get_action(seed=-1)), "seed: expected at least 0"),
        (packed(get_action(seed="x")), "seed: expected an integer"),
        (packed(get_action(session=1.5)), "session: expected text"),
        (packed(get_action(session="x" * 500)), "session: expected text"),
        (packed(get_action(executed=5)), "expected a session"),
        (packed(get_action(session="a", executed=-5)), "executed: expected at least 0"),
        (packed(get_action(session="a", ramp_rate=float("nan"))), "ramp_rate"),
        (packed(get_action(observation(rows=9))), "at most 8 rows, got 9"),
    ],
)
def test_bad_requests_are_answered_with_an_error(request_bytes: bytes, match: str) -> None:
    with serving(limits=Limits(rows=8)) as running, requester(running.port) as made:
        answer = ask(made, request_bytes)
        assert list(answer) == ["error"]
        assert re.search(match, answer["error"]), answer
        assert ask(made, {"endpoint": "ping"}) == PONG  # on the same connection
        line = next(line for line in running.log.lines if line["event"] == "request")
        assert line["error"]


def test_nan_in_state_and_frames() -> None:
    bad = observation()
    bad["state"]["arm"] = np.full((1, 1, 2), np.nan, np.float32)
    frames = {
        "observation.images.front": np.full((1, 3, 4, 4), np.nan, np.float32),
        "observation.state": np.zeros((1, 3), np.float32),
        "task": "go",
    }
    with serving() as running, requester(running.port) as made:
        assert "NaN" in ask(made, get_action(bad))["error"]
        assert "from 0 to 1" in ask(made, get_action(frames))["error"]
        assert isinstance(ask(made, get_action()), list)


def test_requests_beyond_those_that_may_wait_are_answered_at_once() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with (
        serving(policy, Limits(waiting=2), max_batch=1) as running,
        requester(running.port, zmq.DEALER) as made,
    ):
        post(made, get_action(seed=1))
        wait_until(lambda: policy.begun == [1])  # it is being computed, and waits no more
        for _ in range(5):
            made.send_multipart([b"", packed(get_action(seed=1))])
        assert [answer(made) for _ in range(3)] == [{"error": "busy: 2 requests wait; try again"}] * 3
        policy.gate.set()
        assert all(isinstance(answer(made), list) for _ in range(3))


def test_bytes_beyond_those_that_may_wait_are_refused() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    limits = Limits(waiting_bytes=3_000_000)
    large = get_action() | {"pad": bytes(1_100_000)}
    with serving(policy, limits, max_batch=1) as running, requester(running.port, zmq.DEALER) as made:
        for _ in range(5):
            made.send_multipart([b"", packed(large)])
        assert all("busy: 2" in answer(made)["error"] for _ in range(3))
        policy.gate.set()
        assert all(isinstance(answer(made), list) for _ in range(2))
        assert isinstance(ask_dealer(made, large), list)  # there is room again


def ask_dealer(made: zmq.Socket[bytes], value: Any) -> Any:
    made.send_multipart([b"", packed(value)])
    return answer(made)


def test_dealers_get_their_envelope_back() -> None:
    with serving() as running, requester(running.port, zmq.DEALER) as made:
        for envelope in ([], [b""], [b"id", b""], [b"1", b"2", b"3", b""]):
            made.send_multipart([*envelope, packed({"endpoint": "ping"})])
            *returned, answer = made.recv_multipart()
            assert returned == envelope
            assert msgpack.unpackb(answer) == PONG
        made.send_multipart([b"x"] * 10)
        wait_until(lambda: any("in one frame" in text for text in running.log.warnings()))
        assert ask_dealer(made, {"endpoint": "ping"}) == PONG


def test_sockets_with_a_routing_id_of_their_own_are_refused() -> None:
    with serving() as running, zmq.Context() as context, context.socket(zmq.REQ) as made:
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.IDENTITY, b"robot")
        made.connect(f"tcp://127.0.0.1:{running.port}")
        assert "expected no routing id of its own" in ask(made, get_action())["error"]
        assert running.policy.batches == []


def test_stopping_answers_what_was_accepted_and_refuses_the_rest() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy, max_batch=1) as running, requester(running.port, zmq.DEALER) as made:
        for seed in range(3):
            post(made, get_action(seed=seed))
        running.server.stop("SIGTERM")
        wait_until(lambda: any(line["event"] == "stopping" for line in running.log.lines))
        assert "stopping" in ask_dealer(made, get_action())["error"]
        policy.gate.set()
        assert all(isinstance(answer(made), list) for _ in range(3))
        running.thread.join(10)
        assert running.results == ["SIGTERM"]


def test_a_changed_checkpoint_is_noticed(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("saccade.serve.server.WATCH_SECONDS", 0.0)
    (tmp_path / "model.safetensors").write_bytes(b"old")
    policy = MemoryPolicy()
    policy.head.source = str(tmp_path)
    with serving(policy) as running:
        (tmp_path / "new").write_bytes(b"newer")
        (tmp_path / "new").replace(tmp_path / "model.safetensors")
        wait_until(lambda: any("has changed" in text for text in running.log.warnings()))
        assert len(running.log.warnings()) == 1
        with requester(running.port) as made:
            assert isinstance(ask(made, get_action()), list)
