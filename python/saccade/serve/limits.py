"""Resource limits of the server."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Resource limits of the server.

    A request beyond a limit is answered with an error, except where an attribute says otherwise.

    Attributes:
        message_bytes: Size of a frame of a request. A larger one costs its connection.
        array_elements: Number of elements of an array.
        objects: Number of values in a message, keys included; elements of arrays are not counted.
        rows: Number of observations in a request.
        waiting: Number of requests that wait to be computed.
        waiting_bytes: Size of all requests that have been read and are not yet answered.
        clients: Number of connections; further ones are closed. It is lower where the system allows the
            process fewer files: a connection has two.
        sessions: Number of sessions; beyond it the least recently used one is forgotten.
        session_seconds: Time after which an unused session is forgotten.
        request_seconds: Age at which a request is no longer computed. Isaac-GR00T's clients wait 15 s.
        stall_seconds: A connection is closed if its handshake or a frame takes longer, or if its client
            answers no heartbeat for this time.
    """

    message_bytes: int = 64_000_000
    array_elements: int = 16_000_000
    objects: int = 65_536
    rows: int = 256
    waiting: int = 256
    waiting_bytes: int = 1_000_000_000
    clients: int = 1024
    sessions: int = 256
    session_seconds: float = 600.0
    request_seconds: float = 15.0
    stall_seconds: float = 30.0
