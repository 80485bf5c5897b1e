"""Which requests the server computes together, its sessions, its statistics and its logs."""

from __future__ import annotations

import json
import os
import threading
import time
from concurrent import futures
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saccade.errors import InputError
from saccade.observations import FORMATS, ParsedObservation, ParsedState, Requirements
from saccade.serve import Client, Server, ServerError
from saccade.serve.batching import Job, Queue
from saccade.serve.connections import bind
from saccade.serve.logs import MOST_LINES, MOST_WARNINGS, JsonLog, LiveLog, TextLog, Writer
from saccade.serve.requests import Call, Options
from saccade.serve.sessions import Chunk, Sessions
from saccade.serve.statistics import Statistics, line
from tests.helpers.serve_cases import (
    HORIZON,
    MemoryLog,
    MemoryPolicy,
    ask,
    get_action,
    observation,
    requester,
    serving,
    wait_until,
)


def job(client: Any = None, rows: int = 1, session: str | None = None) -> Job:
    nothing = ParsedState(
        FORMATS[0], Requirements(None, None, ()), True, False, np.zeros((rows, 1, 1), np.float32)
    )
    parsed = ParsedObservation(**vars(nothing), frames=(), instructions=(), is_plain=False)
    return Job(Call("get_action", options=Options(session=session)), parsed, client or object())


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


def test_a_client_alone_does_not_wait_and_others_wait_for_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("saccade.serve.batching.ACTIVE_SECONDS", 0.3)
    queue = Queue(16, 30.0)
    queue.put(job("a"))
    assert computed(queue) == [1]
    queue.put(job("b"))
    threading.Timer(0.05, lambda: queue.put(job("a"))).start()
    assert computed(queue) == [1, 1]
    queue.put(job("a"))
    start = time.monotonic()
    assert computed(queue) == [1]  # b is no longer expected after a while
    assert 0.1 < time.monotonic() - start < 10


def test_the_oldest_request_waits_no_longer_than_asked() -> None:
    queue = Queue(16, 0.1)
    for client in ("a", "b"):
        queue.put(job(client))
    assert computed(queue) == [1, 1]
    queue.put(job("a"))
    start = time.monotonic()
    assert computed(queue) == [1]
    assert 0.05 < time.monotonic() - start < 5


def test_a_closed_queue_does_not_wait() -> None:
    queue = Queue(16, 60.0)
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
    queue = Queue(8, 0.0, num_workers=2)
    with ThreadPoolExecutor(2) as threads:
        taken = [threads.submit(queue.take) for _ in range(2)]
        wait_until(lambda: queue._num_idle == 2)
        with queue._changed:  # all arrive at once
            for _ in range(6):
                queue.put(job())
        assert [rows(one.result(10)) for one in taken] == [[1] * 3, [1] * 3]
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
        listener = bind("127.0.0.1", 0)
        policy: Any = MemoryPolicy(nbytes=1000)
        server = Server(policy, listener, MemoryLog(), max_batch=most)
        assert len(server._workers) == expected_workers
        server._connections.close()


def test_clients_that_are_gone_are_forgotten_while_the_queue_is_full() -> None:
    now = [0.0]
    queue = Queue(1, 0.0, clock=lambda: now[0])
    for number in range(100):
        now[0] = 0.1 * number
        queue.put(job(f"client {number}"))
        queue.put(job("client that stays"))
    assert len(queue._active) <= 12


def test_what_a_thread_prepares_is_left_to_it() -> None:
    prepared: list[Job] = []
    begun, go_on = threading.Event(), threading.Event()

    def prepare(job: Job) -> None:
        prepared.append(job)
        begun.set()
        assert go_on.wait(60)

    queue = Queue(16, 60.0, prepare, num_workers=2)
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
    queue = Queue(16, 30.0, num_workers=2)
    for client in ("a", "b"):
        queue.put(job(client))
    first = queue.take()
    assert rows(first) == [1, 1]
    queue.put(job("a"))
    assert rows(queue.take()) == [1]


def test_requests_that_wait_for_others_are_prepared() -> None:
    prepared: list[Job] = []
    queue = Queue(16, 0.2, prepared.append)
    for client in ("a", "b"):
        queue.put(job(client))
    first = queue.take()
    assert prepared == []  # nobody else was expected
    assert first is not None
    queue.done(first)
    queue.put(job("a"))
    second = queue.take()
    assert prepared == second


def test_requests_of_many_clients_are_one_batch_with_the_same_bits() -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running:

        def act(seed: int) -> Any:
            with Client(port=running.port) as client:
                return client.get_action(observation(seed, rows=1 + seed % 3), {"seed": seed})[0]

        with ThreadPoolExecutor(8) as threads:
            first = threads.submit(act, 0)
            wait_until(lambda: running.server._unanswered == 1 and not len(running.server._queue))
            others = [threads.submit(act, seed) for seed in range(1, 8)]
            wait_until(lambda: running.server._unanswered == 8)
            policy.gate.set()
            together = [first.result(), *(other.result() for other in others)]
        assert policy.batches == [1, 14]
        for seed, chunk in enumerate(together):
            alone = act(seed)
            assert all(np.array_equal(chunk[key], alone[key]) for key in alone)


def test_a_small_policy_computes_several_batches_at_a_time() -> None:
    policy = MemoryPolicy(nbytes=1000)
    policy.gate.clear()
    with serving(policy) as running:

        def act(seed: int) -> Any:
            with Client(port=running.port) as client:
                return client.get_action(observation(seed), {"seed": seed})[0]

        with ThreadPoolExecutor(5) as threads:
            several = [threads.submit(act, seed) for seed in range(5)]
            wait_until(lambda: running.server._engine._running == 2)
            policy.gate.set()
            chunks = [one.result() for one in several]
        assert sum(policy.batches) == 5
        for seed, chunk in enumerate(chunks):
            alone = act(seed)
            assert all(np.array_equal(chunk[key], alone[key]) for key in alone)


@pytest.mark.parametrize(("text", "message"), [("explode", "RuntimeError: exploded"), ("crash", "crashed")])
def test_a_request_that_fails_does_not_harm_its_batch(text: str, message: str) -> None:
    policy = MemoryPolicy()
    policy.gate.clear()
    with serving(policy) as running:

        def act(number: int) -> Any:
            with Client(port=running.port) as client:
                return client.get_action(observation(text=text if number == 2 else "go"), {"seed": number})[0]

        with ThreadPoolExecutor(4) as threads:
            futures = [threads.submit(act, 0)]
            # The one that fails must not come first, since it would be answered before the others are there.
            wait_until(lambda: running.server._unanswered == 1 and not len(running.server._queue))
            futures += [threads.submit(act, number) for number in range(1, 4)]
            wait_until(lambda: running.server._unanswered == 4)
            policy.gate.set()
            for number in (0, 1, 3):
                assert futures[number].result()["arm"].shape == (1, HORIZON, 2)
            with pytest.raises(ServerError, match=message):
                futures[2].result()


def test_noise_without_a_seed_is_different_each_time() -> None:
    with serving() as running, Client(port=running.port) as client:
        chunks = [client.get_action(observation())[0]["arm"] for _ in range(2)]
        assert not np.array_equal(*chunks)


def test_a_session_continues_its_last_chunk() -> None:
    with serving() as running, Client(port=running.port) as client:
        policy = running.policy
        first, info = client.get_action(observation(), {"session": "robot 1", "executed": 0})
        assert policy.chunkings[-1] is None
        assert (info["session"], info["continued"]) == ("robot 1", False)
        second, info = client.get_action(observation(), {"session": "robot 1", "executed": 5, "frozen": 2})
        assert (info["session"], info["continued"]) == ("robot 1", True)
        *_, chunking = policy.chunkings
        assert (chunking.overlap, chunking.frozen, chunking.ramp_rate) == (HORIZON - 5, 2, 6.0)
        np.testing.assert_array_equal(second["arm"][:, :2], first["arm"][:, 5:7])
        third, _ = client.get_action(observation(), {"session": "robot 1", "executed": 7, "frozen": 4})
        np.testing.assert_array_equal(third["arm"][:, :1], second["arm"][:, 7:])
        assert (
            client.get_action(observation(), {"session": "robot 1", "executed": HORIZON})[1]["continued"]
            is False
        )
        with pytest.raises(ServerError, match="executed: expected the number"):
            client.get_action(observation(), {"session": "robot 1"})
        with pytest.raises(ServerError, match="expected 1 rows, as session 'robot 1' began, got 2"):
            client.get_action(observation(rows=2), {"session": "robot 1", "executed": 1})
        assert client.get_action(observation(), {"session": 2, "executed": 1})[1]["continued"] is False


def test_reset_forgets_a_session_or_those_of_the_client() -> None:
    with serving() as running, Client(port=running.port) as client, Client(port=running.port) as other:

        def continues(name: str, who: Client) -> bool:
            return bool(who.get_action(observation(), {"session": name, "executed": 1})[1]["continued"])

        assert not any(continues(name, who) for name, who in (("a", client), ("b", client), ("c", other)))
        client.reset({"session": "a"})
        assert [continues(name, client) for name in ("a", "b")] == [False, True]
        client.reset()
        assert [continues(name, client) for name in ("a", "b")] == [False, False]
        assert continues("c", other)


def test_sessions_are_bounded_in_number_and_age() -> None:
    now = [0.0]
    sessions = Sessions(2, 10.0, lambda: now[0])
    owner = object()
    first = sessions.use("a", owner)
    sessions.use("b", owner)
    assert sessions.use("a", owner) is first
    sessions.use("c", owner)  # b was used least recently
    assert len(sessions) == 2
    assert sessions.use("a", owner) is first
    now[0] = 10.5
    assert sessions.use("a", owner) is not first
    assert len(sessions) == 1
    assert sessions.reset("nobody", owner) == 0


def test_a_late_answer_does_not_bring_a_session_back() -> None:
    sessions = Sessions(2, 10.0)
    session = sessions.use("a", "client")
    sessions.reset(None, "client")
    session.chunk = Chunk({}, 1, HORIZON)
    assert sessions.use("a", "client").chunk is None


def test_continuing_asks_for_what_was_executed() -> None:
    session = Sessions(1, 1.0).use("a", None)
    assert session.continued(Options(session="a"), 1) is None
    session.chunk = Chunk({}, 1, 8)
    with pytest.raises(InputError, match="reset begins anew"):
        session.continued(Options(session="a"), 1)
    assert session.continued(Options(session="a", executed=8), 1) is None
    found = session.continued(Options(session="a", executed=6, frozen=5), 1)
    assert found is not None
    assert (found[1].overlap, found[1].frozen) == (2, 2)


def test_statistics_count_everything() -> None:
    with serving() as running, requester(running.port) as made:
        for _ in range(3):
            ask(made, get_action())
        ask(made, {"endpoint": "ping"})
        ask(made, b"")
        running.stop()
        last = [line for line in running.log.lines if line["event"] == "statistics"][-1]
    assert last["requests"] == {"get_action": 3, "ping": 1, "unreadable": 1}
    assert last["errors"] == 1
    assert last["batch"] == 1.0
    assert list(last["milliseconds"]) == ["wait", "inputs", "backbone", "head", "total"]
    for part in last["milliseconds"].values():
        assert 0 <= part["p50"] <= part["p99"]
    assert "5 requests, 1 errors; " in line(last)
    assert json.loads(json.dumps(last))["requests"] == last["requests"]
    assert Statistics().summary()["milliseconds"] == {}


def test_json_lines(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as file:
        log = JsonLog(file.fileno())
        log.event("listening", address="tcp://x", policy=1)
        for number in range(MOST_WARNINGS + 5):
            log.event("warning", client="c", message=f"{number}\n")
        log.request(endpoint="ping", error=None)
        log.statistics({"requests": {}, "value": float("nan")})
        log.close()
    lines = [json.loads(text) for text in (tmp_path / "log").read_text().splitlines()]
    assert lines[0]["event"] == "listening"
    assert {"event", "time"} <= lines[0].keys()
    assert MOST_WARNINGS <= sum(one["event"] == "warning" for one in lines) <= MOST_WARNINGS + 5
    assert lines[-1] == {
        "event": "statistics",
        "time": lines[-1]["time"],
        "requests": {},
        "value": None,
        "lost_lines": 0,
    }


def test_a_live_line_is_written_again_below_other_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    with (tmp_path / "log").open("wb") as file:
        log = LiveLog(file.fileno())
        log.statistics(Statistics().summary())
        log.event("warning", client="c", message="dies")
        log.close()
    erase, live = b"\r\x1b[2K", b"0 requests, 0 error"
    expected = erase + live + erase + b"saccade serve: c: dies\n" + live + b"\n"
    assert (tmp_path / "log").read_bytes() == expected


def test_lines_of_text(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as file:
        log = TextLog(file.fileno())
        log.event("listening", address="tcp://x", policy="<policy>")
        log.request(client="c", endpoint="ping", error=None)
        log.request(client="c", endpoint="ping", error="bad\x1b[2J")
        summary = Statistics()
        summary.count("ping", is_error=False)
        for _ in range(2):
            log.statistics(summary.summary())
        log.close()
    assert (tmp_path / "log").read_text().splitlines() == [
        "saccade serve: listening on tcp://x (<policy>)",
        "saccade serve: c: bad\\x1b[2J",
        "saccade serve: 1 requests, 0 errors",
    ]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_loses_lines_only() -> None:
    descriptor = os.open("/dev/full", os.O_WRONLY)
    try:
        writer = Writer(descriptor)
        for _ in range(10):
            writer.write("x")
        writer.close()
        assert writer.lost == 10
    finally:
        os.close(descriptor)


def test_a_log_that_nobody_reads_holds_up_nothing() -> None:
    reader, writing = os.pipe()
    try:
        writer = Writer(writing)
        for _ in range(MOST_LINES + 2000):
            writer.write("x" * 100)
        assert writer.lost > 0
        start = time.monotonic()
        writer.close(0.1)
        assert time.monotonic() - start < 5
    finally:
        os.close(reader)  # ends the thread that writes
        os.close(writing)
