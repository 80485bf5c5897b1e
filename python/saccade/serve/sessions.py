"""Sessions: the last chunk of each robot, so that the next one continues it. Bounded in number and age."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from saccade.errors import InputError
from saccade.head.chunking import RELEASED, Chunking
from saccade.serve.requests import Options


@dataclass(frozen=True, eq=False)
class Chunk:
    """The actions of a policy for a number of observations, and how many each has."""

    actions: Any
    rows: int
    horizon: int


@dataclass(eq=False)
class Session:
    """One session. It is forgotten by dropping it, so an answer that is late continues nothing."""

    owner: Hashable = None  # the connection that used it last
    used: float = 0.0
    chunk: Chunk | None = None  # the last one

    def continued(self, options: Options, rows: int) -> tuple[Chunk, Chunking] | None:
        """The chunk that a request continues, and how; None if there is none.

        Raises:
            InputError: The request does not say how many actions were executed, is for another number of
                robots, or continues more actions than the chunk has.
        """
        chunk, chunking = self.chunk, options.chunking
        if chunk is None:
            return None
        if chunking is None and options.executed is not None:
            overlap = max(0, chunk.horizon - options.executed)
            chunking = Chunking(overlap, min(options.frozen, overlap), options.ramp_rate)
        if chunking is None:
            raise InputError(
                "options: executed: expected the number of actions that were executed of the last chunk of "
                f"session {options.session!r:.100}, or {', '.join(RELEASED)}, got none; "
                "reset starts a new chunk"
            )
        if rows != chunk.rows:
            raise InputError(
                f"observation: expected {chunk.rows} rows, as session {options.session!r:.100} began, got "
                f"{rows}"
            )
        if chunking.horizon is not None and chunking.horizon > chunk.horizon:
            raise InputError(
                f"options: action_horizon: expected at most {chunk.horizon}, the actions of the session's "
                f"last chunk, got {chunking.horizon}"
            )
        return (chunk, chunking) if chunking.overlap else None


class Sessions:
    """The sessions of a server, in number and age as :class:`saccade.serve.Limits` says. For any thread."""

    def __init__(self, most: int, most_seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._most_seconds, self._clock = most, most_seconds, clock
        self._sessions: OrderedDict[str | int, Session] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._sessions)

    def use(self, name: str | int, owner: Hashable) -> Session:
        """The session of this name, which a connection uses; it is made if there is none."""
        with self._lock:
            self._forget_old()
            session = self._sessions.pop(name, None) or Session()
            session.owner, session.used = owner, self._clock()
            self._sessions[name] = session
            while len(self._sessions) > self._most:
                self._sessions.popitem(last=False)
            return session

    def reset(self, name: str | int | None, owner: Hashable) -> None:
        """Forgets a session, if there is one; without a name those that a connection used last."""
        with self._lock:
            self._forget_old()
            if name is not None:
                self._sessions.pop(name, None)
                return
            owned = [key for key, session in self._sessions.items() if session.owner is owner]
            for key in owned:
                del self._sessions[key]

    def _forget_old(self) -> None:
        oldest = self._clock() - self._most_seconds
        while self._sessions and next(iter(self._sessions.values())).used < oldest:
            self._sessions.popitem(last=False)
