"""Requests that wait, and which of them are computed together."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from saccade.observations import ParsedObservation
from saccade.serve.requests import Call

#: A client that asked within these seconds is expected to ask again.
ACTIVE_SECONDS = 1.0


@dataclass(eq=False)
class Job:
    """A ``get_action`` request, from its arrival to its answer."""

    call: Call
    parsed: ParsedObservation
    client: Any
    frames: Sequence[bytes] = ()  # before the request, which are sent back before the answer
    is_msgpack_numpy: bool = False  # the format in which its arrays came, and those of the answer go
    num_bytes: int = 0
    received: float = field(default_factory=time.perf_counter)
    is_claimed: bool = False  # a thread has begun to prepare it while it waits
    inputs: Sequence[Any] = ()  # what the backbone takes, once it is prepared
    bare_inputs: Sequence[Any] = ()  # with guidance, the same without the words
    actions: Any = None
    info: Mapping[str, Any] = field(default_factory=dict)  # what is returned with the actions
    batch: int = 0  # number of observations that were computed together
    error: BaseException | None = None  # why there are no actions
    milliseconds: dict[str, float] = field(default_factory=dict)  # by part

    @property
    def rows(self) -> int:
        """Number of its observations."""
        return len(self.parsed)


class Queue:
    """The requests that wait.

    A batch is taken when as many observations wait as a batch has, when every client that asked within the
    last second is waiting or being computed, or when the oldest request has waited long enough. A client
    alone never waits. A request with more observations than a batch is a batch of its own.

    Args:
        max_batch, max_wait: As in :class:`saccade.serve.Server`, but in seconds.
        prepare: Called with requests that wait for others, by a thread that would wait with them.
        num_workers: Number of threads that take batches. They share out ``max_batch``, so it is at most that.
        clock: Returns seconds.
    """

    def __init__(
        self,
        max_batch: int,
        max_wait: float,
        prepare: Callable[[Job], None] = lambda job: None,
        num_workers: int = 1,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._max_batch = max(1, max_batch // num_workers)
        self._max_wait, self._prepare, self._clock = max_wait, prepare, clock
        self._jobs: deque[Job] = deque()
        self._prepared: set[Job] = set()  # those that a thread prepares now
        self._computed: set[Job] = set()
        self._active: OrderedDict[Hashable, float] = OrderedDict()
        self._changed = threading.Condition()
        self._is_closed = False
        self._num_idle = 0

    def __len__(self) -> int:
        return len(self._jobs)

    def put(self, job: Job) -> None:
        """Appends a request."""
        with self._changed:
            self._jobs.append(job)
            self._active.pop(job.client, None)
            self._active[job.client] = now = self._clock()
            while next(iter(self._active.values())) < now - ACTIVE_SECONDS:
                self._active.popitem(last=False)
            self._changed.notify()

    def close(self) -> None:
        """What waits is still taken, without waiting for others; then :meth:`take` returns None."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def take(self) -> list[Job] | None:
        """The next batch, in the order of arrival; None once the queue is closed and empty.

        Of each session one request is computed at a time. Say with :meth:`done` when the batch is computed.
        """
        with self._changed:
            self._num_idle += 1
            while True:
                ready = self._ready()
                if ready:
                    until = min(ready[0].received + self._max_wait, self._expected_until(ready))
                    missing = until - self._clock()
                    if missing <= 0:
                        break
                    self._prepare_or_wait(ready, missing)
                elif self._is_closed and not self._jobs:
                    self._num_idle -= 1
                    return None
                else:
                    self._changed.wait()
            chosen = self._chosen(ready)
            self._num_idle -= 1
            if self._jobs:
                self._changed.notify()  # another thread that waits for requests
            return chosen

    def done(self, jobs: Sequence[Job]) -> None:
        """The batch was computed, and other requests of its sessions can be."""
        with self._changed:
            self._computed.difference_update(jobs)
            if self._is_closed:
                self._changed.notify_all()
            elif self._jobs:
                self._changed.notify()

    def _ready(self) -> list[Job]:
        """The requests that can be computed now; those that another thread prepares are left to it."""
        sessions = {job.call.options.session for job in self._computed} - {None}
        found = []
        for job in self._jobs:
            session = job.call.options.session
            if session not in sessions:
                if job not in self._prepared:
                    found.append(job)
                if session is not None:
                    sessions.add(session)
        return found

    def _expected_until(self, ready: Sequence[Job]) -> float:
        """Until when a client is expected that neither waits nor is computed; 0 if a batch need not wait."""
        if self._is_closed or sum(job.rows for job in ready) >= self._max_batch * self._num_idle:
            return 0.0
        here = {job.client for job in self._jobs} | {job.client for job in self._computed}
        latest = max((seen for client, seen in self._active.items() if client not in here), default=None)
        return 0.0 if latest is None else latest + ACTIVE_SECONDS

    def _prepare_or_wait(self, ready: Sequence[Job], seconds: float) -> None:
        """Uses the time until others arrive."""
        job = next((job for job in ready if not job.is_claimed), None)
        if job is None:
            self._changed.wait(seconds)
            return
        job.is_claimed = True
        self._prepared.add(job)
        self._changed.release()
        try:
            self._prepare(job)
        finally:
            self._changed.acquire()
            self._prepared.discard(job)

    def _chosen(self, ready: Sequence[Job]) -> list[Job]:
        """This thread's share of the requests that can be computed."""
        share = -(-sum(job.rows for job in ready) // self._num_idle)
        most = min(share, self._max_batch)
        chosen: list[Job] = []
        rows = 0
        for job in ready:
            if chosen and rows + job.rows > most:
                break
            chosen.append(job)
            rows += job.rows
        self._computed.update(chosen)
        self._jobs = deque(job for job in self._jobs if job not in self._computed)
        return chosen
