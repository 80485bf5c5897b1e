"""ZMTP as the server reads it: in pieces of any size, and from clients that send anything."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from saccade.serve.zmtp import COMMAND, GREETING, MORE, Peer, ProtocolError, Request, Room, message

READY = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
PARTS = st.lists(st.binary(max_size=255), max_size=4)


def feed(peer: Peer, data: bytes, sizes: Sequence[int]) -> list[Request]:
    """Gives a peer bytes in pieces of at most these sizes, in turn."""
    found: list[Request] = []
    position = turn = 0
    while position < len(data):
        count = sizes[turn % len(sizes)]
        found += peer.receive(memoryview(data)[position : position + count])
        position += count
        turn += 1
    return found


@given(
    st.lists(st.tuples(PARTS, st.binary(max_size=2000)), max_size=6),
    st.lists(st.integers(1, 700), min_size=1, max_size=5),
)
def test_requests_arrive_in_pieces_of_any_size(
    requests: list[tuple[list[bytes], bytes]], sizes: list[int]
) -> None:
    most = 1000
    peer = Peer(Room(most, 1 << 30))
    data = GREETING + READY + b"".join(b"".join(message(*request)) for request in requests)
    found = feed(peer, data, sizes)
    assert bytes(peer.output).startswith(GREETING)
    assert peer.is_between_requests
    for (address, payload), request in zip(requests, found, strict=True):
        assert request.address == tuple(address)
        assert request.size == len(payload)
        assert request.is_complete == (len(payload) <= most)
        assert bytes(request.payload) == (payload if request.is_complete else b"")


@given(st.binary(max_size=300), st.integers(0, 3), st.integers(1, 50))
def test_anything_is_a_request_or_a_protocol_error(data: bytes, kept: int, size: int) -> None:
    room = Room(1_000_000, 1_000_000)
    peer = Peer(room)
    start = (b"", GREETING[:20], GREETING, GREETING + READY)[kept]
    with contextlib.suppress(ProtocolError):
        feed(peer, start + data, [size])
    assert room.held < 1_000_000


def test_memory_grows_with_what_arrives() -> None:
    room = Room(1 << 30, 1 << 30)
    peer = Peer(room)
    feed(peer, GREETING + READY + b"\x02" + (60_000_000).to_bytes(8, "big") + bytes(1000), [4096])
    assert room.held == 1000
    feed(peer, bytes(3_000_000), [1 << 16])
    assert room.held == 3_001_000
    assert 3_000_000 < sys.getsizeof(peer._buffer) < 8_000_000
    peer.close()
    assert (room.held, peer._buffer) == (0, bytearray())


def test_a_request_that_there_is_no_room_for_is_skipped_while_it_arrives() -> None:
    room = Room(1000, 1500)
    first, second = Peer(room), Peer(room)
    length = b"\x02" + (1000).to_bytes(8, "big")
    for peer in (first, second):
        feed(peer, GREETING + READY + length, [4096])  # both could be held when they began
    for peer in (first, second):
        feed(peer, bytes(700), [4096])
    assert room.held == 1400
    assert feed(second, bytes(200), [4096]) == []
    assert room.held == 700
    (skipped,) = feed(second, bytes(100) + b"\x00\x02hi", [4096])[:1]
    assert (skipped.size, skipped.is_complete, len(skipped.payload)) == (1000, False, 0)
    (held,) = feed(first, bytes(300), [4096])
    assert (held.size, held.is_complete) == (1000, True)
    assert room.held == 1002  # until they are answered


def test_a_ping_gets_its_context_back() -> None:
    peer = Peer(Room(1 << 30, 1 << 30))
    feed(peer, GREETING + READY, [1000])
    peer.output.clear()
    body = b"\x04PING\x00\x64context"
    feed(peer, bytes([COMMAND, len(body)]) + body, [3])
    assert bytes(peer.output) == b"\x04\x0c\x04PONGcontext"


def test_the_frames_of_an_answer() -> None:
    assert b"".join(message([b"id", b""], b"x")) == b"\x01\x02id\x01\x00\x00\x01x"
    long = b"".join(message([], bytes(300)))
    assert long[:9] == b"\x02" + (300).to_bytes(8, "big")
    assert MORE == 1
