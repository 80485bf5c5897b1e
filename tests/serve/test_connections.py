"""The connections of a server, driven by hand: turns, memory, and clients that do not read."""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from saccade.serve import zmtp
from saccade.serve.connections import Connection, Connections, bind
from saccade.serve.limits import Limits
from tests.helpers.serve_cases import wait_until

READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
PING = b"\x04\x17\x04PING\x00\x00" + bytes(16)


@dataclass
class Driven:
    """Connections, the requests that arrived, and the problems that they reported."""

    limits: Limits = field(default_factory=Limits)
    requests: list[tuple[Connection, zmtp.Request]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        listener = bind("127.0.0.1", 0)
        self.port = listener.getsockname()[1]
        self.connections = Connections(
            listener,
            self.limits,
            lambda connection, request: self.requests.append((connection, request)),
            lambda client, message: self.problems.append(message),
        )
        self.connections.listen()

    @contextlib.contextmanager
    def client(self) -> Iterator[tuple[socket.socket, Connection]]:
        """A client, and the connection to it, on which nothing else happens than greetings."""
        before = set(self.connections._clients)
        with socket.create_connection(("127.0.0.1", self.port), timeout=10) as made:
            made.sendall(zmtp.GREETING + READY)
            wait_until(lambda: self.poll(before))
            (connection,) = self.connections._clients - before
            yield made, connection

    def poll(self, before: set[Connection]) -> bool:
        self.connections.poll(0.01)
        return any(one.peer.is_between_requests for one in self.connections._clients - before)

    def received(self, condition: object) -> None:
        """Polls until a condition holds."""

        def holds() -> bool:
            self.connections.poll(0.01)
            return bool(condition())  # type: ignore[operator]

        wait_until(holds)


@pytest.fixture
def driven() -> Iterator[Driven]:
    made = Driven()
    yield made
    made.connections.close()


def request(size: int, sent: int | None = None) -> bytes:
    """A request, or the beginning of it."""
    return b"\x02" + struct.pack(">Q", size) + bytes(size if sent is None else sent)


def test_many_small_requests_leave_others_their_turn(driven: Driven) -> None:
    with driven.client() as (made, _), driven.client() as (other, second):
        made.sendall(b"\x00\x00" * 20_000)
        other.sendall(request(10))
        turns = []
        while len(driven.requests) < 20_001:
            before = len(driven.requests)
            driven.connections.poll(10)
            turns.append(len(driven.requests) - before)
        assert max(turns) <= 513
        assert [connection for connection, _ in driven.requests].index(second) < 2000


def test_large_requests_are_received_in_large_pieces(driven: Driven) -> None:
    with driven.client() as (made, connection):
        made.sendall(request(1 << 20, sent=100))
        driven.received(lambda: driven.connections.held == 100)
        assert connection.peer.missing == (1 << 20) - 100
        made.setblocking(False)
        sent = made.send(bytes((1 << 20) - 100))
        assert sent > 1 << 14
        before = driven.connections.held
        driven.connections.poll(10)
        assert driven.connections.held - before > 1 << 13


@pytest.mark.parametrize("closes", ["the client", "the server"])
def test_a_closed_connection_keeps_nothing_of_a_request(driven: Driven, closes: str) -> None:
    with driven.client() as (made, connection):
        made.sendall(request(3_000_000, sent=1_000_000))
        driven.received(lambda: driven.connections.held == 1_000_000)
        if closes == "the client":
            made.close()
            driven.received(lambda: not len(driven.connections))
        else:
            driven.connections.close()
    assert driven.connections.held == 0
    assert sys.getsizeof(connection.peer._buffer) < 1000


def test_nothing_is_read_of_a_connection_that_its_request_closed() -> None:
    driven = Driven()

    def close(connection: Connection, request: zmtp.Request) -> None:
        driven.requests.append((connection, request))
        driven.connections._forget(connection)

    driven.connections._on_request = close
    with driven.client() as (made, _):
        made.sendall(b"\x00\x00" + request(1000, sent=10))
        driven.received(lambda: not len(driven.connections))
    assert len(driven.requests) == 1
    assert driven.connections.held == 0
    driven.connections.close()


def test_a_request_is_not_counted_whose_client_was_lost_before_it_was_answered(
    driven: Driven, monkeypatch: pytest.MonkeyPatch
) -> None:
    with driven.client() as (made, _):
        monkeypatch.setattr(driven.connections, "_send_output", driven.connections._forget)  # as if it fails
        made.sendall(request(1000))
        driven.received(lambda: not len(driven.connections))
    assert (driven.requests, driven.connections.held) == ([], 0)


def test_heartbeats_of_a_client_that_does_not_read(driven: Driven, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("saccade.serve.connections.MOST_UNREAD", 10_000)
    with driven.client() as (made, connection):
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        made.setblocking(False)
        most = 0
        for _ in range(50_000):
            with contextlib.suppress(BlockingIOError):
                made.send(PING * 40)
            driven.connections.poll(0)
            most = max(most, connection.num_unsent)
            if not len(driven.connections):
                break
        assert driven.problems == ["does not read its answers"]
        assert most < 20_000


def test_announced_requests_do_not_fill_the_memory_when_they_arrive() -> None:
    driven = Driven(Limits(message_bytes=600_000, waiting_bytes=1_000_000))
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(driven.client()) for _ in range(4)]
        for made, _ in clients:
            made.sendall(request(600_000, sent=1000))  # each could be held alone
        driven.received(lambda: driven.connections.held == 4000)
        for made, _ in clients:
            made.sendall(bytes(200_000))
        left = [399_000] * 4
        while any(left):
            for number, (made, _) in enumerate(clients):
                piece = min(left[number], 20_000)
                made.sendall(bytes(piece))
                left[number] -= piece
            driven.connections.poll(0.01)
            assert driven.connections.held <= 1_000_000
        driven.received(lambda: len(driven.requests) == 4)
        complete = [request.is_complete for _, request in driven.requests]
        assert 1 <= sum(complete) < 4
        assert {request.size for _, request in driven.requests} == {600_000}
        assert driven.connections.held == 600_000 * sum(complete)
        for connection, one in driven.requests:
            driven.connections.send(connection, one, b"")
        assert driven.connections.held == 0
    driven.connections.close()
