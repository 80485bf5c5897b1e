"""Requests that nobody waits for are not computed, and answers never reach another client."""

from __future__ import annotations

import socket
import struct
import time
from contextlib import ExitStack
from typing import Any

import numpy as np
import zmq

from saccade.serve import Limits
from tests.helpers.serve_cases import (
    PONG,
    MemoryPolicy,
    Running,
    answer,
    ask,
    get_action,
    observation,
    packed,
    ping,
    post,
    requester,
    serving,
    shake_hands,
    wait_until,
)


def ask_and_leave(port: int, *, reset: bool = False, **options: Any) -> None:
    """Sends a request for actions; once the server has read it, the client is gone."""
    with shake_hands(port) as made:
        for request in (packed(get_action(**options)), packed({"endpoint": "ping"})):
            made.sendall(b"\x01\x00\x02" + struct.pack(">Q", len(request)) + request)
        received = b""
        while packed(PONG) not in received:
            received += made.recv(4096)
        if reset:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def statistics(running: Running) -> dict[str, Any]:
    """The last statistics of a server, which is stopped."""
    running.stop()
    return [line for line in running.log.lines if line["event"] == "statistics"][-1]


def test_requests_of_clients_that_are_gone_are_not_computed() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running, requester(running.port, zmq.DEALER) as made:
        post(made, get_action())
        wait_until(lambda: policy.begun == [1])
        for number in range(20):
            ask_and_leave(running.port, reset=number % 2 == 0)
        assert ping(running.port) == PONG
        post(made, get_action())
        policy.gate.set()
        for _ in range(2):
            assert isinstance(answer(made), list)
        wait_until(lambda: sum(line["endpoint"] == "get_action" for line in running.log.requests()) == 22)
        assert policy.batches == [1, 1]
        last = statistics(running)
        assert (last["dropped"], last["requests"]["get_action"], last["errors"]) == ({"gone": 20}, 22, 20)
        errors = [line["error"] for line in running.log.requests() if line["error"]]
        assert errors == ["dropped: its client is gone"] * 20


def test_requests_that_are_too_old_are_not_computed() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    limits = Limits(request_seconds=2.0)
    with serving(policy, limits, max_batch=1) as running, requester(running.port, zmq.DEALER) as made:
        post(made, get_action(seed=1))
        wait_until(lambda: policy.begun == [1])
        post(made, get_action(seed=2))
        time.sleep(2.1)
        post(made, get_action(seed=3))
        policy.gate.set()
        answers = [answer(made) for _ in range(3)]
        assert [isinstance(one, list) for one in answers] == [True, False, True]
        assert "more than the 2 s of --request-seconds" in answers[1]["error"]
        assert policy.batches == [1, 1]
        assert statistics(running)["dropped"] == {"late": 1}


def test_an_answer_that_nobody_takes_is_counted() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running:
        ask_and_leave(running.port)
        assert ping(running.port) == PONG
        # It may have been taken before its client left, or not.
        policy.gate.set()
        wait_until(lambda: any(line["endpoint"] == "get_action" for line in running.log.requests()))
        assert statistics(running)["dropped"] in ({"gone": 1}, {"unsent": 1})
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running, requester(running.port, zmq.DEALER) as made:
        post(made, get_action())
        wait_until(lambda: policy.begun == [1])
        made.close()
        assert ping(running.port) == PONG
        policy.gate.set()
        wait_until(lambda: any(line["endpoint"] == "get_action" for line in running.log.requests()))
        assert statistics(running)["dropped"] == {"unsent": 1}


def test_clients_get_their_own_answers_only_when_files_are_used_again() -> None:
    policy = MemoryPolicy()
    with serving(policy) as running, requester(running.port) as made:
        expected = [ask(made, get_action(observation(seed), seed=seed))[0]["arm"] for seed in range(20)]
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running, ExitStack() as stack:
        blocked = stack.enter_context(requester(running.port, zmq.DEALER))
        post(blocked, get_action())
        wait_until(lambda: policy.begun == [1])
        clients = []
        for seed in range(20):
            ask_and_leave(running.port, seed=100 + seed)
            clients.append(stack.enter_context(requester(running.port, zmq.DEALER)))
            post(clients[-1], get_action(observation(seed), seed=seed))
        policy.gate.set()
        for client, one in zip(clients, expected, strict=True):
            np.testing.assert_array_equal(answer(client)[0]["arm"], one)
            assert not client.poll(0)
