"""The connections of a server: sockets, what arrives on them, and what waits to be sent, in one thread."""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable

from saccade.errors import printable
from saccade.serve import zmtp
from saccade.serve.limits import Limits

#: Answers that a client does not read; more closes its connection.
MOST_UNREAD = 8_000_000
#: Time that a program of another protocol gets to read why it is refused.
FAREWELL_SECONDS = 2.0
#: Seconds between two checks for connections that have stalled.
CHECK_SECONDS = 0.5
#: Bytes that are received by one call at most, and those that are received at least if they are there. Small
#: requests are answered one by one, so a call receives few of them before others have their turn.
RECEIVED_BYTES = 1 << 18
RECEIVED_AT_LEAST = 1 << 10
OUT_OF_FILES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)

HTTP = """\
HTTP/1.1 400 Bad Request\r
Content-Type: text/plain; charset=utf-8\r
Connection: close\r
\r
This port serves a robot policy over ZeroMQ (ZMTP 3, REQ), not over HTTP.
"""


class Connection:
    """One client.

    Attributes:
        name: Its address and port, for messages.
    """

    def __init__(self, connected: socket.socket, name: str, room: zmtp.Room) -> None:
        self.socket = connected
        self.name = name
        self.peer = zmtp.Peer(room)
        self.unsent: deque[memoryview] = deque()
        self.num_unsent = 0
        self.progress = time.monotonic()
        self.writes = False  # whether the selector waits until more can be sent
        self.farewell: float | None = None  # when it is closed at the latest, once it was refused

    @property
    def is_open(self) -> bool:
        """Whether answers can be sent."""
        return self.socket.fileno() >= 0 and self.farewell is None

    @property
    def is_stalled(self) -> bool:
        """Whether the other side must do something before anything else happens."""
        return bool(self.num_unsent) or not self.peer.is_between_requests


class Connections:
    """All clients of a server, and the socket that they connect to.

    Args:
        listener: The socket that they connect to, from :func:`bind`.
        limits: See there.
        on_request: Called with each request that has arrived. Every one is to be answered by :meth:`send`.
        on_problem: Called with a client and what is wrong with it.
    """

    def __init__(
        self,
        listener: socket.socket,
        limits: Limits,
        on_request: Callable[[Connection, zmtp.Request], None],
        on_problem: Callable[[str, str], None],
    ) -> None:
        self._limits = limits
        self._on_request, self._on_problem = on_request, on_problem
        self._room = zmtp.Room(limits.message_bytes, limits.waiting_bytes)
        self._selector = selectors.DefaultSelector()
        self._listener: socket.socket | None = listener
        self._clients: set[Connection] = set()
        self._paused_until = self._checked = 0.0
        self._received = memoryview(bytearray(RECEIVED_BYTES))
        self._waker, self._woken = socket.socketpair()
        for end in (self._waker, self._woken):
            end.setblocking(False)
        self._selector.register(self._woken, selectors.EVENT_READ)

    def __len__(self) -> int:
        return len(self._clients)

    def listen(self) -> None:
        """Accepts clients from now on.

        Raises:
            OSError: Another program took the address meanwhile; names it.
        """
        assert self._listener is not None, "it is closed"
        try:
            self._listener.listen(128)
        except OSError as error:
            raise _named(error, address_of(self._listener)) from None
        self._selector.register(self._listener, selectors.EVENT_READ)

    def refuse_new(self) -> None:
        """Accepts no more clients; the port is free for another server."""
        self._close_listener()

    def wake(self) -> None:
        """Ends :meth:`poll`. May be called by any thread, and by signal handlers."""
        with contextlib.suppress(BlockingIOError, OSError):  # it is awake, or closed
            self._waker.send(b"\0")

    def poll(self, timeout: float) -> None:
        """Receives and sends what there is, and waits for it if there is nothing.

        Args:
            timeout: The longest time to wait, in seconds.
        """
        for key, events in self._selector.select(timeout):
            if key.fileobj is self._woken:
                with contextlib.suppress(BlockingIOError):
                    while self._woken.recv(4096):
                        pass
            elif key.fileobj is self._listener:
                self._accept()
            else:
                connection: Connection = key.data
                if events & selectors.EVENT_WRITE and connection in self._clients:
                    self._write(connection)
                if events & selectors.EVENT_READ and connection in self._clients:
                    self._read(connection)
        now = time.monotonic()
        if now - self._checked >= CHECK_SECONDS:
            self._checked = now
            self._check_connections(now)

    def send(self, connection: Connection, request: zmtp.Request, payload: bytes) -> None:
        """Answers a request; nothing is sent if its client is gone.

        Args:
            connection: The client.
            request: The request, which need not have its payload any more.
            payload: The answer.
        """
        self._release(request)
        if connection not in self._clients or not connection.is_open:
            return
        if not connection.num_unsent:
            connection.progress = time.monotonic()
        for piece in zmtp.message(request.address, payload):
            self._append(connection, piece)
        self._write(connection)

    @property
    def held(self) -> int:
        """Bytes of all requests that are being received or not yet answered."""
        return self._room.held

    @property
    def num_unsent(self) -> int:
        """Bytes of answers that wait to be sent."""
        return sum(connection.num_unsent for connection in self._clients)

    def close(self) -> None:
        """Closes everything."""
        self._close_listener()
        for connection in list(self._clients):
            self._forget(connection)
        self._selector.close()
        self._waker.close()
        self._woken.close()

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            connected, address = self._listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:
            if error.errno not in OUT_OF_FILES:
                raise
            self._selector.unregister(self._listener)
            self._paused_until = time.monotonic() + 1.0
            self._on_problem("server", f"accepts no client for a second: {error.strerror}")
            return
        name = f"{address[0]}:{address[1]}"
        if len(self._clients) >= self._limits.clients:
            connected.close()
            self._on_problem(name, f"refused: {self._limits.clients} clients are connected")
            return
        connected.setblocking(False)
        with contextlib.suppress(OSError):
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection = Connection(connected, name, self._room)
        self._clients.add(connection)
        self._selector.register(connected, selectors.EVENT_READ, connection)

    def _read(self, connection: Connection) -> None:
        try:
            if connection.farewell is not None:
                if not connection.socket.recv(1 << 16):
                    self._forget(connection)
                return
            wanted = max(connection.peer.missing, RECEIVED_AT_LEAST)
            count = connection.socket.recv_into(self._received[:wanted])
        except BlockingIOError:
            return
        except OSError:  # reset, timed out: the client died
            self._lost(connection)
            return
        connection.progress = time.monotonic()
        if not count:
            self._lost(connection)
            return
        try:
            for request in connection.peer.receive(self._received[:count]):
                self._send_output(connection)
                if connection not in self._clients:
                    self._release(request)
                    return
                self._on_request(connection, request)
                if connection not in self._clients:
                    return
            self._send_output(connection)
        except zmtp.ProtocolError as error:
            self._refuse(connection, error)

    def _release(self, request: zmtp.Request) -> None:
        """Counts a request no more."""
        if request.is_complete:
            self._room.held -= request.size

    def _send_output(self, connection: Connection) -> None:
        """Sends what the protocol answers by itself, which comes before the answer to a request."""
        if connection.peer.output and connection in self._clients:
            self._append(connection, bytes(connection.peer.output))
            connection.peer.output.clear()
            self._write(connection)

    def _write(self, connection: Connection) -> None:
        try:
            while connection.unsent:
                piece = connection.unsent[0]
                count = connection.socket.send(piece)
                connection.progress = time.monotonic()
                connection.num_unsent -= count
                if count == len(piece):
                    connection.unsent.popleft()
                else:
                    connection.unsent[0] = piece[count:]
        except BlockingIOError:
            if connection.num_unsent > MOST_UNREAD:
                self._drop(connection, "does not read its answers")
                return
        except OSError:
            self._lost(connection)
            return
        if connection.farewell is not None and not connection.unsent:
            with contextlib.suppress(OSError):
                connection.socket.shutdown(socket.SHUT_WR)
        if connection.writes != bool(connection.unsent):
            connection.writes = bool(connection.unsent)
            writes = selectors.EVENT_WRITE if connection.writes else 0
            self._selector.modify(connection.socket, selectors.EVENT_READ | writes, connection)

    def _append(self, connection: Connection, piece: bytes) -> None:
        connection.unsent.append(memoryview(piece))
        connection.num_unsent += len(piece)

    def _refuse(self, connection: Connection, error: zmtp.ProtocolError) -> None:
        """Says why, if that can be read, and closes the connection once it has been."""
        start = printable(error.start.decode("latin-1"))
        self._on_problem(connection.name, f"{error}{f': it began with {start!r}' if start else ''}")
        connection.farewell = time.monotonic() + FAREWELL_SECONDS
        if error.start[:1].isalpha():
            self._append(connection, HTTP.encode())
        self._write(connection)

    def _check_connections(self, now: float) -> None:
        if self._paused_until and now >= self._paused_until and self._listener is not None:
            self._paused_until = 0.0
            self._selector.register(self._listener, selectors.EVENT_READ)
        for connection in list(self._clients):
            if connection.farewell is not None:
                if now > connection.farewell:
                    self._forget(connection)
            elif connection.is_stalled and now - connection.progress > self._limits.stall_seconds:
                self._drop(connection, f"stalled for {self._limits.stall_seconds:g} s")

    def _lost(self, connection: Connection) -> None:
        if connection.farewell is None and not connection.peer.is_between_requests:
            self._on_problem(connection.name, "closed the connection in the middle of a request")
        self._forget(connection)

    def _drop(self, connection: Connection, why: str) -> None:
        self._on_problem(connection.name, why)
        self._forget(connection)

    def _forget(self, connection: Connection) -> None:
        if connection in self._clients:
            self._clients.discard(connection)
            self._selector.unregister(connection.socket)
            connection.socket.close()
            connection.unsent.clear()
            connection.num_unsent = 0
            # A session may keep the connection, and a part of a request may be large.
            connection.peer.close()

    def _close_listener(self) -> None:
        if self._listener is not None:
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = None


def bind(host: str, port: int) -> socket.socket:
    """Takes an address for a server, which does not accept clients yet.

    Args:
        host: Name or address of this machine; ``*`` for all addresses.
        port: 0 takes one that is free.

    Raises:
        OSError: It cannot be taken; names it.
    """
    taken = None
    try:
        if not 0 <= port <= 0xFFFF:  # which would be cut to 16 bits
            raise OverflowError("expected a port of 0 to 65535")
        given = socket.getaddrinfo(
            None if host == "*" else host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        family, kind, protocol, _, address = given[0]
        taken = socket.socket(family, kind, protocol)
        # A restarted server need not wait until the connections of the last one are forgotten.
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        taken.setblocking(False)
        taken.bind(address)
    except (OSError, UnicodeError, OverflowError) as error:
        if taken is not None:
            taken.close()
        raise _named(error, f"{host}:{port}") from None
    return taken


def address_of(listener: socket.socket) -> str:
    """The address of a socket, ``tcp://host:port``."""
    host, port = listener.getsockname()[:2]
    return f"tcp://[{host}]:{port}" if listener.family == socket.AF_INET6 else f"tcp://{host}:{port}"


def _named(error: Exception, where: str) -> OSError:
    """An error about an address, with its name."""
    if isinstance(error, OSError) and error.errno is not None:
        return OSError(
            error.errno, os.strerror(error.errno) if error.errno > 0 else str(error.strerror), where
        )
    return OSError(errno.EINVAL, str(error), where)
