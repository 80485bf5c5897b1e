"""Clients that misbehave: garbage, half messages, floods, silence. Each costs its own connection at most."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import sys
import threading
from typing import Any

import pytest
import zmq

from saccade.serve import Limits, Server
from saccade.serve.transport import bind
from tests.helpers.serve_cases import (
    GREETING,
    PONG,
    READY,
    MemoryLog,
    MemoryPolicy,
    Running,
    ask,
    connect,
    get_action,
    packed,
    ping,
    requester,
    serving,
    shake_hands,
    wait_until,
)

HALF = b"\x02" + struct.pack(">Q", 1000) + bytes(500)


def wait_for_warning(running: Running, text: str) -> None:
    wait_until(lambda: any(text in warning for warning in running.log.warnings()))


def wait_for_end(made: socket.socket) -> None:
    """Reads until the server closes the connection."""
    made.settimeout(60)
    with contextlib.suppress(ConnectionResetError):
        while made.recv(4096):
            pass


def test_requests_that_come_with_the_greeting_are_answered() -> None:
    data = packed({"endpoint": "ping"})
    frames = b"\x01\x00\x00" + bytes([len(data)]) + data
    expected = b"\x01\x00\x00" + bytes([len(packed(PONG))]) + packed(PONG)
    with serving() as running, shake_hands(running.port, 2 * frames) as made:
        made.settimeout(60)
        received = b""
        while received.count(expected) < 2:
            piece = made.recv(1 << 16)
            assert piece, received
            received += piece


def test_oversized_requests_cost_their_connection_and_are_logged() -> None:
    with serving(limits=Limits(message_bytes=100_000)) as running, requester(running.port) as other:
        assert ask(other, {"endpoint": "ping"}) == PONG
        with requester(running.port) as made:
            made.send(bytes(30_000_000))
            wait_for_warning(running, "larger than --max-message-mb")
        assert ask(other, packed({"endpoint": "ping", "pad": "x" * 99_000})) == PONG
        assert len(running.log.warnings()) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not count what a socket received")
def test_a_message_of_endless_frames_costs_its_connection() -> None:
    frame = b"\x03" + struct.pack(">Q", 90_000) + bytes(90_000)  # more follow
    with serving(limits=Limits(message_bytes=100_000)) as running, requester(running.port) as other:
        # The system of the client may wait in vain for the closed end to read on.
        with shake_hands(running.port) as made, contextlib.suppress(ConnectionError, TimeoutError):
            made.settimeout(2)
            for _ in range(10_000):
                made.sendall(frame)
        wait_for_warning(running, "in several frames")
        # The requests of one connection may be more than this together.
        for _ in range(200):
            assert ask(other, packed({"endpoint": "ping", "pad": "x" * 99_000})) == PONG


def test_clients_that_leave_are_no_problem() -> None:
    with serving() as running:
        for _ in range(5):
            assert ping(running.port) == PONG
        assert running.log.warnings() == []


def test_heartbeats_are_answered_and_idle_clients_stay() -> None:
    limits = Limits(stall_seconds=0.6)
    with serving(limits=limits) as running, zmq.Context() as context, context.socket(zmq.REQ) as made:
        made.setsockopt(zmq.LINGER, 0)
        made.setsockopt(zmq.HEARTBEAT_IVL, 300)
        made.setsockopt(zmq.HEARTBEAT_TIMEOUT, 30_000)
        monitor = made.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        made.connect(f"tcp://127.0.0.1:{running.port}")
        assert ask(made, {"endpoint": "ping"}) == PONG
        assert not monitor.poll(2000)
        assert ask(made, {"endpoint": "ping"}) == PONG
        made.disable_monitor()


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + bytes(100),
        b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n" + bytes(100),
        b"\x16\x03\x01\x02\x00\x01\x00\x01",  # TLS
        b"\x01\x00",  # ZMTP 1
        b"\xff" * 64,
        b"\xff\x00",  # nothing more
        GREETING,
        GREETING[:10] + b"\x01\x05",  # ZMTP 2
        GREETING[:12] + b"CURVE".ljust(20, b"\0") + bytes(32),
        GREETING + b"\x00\x01x",  # a message before READY
        GREETING + READY.replace(b"REQ", b"SUB"),
        GREETING + b"\x06" + struct.pack(">Q", 1 << 20),  # a long command
        GREETING + b"\x04\x07\x05ERROR\x00",
    ],
    ids=range(13),
)
def test_garbage_and_silence_close_their_own_connection(data: bytes) -> None:
    with serving(limits=Limits(stall_seconds=1.0)) as running, requester(running.port) as other:
        assert ask(other, {"endpoint": "ping"}) == PONG
        with connect(running.port, data) as made:
            wait_for_end(made)
            wait_until(running.log.warnings)
        assert ask(other, {"endpoint": "ping"}) == PONG


@pytest.mark.parametrize(
    "data",
    [
        b"",  # answers no heartbeats
        b"\x02" + struct.pack(">Q", (1 << 64) - 1),
        b"\x01\x01a" * 20,  # a message that does not end
        b"\xf0\x01x",  # flags that do not exist
        HALF,
    ],
    ids=range(5),
)
def test_garbage_after_the_handshake_closes_its_own_connection(data: bytes) -> None:
    with serving(limits=Limits(stall_seconds=1.0)) as running, requester(running.port) as other:
        assert ask(other, {"endpoint": "ping"}) == PONG
        with shake_hands(running.port, data) as made:
            wait_for_end(made)
            wait_until(running.log.warnings)
        assert ask(other, {"endpoint": "ping"}) == PONG


def test_a_request_that_trickles_in_costs_its_connection() -> None:
    with serving(limits=Limits(stall_seconds=1.0)) as running:
        with shake_hands(running.port, HALF) as made:
            made.settimeout(0.05)
            ended = False
            while not ended:
                with contextlib.suppress(TimeoutError):
                    try:
                        made.sendall(b"x")
                        ended = not made.recv(4096)
                    except (BrokenPipeError, ConnectionResetError):
                        ended = True
        assert ping(running.port) == PONG


@pytest.mark.parametrize("seconds", [0.1, 86_399.0])
def test_limits_of_the_times(seconds: float) -> None:
    with serving(limits=Limits(stall_seconds=seconds)) as running:
        assert ping(running.port) == PONG


def test_many_idle_connections() -> None:
    with serving(limits=Limits(stall_seconds=2.0)) as running, contextlib.ExitStack() as stack:
        idle = [stack.enter_context(connect(running.port)) for _ in range(100)]
        assert ping(running.port) == PONG
        for made in idle:
            wait_for_end(made)


def test_small_requests_of_one_client_leave_others_their_turn() -> None:
    data = packed({"endpoint": "ping"})
    frames = (b"\x01\x00\x00" + bytes([len(data)]) + data) * 5_000
    with serving() as running, shake_hands(running.port) as made:
        done = threading.Event()

        def read() -> None:
            count = 0
            while count < 5_000 * (4 + len(packed(PONG))):
                count += len(made.recv(1 << 16))
            done.set()

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        made.settimeout(60)
        made.sendall(frames)
        assert ping(running.port) == PONG
        assert done.wait(60)
        assert running.log.warnings() == []


def test_a_client_that_does_not_read_loses_answers() -> None:
    with serving() as running, socket.socket() as made:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # as small as it gets
        made.settimeout(60)
        made.connect(("127.0.0.1", running.port))
        made.sendall(GREETING + READY)
        received = b""
        while b"READY" not in received:
            received += made.recv(100)
        request = packed({"endpoint": "get_modality_config"})
        frame = b"\x00" + bytes([len(request)]) + request

        def flood() -> None:
            with contextlib.suppress(OSError):  # the test is over
                while True:
                    made.sendall(frame * 1000)

        threading.Thread(target=flood, daemon=True).start()
        wait_for_warning(running, "does not read its answers")
        assert ping(running.port) == PONG
        made.shutdown(socket.SHUT_RDWR)


def test_more_clients_than_allowed_are_closed() -> None:
    with serving(limits=Limits(clients=2)) as running, requester(running.port) as first:
        assert ask(first, {"endpoint": "ping"}) == PONG
        with requester(running.port) as second:
            assert ask(second, {"endpoint": "ping"}) == PONG
            with connect(running.port) as third:
                wait_for_end(third)
            wait_for_warning(running, "refused: 2 clients are connected")
            assert ask(first, {"endpoint": "ping"}) == PONG
        assert ping(running.port) == PONG


def test_no_files_left_for_clients() -> None:
    resource = pytest.importorskip("resource")
    with serving() as running, requester(running.port, seconds=60) as before:
        assert ask(before, {"endpoint": "ping"}) == PONG
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        spare = os.dup(0)  # the lowest free number
        os.close(spare)
        with socket.socket() as late:
            resource.setrlimit(resource.RLIMIT_NOFILE, (spare + 1, hard))
            try:
                late.connect(("127.0.0.1", running.port))
                assert ask(before, {"endpoint": "ping"}) == PONG
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            late.sendall(GREETING + READY)
            late.settimeout(60)
            assert late.recv(1) == b"\xff"  # it was accepted later


def test_ports_in_use_are_named() -> None:
    with serving() as running, pytest.raises(OSError, match=f"127.0.0.1:{running.port}"):
        bind("127.0.0.1", running.port)
    for host, port in (("no.such.host.invalid", 5555), ("127.0.0.1", 70_000), ("\ud800", 1)):
        with pytest.raises(OSError, match=f"{port}"):
            bind(host, port)


def test_a_port_that_was_taken_meanwhile_is_named() -> None:
    with bind("127.0.0.1", 0) as first:
        address: Any = first.getsockname()
        with socket.socket() as second:
            second.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            second.bind(address)
            second.listen()
            server = Server(MemoryPolicy(), first, MemoryLog())  # type: ignore[arg-type]
            with pytest.raises(OSError, match=f"127.0.0.1:{address[1]}"):
                server.run()


def test_stopping_while_clients_do_not_read_their_answers() -> None:
    with serving() as running, shake_hands(running.port) as made:
        request = packed(get_action())
        made.sendall((b"\x01\x00\x02" + struct.pack(">Q", len(request)) + request) * 3)
        wait_until(lambda: len(running.log.requests()) == 3)
        assert running.stop("test") == "test"
