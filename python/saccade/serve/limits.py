"""What a server takes at most: sizes of messages and arrays, waiting requests, clients, sessions."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What a server takes at most. A request beyond a limit is answered with an error.

    Attributes:
        message_bytes: Size of a request. A larger one is skipped while it is received, and never held.
        array_elements: Number of elements of an array.
        depth: Nesting of maps and arrays in a message.
        objects: Number of values in a message, keys included; the elements of arrays are not counted.
        rows: Number of observations in a request.
        waiting: Number of requests that wait to be computed.
        waiting_bytes: Size of all requests that are being received or not yet answered.
        clients: Number of connections.
        sessions: Number of sessions; beyond it the one that was used least recently is forgotten.
        session_seconds: Time after which an unused session is forgotten.
        stall_seconds: Time after which a connection is closed that stalls in the middle of a request or of an
            answer.
    """

    message_bytes: int = 64_000_000
    array_elements: int = 16_000_000
    depth: int = 16
    objects: int = 65_536
    rows: int = 256
    waiting: int = 256
    waiting_bytes: int = 1_000_000_000
    clients: int = 1024
    sessions: int = 256
    session_seconds: float = 600.0
    stall_seconds: float = 30.0
