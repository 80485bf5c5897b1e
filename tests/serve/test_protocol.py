"""The protocol of the server: answers by endpoint and release, tokens, limits, clients that misbehave."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import re
import resource
import socket
import struct
import threading
import time
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from saccade.serve import Client, Limits, ServerError, zmtp
from saccade.serve.connections import bind
from tests.helpers.serve_cases import (
    HORIZON,
    MemoryPolicy,
    ask,
    connect,
    flat_observation,
    get_action,
    observation,
    packed,
    requester,
    serving,
    wait_until,
)

PONG = {"status": "ok", "message": "Server is running"}
NULL = zmtp.GREETING
READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"


def is_alive(port: int) -> bool:
    with requester(port) as made:
        return bool(ask(made, {"endpoint": "ping"}) == PONG)


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


def test_requests_are_answered_that_come_with_the_greeting_and_before_garbage() -> None:
    ping = b"".join(zmtp.message((b"",), packed({"endpoint": "ping"})))
    with serving() as running, connect(running.port, NULL + READY + 2 * ping + b"\xff") as made:
        received = b""
        while piece := made.recv(1 << 16):
            received += piece
    answer = b"".join(zmtp.message((b"",), packed(PONG)))
    assert received == NULL + b"\x04\x1c" + zmtp.READY + 2 * answer
    assert "expected a frame, got flags 0xff" in running.log.warnings()[0]


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
        assert is_alive(running.port)
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
        (b"", "empty"),
        (b"\xc1", "extension"),
        (b"\x81", "cut off"),
        (b"\x91" * 100, "nesting of at most 16"),
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


def test_large_requests_are_skipped_and_answered() -> None:
    with serving(limits=Limits(message_bytes=100_000)) as running, requester(running.port) as made:
        answer = ask(made, bytes(30_000_000))
        assert answer == {"error": "message: expected at most 100000 bytes, got 30000000"}
        assert ask(made, {"endpoint": "ping"}) == PONG
        assert ask(made, packed({"endpoint": "ping", "pad": "x" * 99_000})) == PONG


def test_requests_beyond_those_that_may_wait_are_answered_at_once() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with (
        serving(policy, Limits(waiting=2), max_batch=1) as running,
        requester(running.port, zmq.DEALER) as made,
    ):
        for number in range(6):
            made.send_multipart([b"", packed(get_action(seed=1))])
            if number == 0:  # it is being computed, and waits no more
                wait_until(lambda: running.server._unanswered == 1 and not len(running.server._queue))
        refused = [msgpack.unpackb(made.recv_multipart()[-1]) for _ in range(3)]
        assert refused == [{"error": "busy: 2 requests wait; try again"}] * 3
        policy.gate.set()
        answers = [msgpack.unpackb(made.recv_multipart()[-1]) for _ in range(3)]
        assert all(isinstance(answer, list) for answer in answers)


def test_bytes_beyond_those_that_may_wait_are_refused() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    limits = Limits(waiting_bytes=3_000_000)
    large = get_action() | {"pad": bytes(1_100_000)}
    with serving(policy, limits, max_batch=1) as running, requester(running.port, zmq.DEALER) as made:
        for _ in range(5):
            made.send_multipart([b"", packed(large)])
        assert "busy" in msgpack.unpackb(made.recv_multipart()[-1])["error"]
        policy.gate.set()


def test_dealers_get_their_envelope_back() -> None:
    with serving() as running, requester(running.port, zmq.DEALER) as made:
        for envelope in ([], [b""], [b"id", b""], [b"1", b"2", b"3", b""]):
            made.send_multipart([*envelope, packed({"endpoint": "ping"})])
            *returned, answer = made.recv_multipart()
            assert returned == envelope
            assert msgpack.unpackb(answer) == PONG


def test_other_sockets_of_zeromq_are_refused() -> None:
    with serving() as running, requester(running.port, zmq.SUB) as made:
        made.setsockopt(zmq.SUBSCRIBE, b"")
        wait_until(lambda: any("expected a REQ socket, got 'SUB'" in text for text in running.log.warnings()))
        assert is_alive(running.port)


def test_heartbeats_are_answered() -> None:
    with serving() as running, zmq.Context() as context, context.socket(zmq.REQ) as made:
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.HEARTBEAT_IVL, 50)
        made.setsockopt(zmq.HEARTBEAT_TIMEOUT, 150)
        monitor = made.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        made.connect(f"tcp://127.0.0.1:{running.port}")
        made.send(packed({"endpoint": "ping"}))
        assert made.poll(5000)
        assert not monitor.poll(500)
        made.disable_monitor()


def test_http_is_told_what_this_is() -> None:
    with serving() as running:
        for method in (b"GET", b"POST"):
            with connect(
                running.port, method + b" / HTTP/1.1\r\nHost: localhost\r\n\r\n" + bytes(100)
            ) as made:
                answer = b"".join(iter(lambda: made.recv(4096), b""))
            assert answer.startswith(b"HTTP/1.1 400 Bad Request\r\n")
            assert b"ZeroMQ" in answer
        assert any("began with 'GET / HTTP'" in text for text in running.log.warnings())
        assert is_alive(running.port)


@pytest.mark.parametrize(
    "data",
    [
        b"\x16\x03\x01\x02\x00\x01\x00\x01",  # TLS
        b"\x01\x00",  # ZMTP 1
        b"\xff" * 64,
        NULL[:10] + b"\x01\x05",  # ZMTP 2
        NULL[:12] + b"CURVE".ljust(20, b"\0") + bytes(32),
        NULL + b"\x00\x01x",  # a message before READY
        NULL + READY + b"\xf0\x01x",  # flags that do not exist
        NULL + READY + b"\x02\xff\xff\xff\xff\xff\xff\xff\xff",  # a message of 2**64 - 1 bytes
        NULL + READY + b"\x01\x01a" * 20,  # too many frames
        NULL + READY + b"\x03" + struct.pack(">Q", 1000) + bytes(1000) + b"\x00\x00",  # in two frames
        NULL + b"\x06" + struct.pack(">Q", 1 << 20),  # a long command
        NULL + b"\x04\x07\x05ERROR\x00",
    ],
)
def test_garbage_closes_its_own_connection(data: bytes) -> None:
    with serving() as running:
        with connect(running.port, data) as made:
            made.settimeout(10)
            while made.recv(4096):
                pass
        assert running.log.warnings()
        assert is_alive(running.port)


def test_half_messages_and_stalls() -> None:
    with serving(limits=Limits(stall_seconds=0.3)) as running:
        idle = requester(running.port)
        with idle as client:
            assert ask(client, {"endpoint": "ping"}) == PONG
            for data in (b"\xff\x00", NULL, NULL + READY + b"\x02" + struct.pack(">Q", 1000) + bytes(500)):
                with connect(running.port, data) as made:
                    while made.recv(4096):
                        pass
            stalled = [text for text in running.log.warnings() if "stalled" in text]
            assert len(stalled) == 3
            assert ask(client, {"endpoint": "ping"}) == PONG  # was idle for longer, and not closed
        with connect(running.port, NULL + READY + b"\x02" + struct.pack(">Q", 1000) + bytes(500)):
            pass
        wait_until(lambda: any("in the middle of a request" in text for text in running.log.warnings()))


def test_a_client_that_does_not_read_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("saccade.serve.connections.MOST_UNREAD", 10_000)
    with serving() as running, socket.socket() as made:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # as small as it gets
        made.settimeout(30)
        made.connect(("127.0.0.1", running.port))
        request = packed({"endpoint": "get_modality_config"})
        with contextlib.suppress(OSError):  # it may be closed meanwhile
            made.sendall(NULL + READY + (b"\x00" + bytes([len(request)]) + request) * 100_000)
        wait_until(lambda: any("does not read" in text for text in running.log.warnings()))
        assert is_alive(running.port)


def test_clients_that_die_do_not_matter() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running:
        for linger in (0, 1):
            with connect(running.port, NULL + READY) as made:
                payload = packed(get_action())
                made.sendall(b"\x01\x00\x02" + struct.pack(">Q", len(payload)) + payload)
                made.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1 - linger, 0))
                time.sleep(0.1)
        policy.gate.set()
        wait_until(lambda: sum(policy.batches) == 2)
        with requester(running.port) as made:
            assert isinstance(ask(made, get_action()), list)


def test_more_clients_than_allowed_are_closed() -> None:
    with serving(limits=Limits(clients=2)) as running:
        with requester(running.port) as first, requester(running.port) as second:
            for client in (first, second):
                assert ask(client, {"endpoint": "ping"}) == PONG
            with connect(running.port) as third:
                assert third.recv(10) == b""
        wait_until(lambda: any("2 clients are connected" in text for text in running.log.warnings()))
        wait_until(lambda: is_alive(running.port))


def test_no_files_left_for_clients() -> None:
    with serving() as running, requester(running.port) as before:
        assert ask(before, {"endpoint": "ping"}) == PONG
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        spare = os.dup(0)  # the lowest free number
        os.close(spare)
        with socket.socket() as late:
            resource.setrlimit(resource.RLIMIT_NOFILE, (spare + 1, hard))
            try:
                late.connect(("127.0.0.1", running.port))
                wait_until(lambda: any("Too many open files" in text for text in running.log.warnings()))
                assert ask(before, {"endpoint": "ping"}) == PONG
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            late.sendall(NULL + READY)
            late.settimeout(10)
            assert late.recv(1) == b"\xff"  # it was accepted a second later


def test_ports_in_use_are_named() -> None:
    with serving() as running, pytest.raises(OSError, match=f"127.0.0.1:{running.port}"):
        bind("127.0.0.1", running.port)
    for host, port in (("no.such.host.invalid", 5555), ("127.0.0.1", 70_000), ("\ud800", 1)):
        with pytest.raises(OSError, match=f"{port}"):
            bind(host, port)


def test_stopping_answers_what_was_accepted_and_refuses_the_rest() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy, max_batch=1) as running, requester(running.port, zmq.DEALER) as made:
        for seed in range(3):
            made.send_multipart([b"", packed(get_action(seed=seed))])
        wait_until(lambda: running.server._unanswered == 3)
        running.server.stop("SIGTERM")
        wait_until(lambda: any(line["event"] == "stopping" for line in running.log.lines))
        with pytest.raises(ConnectionRefusedError):
            connect(running.port)
        made.send_multipart([b"", packed(get_action())])
        assert "stopping" in msgpack.unpackb(made.recv_multipart()[-1])["error"]
        threading.Timer(0.2, policy.gate.set).start()
        answers = [msgpack.unpackb(made.recv_multipart()[-1]) for _ in range(3)]
        assert all(isinstance(answer, list) for answer in answers)
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
