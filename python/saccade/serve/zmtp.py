"""ZMTP 3, the protocol of ZeroMQ's sockets, for the server's side of one connection: bytes in, requests out.

The server speaks it itself, and not through libzmq, because libzmq can neither answer a request that is
larger than the limit nor a program that speaks another protocol, and holds requests in memory that it does
not report. It accepts what REQ and DEALER sockets of ZeroMQ 4 send without encryption (mechanism NULL). The
specification is 23/ZMTP of the ZeroMQ RFCs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

#: A connection begins with a signature (10 bytes), version (2), mechanism (20), role and filler (32).
SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
GREETING = SIGNATURE + b"\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)
READY = b"\x05READY\x0bSocket-Type" + (6).to_bytes(4, "big") + b"ROUTER"

MORE, LONG, COMMAND = 1, 2, 4  # flags of a frame
#: Limits of what is not a request: a command, a part of the address before the request, and their number.
LONGEST_COMMAND = 4096
LONGEST_ADDRESS = 255
MOST_ADDRESSES = 8
#: A larger request is not skipped to its end; the connection is closed.
LONGEST_SKIPPED = 1 << 32
#: An answer up to this size is joined with its frame, so that it is sent by one call.
SHORT_ANSWER = 1 << 16
SOCKET_TYPES = (b"REQ", b"DEALER")


class ProtocolError(Exception):
    """The other side does not speak ZMTP 3, or not as a client does; the connection is of no use.

    Attributes:
        start: The first bytes of a connection that does not begin as ZeroMQ's do, else empty.
    """

    def __init__(self, message: str, start: bytes = b"") -> None:
        super().__init__(message)
        self.start = start


@dataclass(frozen=True)
class Request:
    """A request as it arrived.

    Attributes:
        address: The frames before it, to be sent back before the answer.
        payload: The request; empty if it was skipped.
        size: Its size in bytes.
        is_complete: False if it was skipped, because there was no room for it.
    """

    address: tuple[bytes, ...]
    payload: bytearray
    size: int
    is_complete: bool = True


class Room:
    """Memory for the requests of all connections, from the first byte that is received until the answer.

    Args:
        request: Bytes of one request at most.
        total: Bytes of all requests at most.

    Attributes:
        held: Bytes of all requests now. Whoever answers a request subtracts its size.
    """

    def __init__(self, request: int, total: int) -> None:
        self._request, self._total = request, total
        self.held = 0

    def accepts(self, size: int) -> bool:
        """Whether a request of this size could be held now. Nothing is reserved for it."""
        return size <= self._request and self.held + size <= self._total

    def take(self, size: int) -> bool:
        """Counts received bytes of a request; returns False, and counts nothing, if they are too many."""
        if self.held + size > self._total:
            return False
        self.held += size
        return True


class Peer:
    """What is known of the other side of a connection.

    Give received bytes to :meth:`receive`. What is to be sent is appended to ``output``.

    Args:
        room: Memory for requests. A request for which there is none is skipped.
    """

    def __init__(self, room: Room) -> None:
        self.output = bytearray()
        self._room = room
        self._address: list[bytes] = []
        self._flags = self._size = 0
        self._is_ready = False
        self._expect(len(SIGNATURE), self._signature)

    @property
    def missing(self) -> int:
        """Bytes until the end of the part of a frame that is being received."""
        return self._missing

    @property
    def is_between_requests(self) -> bool:
        """Whether the next byte begins a request."""
        return self._is_ready and self._next == self._frame and not self._buffer and not self._address

    def receive(self, data: memoryview) -> Iterator[Request]:
        """Takes received bytes, and yields the requests that they complete.

        Memory for a request grows with what has arrived of it.

        Args:
            data: The bytes, which may end anywhere. They are copied.

        Raises:
            ProtocolError: See there. The requests before it have been yielded.
        """
        position = 0
        while position < len(data):
            piece = data[position : position + self._missing]
            position += len(piece)
            self._missing -= len(piece)
            if self._next == self._request and not self._room.take(len(piece)):
                self._skip()
            elif not self._skips:
                self._buffer += piece
            if self._next == self._signature and self._buffer[:1] != SIGNATURE[:1]:
                raise ProtocolError("no ZeroMQ client", bytes(self._buffer))
            if not self._missing:
                found = self._next(self._buffer)
                if found is not None:
                    yield found

    def close(self) -> None:
        """Forgets what has arrived of a request."""
        if self._next == self._request:
            self._room.held -= len(self._buffer)
        self._address = []
        self.output.clear()
        self._expect(1, self._frame)

    def _skip(self) -> None:
        """Forgets what has arrived of a request, and skips the rest of it."""
        self._room.held -= len(self._buffer)
        self._expect(self._missing, self._skipped_request, skips=True)

    def _expect(self, size: int, then: Callable[[bytearray], Request | None], *, skips: bool = False) -> None:
        self._missing, self._next, self._skips = size, then, skips
        self._buffer = bytearray()

    def _signature(self, data: bytearray) -> None:
        if data[9] & 1 == 0:
            raise ProtocolError("expected ZMTP 3, got an older protocol of ZeroMQ 2")
        self.output += GREETING
        self._expect(1, self._version)

    def _version(self, data: bytearray) -> None:
        if data[0] < 3:
            raise ProtocolError(f"expected ZMTP 3, got version {data[0]}")
        self._expect(len(GREETING) - len(SIGNATURE) - 1, self._mechanism)

    def _mechanism(self, data: bytearray) -> None:
        name = bytes(data[1:21]).rstrip(b"\0")
        if name != b"NULL":
            raise ProtocolError(f"expected no encryption (NULL), got mechanism {name!r}")
        self.output += _frame(READY, COMMAND)
        self._expect(1, self._frame)

    def _frame(self, data: bytearray) -> None:
        self._flags = data[0]
        if self._flags & ~(MORE | LONG | COMMAND) or self._flags & (MORE | COMMAND) == MORE | COMMAND:
            raise ProtocolError(f"expected a frame, got flags {self._flags:#x}")
        self._expect(8 if self._flags & LONG else 1, self._length)

    def _length(self, data: bytearray) -> Request | None:
        size = int.from_bytes(data, "big")
        if not (self._is_ready or self._flags & COMMAND):
            raise ProtocolError("expected READY before the first request")
        if self._flags & COMMAND:
            if size > LONGEST_COMMAND:
                raise ProtocolError(f"expected a command of at most {LONGEST_COMMAND} bytes, got {size}")
            return self._body(size, self._command)
        if self._flags & MORE:
            if size > LONGEST_ADDRESS or len(self._address) == MOST_ADDRESSES:
                raise ProtocolError(f"expected a request in one frame, got a first frame of {size} bytes")
            return self._body(size, self._part)
        self._size = size
        if not size or self._room.accepts(size):
            return self._body(size, self._request)
        if size > LONGEST_SKIPPED:
            raise ProtocolError(f"expected a request of at most {LONGEST_SKIPPED} bytes, got {size}")
        self._expect(size, self._skipped_request, skips=True)
        return None

    def _body(self, size: int, then: Callable[[bytearray], Request | None]) -> Request | None:
        self._expect(size, then)
        return None if size else then(bytearray())

    def _command(self, data: bytearray) -> None:
        name, body = bytes(data[1 : 1 + data[0]]) if data else b"", data[1 + data[0] if data else 0 :]
        if name == b"READY":
            kind = _property(body, b"socket-type")
            if kind not in SOCKET_TYPES:
                raise ProtocolError(f"expected a REQ socket, got {kind.decode('ascii', 'replace')!r:.40}")
            self._is_ready = True
        elif name == b"PING":  # a time to live, and a context to send back
            self.output += _frame(b"\x04PONG" + bytes(body[2:18]), COMMAND)
        elif name == b"ERROR":
            raise ProtocolError("the client reported an error")
        self._expect(1, self._frame)

    def _part(self, data: bytearray) -> None:
        self._address.append(bytes(data))
        self._expect(1, self._frame)

    def _request(self, data: bytearray) -> Request:
        return self._found(Request(tuple(self._address), data, len(data)))

    def _skipped_request(self, data: bytearray) -> Request:
        return self._found(Request(tuple(self._address), bytearray(), self._size, is_complete=False))

    def _found(self, request: Request) -> Request:
        self._address = []
        self._expect(1, self._frame)
        return request


def message(address: Sequence[bytes], payload: bytes) -> list[bytes]:
    """The pieces to send for an answer; joined, they are its frames.

    Args:
        address: The address of the request.
        payload: The answer.
    """
    start = b"".join(_frame(part, MORE) for part in address) + _header(len(payload), 0)
    return [start + payload] if len(payload) <= SHORT_ANSWER else [start, payload]


def _frame(body: bytes, flags: int) -> bytes:
    return _header(len(body), flags) + body


def _header(size: int, flags: int) -> bytes:
    if size < 256:
        return bytes([flags, size])
    return bytes([flags | LONG]) + size.to_bytes(8, "big")


def _property(body: bytearray, wanted: bytes) -> bytes:
    """A property of a READY command: each is a length (1 byte), a name, a length (4 bytes) and a value."""
    position = 0
    while position < len(body):
        end = position + 1 + body[position]
        name = bytes(body[position + 1 : end])
        start = end + 4
        position = start + int.from_bytes(body[end:start], "big")
        if name.lower() == wanted:
            return bytes(body[start:position])
    return b""
