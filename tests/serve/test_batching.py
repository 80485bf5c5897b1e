"""Which requests the server computes together."""

from __future__ import annotations

import itertools
import threading
import weakref
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import zmq

from saccade.observations import FORMATS, ParsedObservation, ParsedState, Requirements
from saccade.serve.batching import ACTIVE_SECONDS, Job, Queue
from saccade.serve.requests import Call, Options
from tests.helpers.serve_cases import (
    HORIZON,
    MemoryPolicy,
    answer,
    get_action,
    observation,
    packed,
    post,
    requester,
    serving,
    wait_until,
)


def job(client: Any = None, rows: int = 1, session: str | None = None, received: float = 0.0) -> Job:
    nothing = ParsedState(
        FORMATS[0], Requirements(None, None, ()), True, False, np.zeros((rows, 1, 1), np.float32)
    )
    parsed = ParsedObservation(**vars(nothing), frames=(), instructions=(), is_plain=False)
    call = Call("get_action", options=Options(session=session))
    return Job(call, parsed, object() if client is None else client, received=received)


@dataclass(eq=False)
class Clock:
    """A clock that a test moves."""

    now: float = 0.0

    def __call__(self) -> float:
        return self.now


def rows(jobs: list[Job] | None) -> list[int]:
    assert jobs is not None
    return [one.rows for one in jobs]


def computed(queue: Queue) -> list[int]:
    """The rows of the requests of the next batch, which is done at once."""
    jobs = queue.take()
    assert jobs is not None
    queue.done(jobs)
    return rows(jobs)


def test_a_batch_has_at_most_so_many_rows() -> None:
    queue = Queue(4, 0.0)
    for size in (1, 2, 3, 9, 1):
        queue.put(job(rows=size))
    assert [computed(queue) for _ in range(4)] == [[1, 2], [3], [9], [1]]
    assert len(queue) == 0
    queue.close()
    assert queue.take() is None


def test_a_client_alone_does_not_wait_and_others_wait_for_each_other() -> None:
    clock = Clock()
    queue = Queue(16, 30.0, clock=clock)
    queue.put(job("a"))
    assert computed(queue) == [1]
    queue.put(job("b"))
    with ThreadPoolExecutor(1) as threads:
        taken = threads.submit(computed, queue)
        with pytest.raises(futures.TimeoutError):
            taken.result(0.05)  # a is expected
        queue.put(job("a"))
        assert taken.result(60) == [1, 1]
    queue.put(job("a"))
    clock.now += ACTIVE_SECONDS + 0.1
    assert computed(queue) == [1]  # b is no longer expected


def test_the_oldest_request_waits_no_longer_than_asked() -> None:
    clock = Clock()
    queue = Queue(16, 0.1, clock=clock)
    for client in ("a", "b"):
        queue.put(job(client))
    assert computed(queue) == [1, 1]
    queue.put(job("a"))
    clock.now += 0.11
    assert computed(queue) == [1]


def test_a_closed_queue_does_not_wait() -> None:
    queue = Queue(16, 60.0, clock=Clock())
    for client in ("a", "b"):
        queue.put(job(client))
    assert computed(queue) == [1, 1]
    queue.put(job("a"))
    queue.close()
    assert computed(queue) == [1]
    assert queue.take() is None


def test_one_request_of_a_session_in_a_batch() -> None:
    queue = Queue(16, 0.0)
    jobs = [job(session="a"), job(session="a"), job(), job(session="b"), job(session="a")]
    for one in jobs:
        queue.put(one)
    for chosen in ([jobs[0], jobs[2], jobs[3]], [jobs[1]], [jobs[4]]):
        assert queue.take() == chosen
        queue.done(chosen)


def test_a_session_is_computed_by_one_thread_at_a_time() -> None:
    queue = Queue(16, 0.0, num_workers=2)
    first, second, other = job(session="a"), job(session="a"), job(session="b")
    queue.put(first)
    assert queue.take() == [first]
    queue.put(second)
    queue.put(other)
    assert queue.take() == [other]
    with ThreadPoolExecutor(1) as threads:
        taken = threads.submit(queue.take)
        with pytest.raises(futures.TimeoutError):
            taken.result(0.1)
        queue.done([first])
        assert taken.result(10) == [second]


def test_threads_share_out_what_waits() -> None:
    both_wait, calls = threading.Barrier(3), itertools.count()

    def prepare(job: Job) -> None:
        if next(calls) < 2:
            both_wait.wait(60)

    queue = Queue(8, 60.0, prepare, num_workers=2, clock=Clock())
    for client in range(6):
        queue.put(job(client))
    for jobs in [queue.take(), queue.take()]:
        assert jobs
        queue.done(jobs)
    with ThreadPoolExecutor(2) as threads:
        taken = [threads.submit(queue.take) for _ in range(2)]
        for client in range(2):
            queue.put(job(client))
        both_wait.wait(60)
        for client in range(2, 6):
            queue.put(job(client))
        assert [rows(one.result(60)) for one in taken] == [[1] * 3, [1] * 3]
    queue = Queue(8, 0.0, num_workers=2)
    for _ in range(9):
        queue.put(job())
    assert [rows(queue.take()) for _ in range(3)] == [[1] * 4, [1] * 4, [1]]
    queue.close()
    assert queue.take() is None


def test_threads_never_compute_more_than_a_batch_at_a_time() -> None:
    for most, workers, expected in ((1, 1, [1, 1]), (3, 2, [1, 1]), (7, 2, [3, 3]), (8, 3, [2, 2, 2])):
        queue = Queue(most, 0.0, num_workers=workers)
        for _ in range(20):
            queue.put(job())
        assert [len(queue.take() or []) for _ in expected] == expected
    for most, expected_workers in ((1, 1), (2, 2), (16, 2)):
        with serving(MemoryPolicy(nbytes=1000), max_batch=most) as running:
            assert running.server.num_workers == expected_workers


def test_clients_that_are_gone_are_forgotten() -> None:
    clock = Clock()
    queue = Queue(16, 0.0, clock=clock)
    clients = []
    for _ in range(100):
        clock.now += 0.1 * ACTIVE_SECONDS
        client = Clock()  # any object
        clients.append(weakref.ref(client))
        queue.put(job(client))
        queue.put(job("client that stays"))
        assert computed(queue) == [1, 1]
    assert sum(client() is not None for client in clients) <= 12


def test_what_a_thread_prepares_is_left_to_it() -> None:
    prepared: list[Job] = []
    begun, go_on = threading.Event(), threading.Event()

    def prepare(job: Job) -> None:
        prepared.append(job)
        begun.set()
        assert go_on.wait(60)

    queue = Queue(16, 60.0, prepare, num_workers=2, clock=Clock())
    for client in ("a", "b"):
        queue.put(job(client))
    assert computed(queue) == [1, 1]
    first, same, other = job("a", session="s"), job("a", session="s"), job("b")
    with ThreadPoolExecutor(2) as threads:
        try:
            queue.put(first)
            slow = threads.submit(queue.take)
            assert begun.wait(60)
            queue.put(same)
            queue.put(other)
            assert threads.submit(queue.take).result(30) == [other]
            assert not slow.done()
            go_on.set()
            assert slow.result(30) == [first]
            assert prepared == [first]
            queue.done([first])
            assert queue.take() == [same]
        finally:
            go_on.set()
            queue.close()


def test_clients_that_are_computed_are_not_waited_for() -> None:
    queue = Queue(16, 30.0, num_workers=2, clock=Clock())
    for client in ("a", "b"):
        queue.put(job(client))
    first = queue.take()
    assert rows(first) == [1, 1]
    queue.put(job("a"))
    assert rows(queue.take()) == [1]


def test_requests_that_wait_for_others_are_prepared() -> None:
    prepared: list[Job] = []
    clock = Clock()

    def prepare(job: Job) -> None:
        prepared.append(job)
        clock.now += 30.0

    queue = Queue(16, 20.0, prepare, clock=clock)
    for client in ("a", "b"):
        queue.put(job(client))
    first = queue.take()
    assert prepared == []  # nobody else was expected
    assert first is not None
    queue.done(first)
    queue.put(job("a"))
    assert queue.take() == prepared


def test_requests_of_many_clients_are_one_batch_with_the_same_bits() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    requests = [get_action(observation(seed, rows=1 + seed % 3), seed=seed) for seed in range(8)]
    with serving(policy) as running, ExitStack() as stack:
        clients = [stack.enter_context(requester(running.port, zmq.DEALER)) for _ in requests]
        post(clients[0], requests[0])
        wait_until(lambda: policy.begun == [1])
        for client, request in zip(clients[1:], requests[1:], strict=True):
            post(client, request)
        policy.gate.set()
        together = [answer(client)[0] for client in clients]
        assert policy.batches == [1, 14]
        for client, request, chunk in zip(clients, requests, together, strict=True):
            alone = ask_again(client, request)
            assert all(np.array_equal(chunk[key], alone[key]) for key in chunk)


def ask_again(client: zmq.Socket[bytes], request: dict[str, Any]) -> Any:
    """The actions for a request of a DEALER that waits for nothing else."""
    client.send_multipart([b"", packed(request)])
    return answer(client)[0]


def test_a_small_policy_computes_several_batches_at_a_time() -> None:
    policy = MemoryPolicy(nbytes=1000)
    policy.gate.clear()
    requests = [get_action(observation(seed), seed=seed) for seed in range(5)]
    with serving(policy) as running, ExitStack() as stack:
        clients = [stack.enter_context(requester(running.port, zmq.DEALER)) for _ in requests]
        for client, request in zip(clients, requests, strict=True):
            post(client, request)
        wait_until(lambda: len(policy.begun) == 2)
        policy.gate.set()
        chunks = [answer(client)[0] for client in clients]
        assert sum(policy.batches) == 5
        for client, request, chunk in zip(clients, requests, chunks, strict=True):
            alone = ask_again(client, request)
            assert all(np.array_equal(chunk[key], alone[key]) for key in alone)


@pytest.mark.parametrize(("text", "message"), [("explode", "RuntimeError: exploded"), ("crash", "crashed")])
def test_a_request_that_fails_does_not_harm_its_batch(text: str, message: str) -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running, ExitStack() as stack:
        clients = [stack.enter_context(requester(running.port, zmq.DEALER)) for _ in range(4)]
        # The one that fails must not come first, since it would be answered before the others are there.
        post(clients[0], get_action())
        wait_until(lambda: policy.begun == [1])
        for number in range(1, 4):
            post(clients[number], get_action(observation(text=text if number == 2 else "go")))
        policy.gate.set()
        for number in (0, 1, 3):
            assert answer(clients[number])[0]["arm"].shape == (1, HORIZON, 2)
        assert message in answer(clients[2])["error"]
