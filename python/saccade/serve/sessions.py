"""Sessions: the last chunk of each robot, so that the next one continues it. Bounded in number and age."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.serve.requests import RELEASED_CHUNKING, Options


@dataclass(frozen=True, eq=False)
class Chunk:
    """The last chunk of a session.

    Attributes:
        actions: As the policy returned it.
        rows: Number of observations that it is for.
        horizon: Number of actions in it.
    """

    actions: Any
    rows: int
    horizon: int


class Session:
    """One session. It is forgotten by dropping it, so an answer that is late continues nothing.

    Attributes:
        owner: The connection that used it last.
        chunk: Its last chunk, or None.
    """

    def __init__(self) -> None:
        self.owner: Hashable = None
        self.chunk: Chunk | None = None
        self.used = 0.0

    def continued(self, options: Options, rows: int) -> tuple[Chunk, Chunking] | None:
        """The chunk that a request continues, and how; None if there is nothing to continue.

        Args:
            options: The options of the request.
            rows: Number of its observations.

        Raises:
            InputError: The request does not say how many actions were executed, is for another number of
                robots, or continues more actions than the chunk has.
        """
        chunk = self.chunk
        if chunk is None:
            return None
        if options.executed is None and options.chunking is None:
            raise InputError(
                "options: executed: expected the number of actions that were executed of the last chunk of "
                f"session {options.session!r:.100}, or {', '.join(RELEASED_CHUNKING)}, got none; "
                "reset begins anew"
            )
        if rows != chunk.rows:
            raise InputError(
                f"observation: expected {chunk.rows} rows, as session {options.session!r:.100} began, got "
                f"{rows}"
            )
        if options.chunking is not None:
            return self._released(chunk, options.chunking)
        assert options.executed is not None
        overlap = chunk.horizon - options.executed
        if overlap <= 0:
            return None
        return chunk, Chunking(
            overlap=overlap, frozen=min(options.frozen, overlap), ramp_rate=options.ramp_rate
        )

    def _released(self, chunk: Chunk, chunking: Chunking) -> tuple[Chunk, Chunking] | None:
        """The same, as the released head of N1.7 continues a chunk."""
        horizon = chunking.horizon or chunk.horizon
        if horizon > chunk.horizon:
            raise InputError(
                f"options: action_horizon: expected at most {chunk.horizon}, the actions of the session's "
                f"last chunk, got {horizon}"
            )
        return (chunk, chunking) if chunking.overlap else None


class Sessions:
    """The sessions of a server. Any thread may use it.

    Args:
        most: Number of sessions; beyond it the one that was used least recently is forgotten.
        most_seconds: Time after which an unused session is forgotten.
        clock: Returns seconds.
    """

    def __init__(self, most: int, most_seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._most_seconds, self._clock = most, most_seconds, clock
        self._sessions: OrderedDict[str | int, Session] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._sessions)

    def use(self, name: str | int, owner: Hashable) -> Session:
        """The session of this name, which is made if there is none.

        Args:
            name: Its id.
            owner: The connection that uses it.
        """
        with self._lock:
            self._forget_old()
            session = self._sessions.pop(name, None) or Session()
            session.owner, session.used = owner, self._clock()
            self._sessions[name] = session
            while len(self._sessions) > self._most:
                self._sessions.popitem(last=False)
            return session

    def reset(self, name: str | int | None, owner: Hashable) -> int:
        """Forgets a session, or without a name those that a connection used last.

        Returns:
            How many were forgotten.
        """
        with self._lock:
            self._forget_old()
            if name is not None:
                return int(self._sessions.pop(name, None) is not None)
            owned = [key for key, session in self._sessions.items() if session.owner is owner]
            for key in owned:
                del self._sessions[key]
            return len(owned)

    def _forget_old(self) -> None:
        oldest = self._clock() - self._most_seconds
        while self._sessions and next(iter(self._sessions.values())).used < oldest:
            self._sessions.popitem(last=False)
