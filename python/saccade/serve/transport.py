"""The server's ROUTER socket: which clients are connected, what they send, and what is sent back.

libzmq speaks the protocol and bounds what it can: the size of a frame (``MAXMSGSIZE``), the messages of a
connection that wait (high-water marks), and the time that a silent or unfinished connection lasts
(heartbeats, ``HANDSHAKE_IVL``). It bounds neither the number of connections nor the number of frames in a
message that is still arriving. Both is done here, the latter on Linux only, whose sockets count their bytes.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import zmq
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import parse_monitor_message

from saccade.serve.keys import ServerKeys
from saccade.serve.limits import Limits

#: Requests of one connection that libzmq holds; more wait in the network.
MOST_UNREAD_REQUESTS = 32
#: Answers to one connection that libzmq holds; more are not sent. It is many times `READ_AT_ONCE`, so only
#: a client that does not read loses answers.
MOST_UNSENT_ANSWERS = 1000
#: Frames before the request, which are sent back before the answer, and bytes of each.
MOST_ENVELOPE_FRAMES = 8
MOST_ENVELOPE_BYTES = 255
#: Requests that are read before answers are sent.
READ_AT_ONCE = 64
#: Milliseconds for the last answers to be sent when the socket is closed.
FLUSH_MS = 5000
#: Milliseconds that a heartbeat can announce.
LONGEST_TTL = 6_553_500
#: Of the authentication of clients.
DOMAIN = "saccade"
#: Files that the server opens besides those of connections.
SPARE_FILES = 64

#: Bytes, besides two of the largest requests, that a connection may send after the last one that was read.
UNREAD_BYTES = 16_000_000
#: Seconds between two checks of them, about.
CHECK_SECONDS = 0.1
#: Where Linux's ``struct tcp_info`` has the number of bytes that were received.
BYTES_RECEIVED = slice(128, 136)

FAILURES: dict[int, str] = {
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "closed before the end of the handshake",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "expected ZeroMQ's protocol (ZMTP 3) with the server's encryption",
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "refused: its key is not one of the clients' keys",
}
#: libzmq does not say which.
CLOSED = "closed: its frame is larger than --max-message-mb or invalid, or it was silent for --stall-seconds"
EVENTS = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | sum(FAILURES)


@dataclass(eq=False)
class Connection:
    """One TCP connection: its address and port, and a duplicate of libzmq's socket."""

    name: str
    duplicate: socket.socket | None = None
    is_open: bool = True  # in doubt, too; any thread may read it
    num_read: int = 0  # bytes that were received when its last request was read

    def num_received(self) -> int:
        """Bytes that were received; 0 where the system does not say."""
        if sys.platform == "linux" and self.duplicate is not None:
            with contextlib.suppress(OSError):  # it is closed
                info = self.duplicate.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, BYTES_RECEIVED.stop)
                return int.from_bytes(info[BYTES_RECEIVED], sys.byteorder)
        return 0

    def refuse(self) -> None:
        """Makes libzmq close it."""
        if self.duplicate is not None:
            with contextlib.suppress(OSError):  # it is closed
                self.duplicate.shutdown(socket.SHUT_RDWR)

    def close(self) -> str:
        """Notes that it is closed; returns why libzmq closed it, or nothing if the client did."""
        self.is_open = False
        if self.duplicate is None:
            return "connected and was gone at once"
        with self.duplicate as duplicate, contextlib.suppress(OSError):  # reset by the client
            with contextlib.suppress(BlockingIOError):  # the client would still send
                if not duplicate.recv(1, socket.MSG_PEEK):
                    return ""
            return CLOSED
        return ""


@dataclass(eq=False)
class Peer:
    """A client's socket. A connection has more than one only if libzmq's events came late."""

    identity: bytes  # its address in libzmq
    connection: Connection
    modality_form: str | None = None  # how it reads `get_modality_config`, once a request has shown it

    @property
    def chose_identity(self) -> bool:
        """Whether its socket has a routing id of its own, which another client may have after it."""
        return not (len(self.identity) == 5 and self.identity.startswith(b"\0"))


class Transport:
    """The server's socket. One thread uses it, except for :meth:`wake`.

    Args:
        listener: The TCP socket that clients connect to, from :func:`bind`.
        limits, keys: As in :class:`saccade.serve.Server`.
        warn: Called with the name of a client and what is wrong with it.
    """

    def __init__(
        self,
        listener: socket.socket,
        limits: Limits,
        warn: Callable[[str, str], None],
        keys: ServerKeys | None = None,
    ) -> None:
        self._listener, self._limits, self._warn = listener, limits, warn
        self._keys, self._address, self._family = keys, address_of(listener), listener.family
        self._most_clients = min(limits.clients, _most_connections())
        self._by_file: dict[int, Connection] = {}
        self._peers: dict[bytes, Peer] = {}
        self._failure, self._checked = "", 0.0
        self._waker, self._woken = socket.socketpair()
        for end in (self._waker, self._woken):
            end.setblocking(False)

    def listen(self) -> None:
        """Accepts clients from now on; an `OSError` says that another program took the address meanwhile."""
        try:
            self._listener.listen(128)
        except OSError as error:
            self._listener.close()
            raise _named(error, self._address) from None
        # Events and messages are in order because one thread of libzmq makes both.
        self._context = zmq.Context(io_threads=1)
        self._authenticator: ThreadAuthenticator | None = None
        if self._keys is not None and self._keys.clients is not None:
            self._authenticator = ThreadAuthenticator(self._context)
            self._authenticator.start()
            self._authenticator.configure_curve_callback(DOMAIN, self._keys)
        self._router = self._configured()
        self._router.monitor("inproc://monitor", EVENTS)
        self._monitor = self._context.socket(zmq.PAIR)
        self._monitor.setsockopt(zmq.RCVHWM, 0)  # no event is lost, and libzmq never waits
        self._monitor.connect("inproc://monitor")
        self._poller = zmq.Poller()
        for readable in (self._router, self._monitor, self._woken):
            self._poller.register(readable, zmq.POLLIN)
        self._router.setsockopt(zmq.USE_FD, self._listener.detach())  # libzmq closes it
        self._router.bind(self._address)

    def wake(self) -> None:
        """Ends :meth:`requests`. May be called by any thread, and by signal handlers."""
        with contextlib.suppress(OSError):  # it is awake, or closed
            self._waker.send(b"\0")

    def requests(self, timeout: float) -> Iterator[tuple[Peer, list[bytes], memoryview]]:
        """Client, frames before the request, and request, of those that arrive within ``timeout`` seconds."""
        if any(ready == self._woken.fileno() for ready, _ in self._poller.poll(int(1e3 * timeout))):
            with contextlib.suppress(BlockingIOError):
                while self._woken.recv(4096):
                    pass
        self._read_events()
        for _ in range(READ_AT_ONCE):
            try:
                identity, *frames, payload = self._router.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            peer = self._peer(identity.bytes, payload.get(zmq.SRCFD))
            peer.connection.num_read = peer.connection.num_received()
            longest = max(map(len, frames), default=0)
            if len(frames) > MOST_ENVELOPE_FRAMES or longest > MOST_ENVELOPE_BYTES:
                self._warn(peer.connection.name, "expected a request in one frame, got several; ignored")
                continue
            yield peer, [frame.bytes for frame in frames], payload.buffer
        if time.monotonic() >= self._checked + CHECK_SECONDS:
            self._checked = time.monotonic()
            self._refuse_endless()

    def send(self, peer: Peer, frames: Sequence[bytes], answer: bytes) -> bool:
        """Whether the answer is on its way; False if the client is gone or does not read its answers."""
        try:
            self._router.send_multipart([peer.identity, *frames, answer], zmq.NOBLOCK)
        except zmq.Again:
            self._warn(peer.connection.name, "does not read its answers; one was not sent")
            return False
        except zmq.ZMQError as error:
            if error.errno != errno.EHOSTUNREACH:
                raise
            return False
        return True

    def close(self) -> None:
        """Sends what waits, for at most some seconds, and closes everything."""
        self._router.disable_monitor()
        self._monitor.close(linger=0)
        self._router.close(linger=FLUSH_MS)
        if self._authenticator is not None:
            self._authenticator.stop()
        self._context.term()
        for connection in self._by_file.values():
            connection.close()
        self._waker.close()
        self._woken.close()

    def _configured(self) -> zmq.Socket[bytes]:
        stall = int(1e3 * self._limits.stall_seconds)
        router = self._context.socket(zmq.ROUTER)
        options = {
            zmq.ROUTER_MANDATORY: 1,  # send says if a client is gone or does not read
            zmq.MAXMSGSIZE: self._limits.message_bytes,
            zmq.SNDHWM: MOST_UNSENT_ANSWERS,
            zmq.RCVHWM: MOST_UNREAD_REQUESTS,
            zmq.HANDSHAKE_IVL: stall,
            # A client is heard within the sum of both.
            zmq.HEARTBEAT_IVL: max(1, stall // 3),
            zmq.HEARTBEAT_TIMEOUT: max(1, stall - stall // 3),
            zmq.HEARTBEAT_TTL: min(stall, LONGEST_TTL),
            zmq.TCP_KEEPALIVE: 1,
            zmq.IPV6: int(self._family == socket.AF_INET6),
        }
        for option, value in options.items():
            router.setsockopt(option, value)
        router.setsockopt_string(zmq.ZAP_DOMAIN, DOMAIN)  # with which ZMTP 1 and 2 are refused
        if self._keys is not None:
            router.setsockopt(zmq.CURVE_SERVER, 1)
            router.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
            # Nobody connects without the authenticator.
            router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, int(self._keys.clients is not None))
        return router

    def _read_events(self) -> None:
        """Reads all events of connections that were before now."""
        while True:
            try:
                found = parse_monitor_message(self._monitor.recv_multipart(zmq.NOBLOCK))
            except zmq.Again:
                return
            event, file = found["event"], found["value"]
            if event in FAILURES:  # of the connection that is closed next
                self._failure = FAILURES[event]
                continue
            self._forget(file)
            if event == zmq.EVENT_ACCEPTED:
                connection = self._by_file[file] = self._connection(file)
                if len(self._by_file) > self._most_clients:
                    self._warn(connection.name, f"refused: {self._most_clients} clients are connected")
                    connection.refuse()

    def _refuse_endless(self) -> None:
        """Closes connections whose message has more bytes than a request may have, in frames without end."""
        most = 2 * self._limits.message_bytes + UNREAD_BYTES
        for connection in self._by_file.values():
            if connection.num_received() - connection.num_read > most:
                self._warn(connection.name, "its message is larger than --max-message-mb, in several frames")
                connection.refuse()

    def _connection(self, file: int) -> Connection:
        """A connection that was accepted.

        Its file descriptor is duplicated, since libzmq does not say which side closes a connection. libzmq
        may have closed it already, and another file may have its number: its address shows it.
        """
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            duplicate = stack.enter_context(socket.fromfd(file, self._family, socket.SOCK_STREAM))
            if duplicate.getsockname()[1] == int(self._address.rpartition(":")[2]):
                host, port = duplicate.getpeername()[:2]
                stack.pop_all()  # it stays open
                return Connection(f"{host}:{port}", duplicate)
        return Connection("unknown")

    def _forget(self, file: int) -> None:
        """Notes that the connection with a file descriptor is closed, if there is one."""
        failure, self._failure = self._failure, ""
        connection = self._by_file.pop(file, None)
        if connection is None:
            return
        for peer in [one for one in self._peers.values() if one.connection is connection]:
            del self._peers[peer.identity]
        closed = connection.close()
        if failure or closed:
            self._warn(connection.name, failure or closed)

    def _peer(self, identity: bytes, file: int) -> Peer:
        """The client with an identity, whose request came from a file descriptor.

        The events up to the request are read first, so the connection that now has the descriptor is that of
        the client, or a later one if the client is gone. A client that is connected is never taken for gone.
        """
        peer = self._peers.get(identity)
        if peer is None:
            self._read_events()
            connection = self._by_file.get(file)
            if connection is None:
                return Peer(identity, Connection("unknown", is_open=False))
            peer = self._peers[identity] = Peer(identity, connection)
        return peer


def _most_connections() -> int:
    """How many connections, with two files each, the system allows a process to have."""
    try:
        import resource  # which Windows does not have
    except ImportError:
        return sys.maxsize
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return sys.maxsize if files == resource.RLIM_INFINITY else max(1, (files - SPARE_FILES) // 2)


def bind(host: str, port: int) -> socket.socket:
    """Takes an address for a server, which does not accept clients yet.

    Args:
        host: Name or address of this machine; ``*`` for all addresses.
        port: 0 takes one that is free.

    Raises:
        OSError: It cannot be taken; names it.

    Example:
        >>> from saccade.serve import bind
        >>> with bind("127.0.0.1", 0) as listener:
        ...     address, port = listener.getsockname()
        >>> address, port > 0
        ('127.0.0.1', True)
    """
    name = None if host == "*" else host
    try:
        if not 0 <= port <= 0xFFFF:  # which would be cut to 16 bits
            raise OverflowError("expected a port of 0 to 65535")
        given = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, kind, protocol, _, address = given[0]
        with contextlib.ExitStack() as stack:
            taken = stack.enter_context(socket.socket(family, kind, protocol))
            # A restarted server need not wait until the connections of the last one are forgotten.
            taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            taken.setblocking(False)
            taken.bind(address)
            stack.pop_all()  # it stays open
            return taken
    except (OSError, UnicodeError, OverflowError) as error:
        raise _named(error, f"{host}:{port}") from None


def address_of(listener: socket.socket) -> str:
    """The address of a socket, ``tcp://host:port``."""
    host, port = listener.getsockname()[:2]
    return f"tcp://[{host}]:{port}" if listener.family == socket.AF_INET6 else f"tcp://{host}:{port}"


def _named(error: Exception, where: str) -> OSError:
    """An error about an address, with its name."""
    if isinstance(error, OSError) and error.errno is not None:
        return OSError(error.errno, str(error.strerror), where)
    return OSError(errno.EINVAL, str(error), where)
