"""Requests that wait, and which of them are computed together."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

from saccade.serve.requests import Call

#: A client that asked within these seconds is expected to ask again.
ACTIVE_SECONDS = 1.0


@dataclass(eq=False)
class Job:
    """A ``get_action`` request that waits.

    Attributes:
        call: What it asks for.
        rows: Number of its observations.
        client: Who asks.
        size: Bytes of its message.
        is_msgpack_numpy: In which form its arrays came, and those of the answer go.
        received: When it arrived, on the clock of `time.perf_counter`.
        reply: How it is answered; only the server reads it.
        milliseconds: How long each part took.
    """

    call: Call
    rows: int
    client: Hashable
    size: int
    is_msgpack_numpy: bool = False
    received: float = field(default_factory=time.perf_counter)
    reply: Any = None
    milliseconds: dict[str, float] = field(default_factory=dict)


class Queue:
    """The requests that wait.

    A batch is taken when as many observations wait as a batch has, when every client that asked within the
    last second is among them, or when the oldest request has waited long enough. A client alone never waits.

    Args:
        max_batch: Observations in a batch. A request with more is a batch of its own.
        max_wait: Seconds that the oldest request waits for others at most.
        clock: Returns seconds.
    """

    def __init__(
        self, max_batch: int, max_wait: float, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self._max_batch, self._max_wait, self._clock = max_batch, max_wait, clock
        self._jobs: deque[Job] = deque()
        self._active: OrderedDict[Hashable, float] = OrderedDict()
        self._changed = threading.Condition()
        self._is_closed = False
        self._size = 0

    def __len__(self) -> int:
        return len(self._jobs)

    @property
    def size(self) -> int:
        """Bytes of the messages that wait."""
        return self._size

    def put(self, job: Job) -> None:
        """Appends a request."""
        with self._changed:
            self._jobs.append(job)
            self._size += job.size
            self._active.pop(job.client, None)
            self._active[job.client] = self._clock()
            self._changed.notify()

    def close(self) -> None:
        """What waits is still taken, without waiting for others; then :meth:`take` returns None."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def take(self) -> list[Job] | None:
        """The next batch, in the order of arrival; None once the queue is closed and empty.

        Of each session it contains one request at most.
        """
        with self._changed:
            while not self._jobs and not self._is_closed:
                self._changed.wait()
            if not self._jobs:
                return None
            deadline = self._jobs[0].received + self._max_wait
            while (until := min(deadline, self._expected_until())) > (now := self._clock()):
                self._changed.wait(until - now)
            return self._chosen()

    def _expected_until(self) -> float:
        """Until when a client is expected that is not among those that wait; 0 if a batch need not wait."""
        if self._is_closed or sum(job.rows for job in self._jobs) >= self._max_batch:
            return 0.0
        recent = self._clock() - ACTIVE_SECONDS
        while self._active and next(iter(self._active.values())) < recent:
            self._active.popitem(last=False)
        waiting = {job.client for job in self._jobs}
        latest = max((seen for client, seen in self._active.items() if client not in waiting), default=None)
        return 0.0 if latest is None else latest + ACTIVE_SECONDS

    def _chosen(self) -> list[Job]:
        chosen: list[Job] = []
        later: deque[Job] = deque()
        sessions: set[str | int] = set()
        rows = 0
        while self._jobs:
            job = self._jobs.popleft()
            session = job.call.options.session
            if session in sessions:
                later.append(job)
                continue
            if chosen and rows + job.rows > self._max_batch:
                self._jobs.appendleft(job)
                break
            chosen.append(job)
            rows += job.rows
            self._size -= job.size
            if session is not None:
                sessions.add(session)
        later.extend(self._jobs)
        self._jobs = later
        return chosen
