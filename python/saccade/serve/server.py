"""The server: answers requests of many clients, and computes their actions in batches."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections import deque
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import saccade.observations as observations
from saccade._internal.hub import commit_of
from saccade.errors import InputError, SaccadeError, printable
from saccade.head.options import check_guidance
from saccade.policy.guidance import Without, check_without
from saccade.serve import modalities
from saccade.serve.batching import Job, Queue
from saccade.serve.engine import Engine
from saccade.serve.keys import ServerKeys
from saccade.serve.limits import Limits
from saccade.serve.logs import Log, Statistics
from saccade.serve.packing import REFUSAL, is_pickle, pack, refusal, unpack
from saccade.serve.requests import PING, UNAUTHORIZED, Call, check_num_steps, is_allowed, parse
from saccade.serve.sessions import Sessions
from saccade.serve.transport import CHECK_SECONDS, Peer, Transport, address_of

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

#: Characters of an error that are sent.
LONGEST_ERROR = 4000
#: Seconds between two checks of the files of the checkpoint.
WATCH_SECONDS = 5.0


class Dropped(SaccadeError):
    """A request that is not computed, since its client is ``"gone"`` or it is ``"late"``."""

    def __init__(self, why: str, message: str) -> None:
        super().__init__(message)
        self.why = why


class Server:
    """Serves a policy to clients of Isaac-GR00T.

    Args:
        policy: The policy.
        listener: The socket that clients will connect to, from :func:`saccade.serve.bind`.
        log: Where it says what happens, from :func:`saccade.serve.open_log`.
        limits: Its limits.
        keys: Keys for encryption, from :func:`saccade.serve.read_server_keys`, or None for none.
        max_batch: Observations that are computed at a time: together, or with a small policy in a batch for
            each thread.
        max_wait_ms: Time that a request waits for others at most, in milliseconds.
        seed: Seed of the noise of requests that bring none, or None for noise that is different each time.
        num_steps: Number of Euler steps of requests that do not say it, or None for that of the checkpoint.
        guidance: Weight of the guidance of requests that do not say it, as in :meth:`saccade.Policy.sample`;
            None for none.
        without: What stands in place of the instruction for guidance, as in :meth:`saccade.Policy.encode`.
        api_token: A secret that every request must contain, or None.
        allow_kill: Whether a client may stop the server.
        modality_form: How `get_modality_config` is answered to a client that did not show its release:
            ``"text"``, ``"map"``, or None for that of the checkpoint's release.

    Attributes:
        address: Its address, ``tcp://host:port``.
        num_workers: Number of threads that compute.

    Raises:
        CheckpointError: A file of the checkpoint is damaged.
        InputError: ``num_steps`` or ``guidance`` is out of range, or ``without`` is unknown.

    Example:
        >>> import saccade
        >>> from saccade.serve import Server, bind, open_log
        >>> def serve(policy: saccade.Policy) -> None:
        ...     log = open_log()
        ...     try:
        ...         Server(policy, bind("127.0.0.1", 5555), log).run()
        ...     finally:
        ...         log.close()
    """

    def __init__(
        self,
        policy: Policy,
        listener: socket.socket,
        log: Log,
        *,
        limits: Limits = Limits(),  # noqa: B008 (it is immutable)
        keys: ServerKeys | None = None,
        max_batch: int = 16,
        max_wait_ms: float = 5.0,
        seed: int | None = None,
        num_steps: int | None = None,
        guidance: float | None = None,
        without: Without = "default",
        api_token: str | None = None,
        allow_kill: bool = False,
        modality_form: str | None = None,
    ) -> None:
        self._policy, self._log, self._limits = policy, log, limits
        self._seed, self._api_token, self._allow_kill = seed, api_token, allow_kill
        self._most_steps = policy.head.config.num_timestep_buckets
        if num_steps is not None:
            num_steps = check_num_steps("num_steps", num_steps, self._most_steps)
        self._modalities = modalities.answers(policy)
        self._form = modality_form or modalities.form_of(policy.head.config.version)
        self._sessions = Sessions(limits.sessions, limits.session_seconds)
        check_without(without)
        self._engine = Engine(policy, self._sessions, num_steps, check_guidance(guidance), without)
        self.num_workers = min(self._engine.num_workers, max_batch)
        self._queue = Queue(max_batch, max_wait_ms / 1e3, self._engine.prepare, self.num_workers)
        self._statistics = Statistics()
        self.address = address_of(listener)
        self._unanswered: set[Job] = set()
        self._finished: deque[tuple[Job, bytes]] = deque()
        self._stopping: str | None = None
        source = policy.head.source
        self._folder = None if source is None else Path(source)
        self._stamps = _stamps(self._folder)
        self._workers = [
            threading.Thread(target=self._compute, name=f"saccade-serve-{number}", daemon=True)
            for number in range(self.num_workers)
        ]
        self._transport = Transport(listener, limits, self._warn, keys)

    def stop(self, why: str) -> None:
        """Ends :meth:`run` once all requests that were accepted are answered.

        May be called by any thread, and by signal handlers.
        """
        self._stopping = self._stopping or why
        self._transport.wake()

    def stop_on_signals(self) -> None:
        """SIGTERM and SIGINT call :meth:`stop`; a second one has its usual effect."""

        def handle(number: int, frame: FrameType | None) -> None:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            self.stop(signal.Signals(number).name)

        signal.signal(signal.SIGTERM, handle)
        signal.signal(signal.SIGINT, handle)

    def run(self) -> str:
        """Serves until it is stopped.

        Returns:
            What stopped it: ``"SIGTERM"``, ``"SIGINT"``, ``"kill"``, or what :meth:`stop` was given.

        Raises:
            OSError: Another program took the address.
        """
        self._transport.listen()
        commit = None if self._folder is None else commit_of(self._folder)
        about = {"policy": repr(self._policy), "commit": commit, "pid": os.getpid()}
        self._log.event("listening", address=self.address, **about)
        for worker in self._workers:
            worker.start()
        self._spoken = self._watched = time.monotonic()
        try:
            while self._stopping is None:
                self._turn(CHECK_SECONDS)
            self._log.event("stopping", reason=self._stopping, unanswered=len(self._unanswered))
            self._queue.close()
            while self._unanswered:
                self._turn(0.05)
        finally:
            self._queue.close()
            self._transport.close()
        self._log.statistics(self._statistics.summary())
        self._log.event("stopped", requests=self._statistics.requests.total(), errors=self._statistics.errors)
        return self._stopping

    def _turn(self, seconds: float) -> None:
        """Reads requests, waiting for at most so long, sends answers, and does what is due."""
        for request in self._transport.requests(seconds):
            self._on_request(*request)
        self._send_finished()
        now = time.monotonic()
        if now - self._spoken >= self._log.every:
            self._spoken = now
            self._log.statistics(self._statistics.summary())
        if now - self._watched >= WATCH_SECONDS:
            self._watched = now
            self._watch()

    def _on_request(self, client: Peer, frames: list[bytes], payload: memoryview) -> None:
        """Answers a request at once, or appends it to the queue."""
        received = time.perf_counter()
        endpoint, error = "unreadable", None
        try:
            if client.chose_identity:
                raise InputError(
                    "socket: expected no routing id of its own, since an answer could reach another client "
                    "with the same one"
                )
            if is_pickle(payload):
                error, answer = REFUSAL, refusal(payload)
            else:
                message = unpack(payload, self._limits)
                if not is_allowed(message.value, self._api_token):
                    raise InputError(UNAUTHORIZED)
                call = parse(message.value, self._most_steps, self._seed)
                endpoint = call.endpoint
                if endpoint == "get_action":
                    parsed, form = self._read(call, len(payload)), message.is_msgpack_numpy
                    job = Job(call, parsed, client, frames, form, len(payload), received)
                    client.modality_form = "text" if call.is_bare else "map"
                    self._unanswered.add(job)
                    self._queue.put(job)
                    return
                answer = pack(self._answer(client, call))
        except Exception as caught:
            error = describe(caught)
            answer = pack({"error": error})
        self._transport.send(client, frames, answer)
        self._note(client, endpoint, error)

    def _answer(self, client: Peer, call: Call) -> Any:
        """The answer to everything but ``get_action``."""
        if call.endpoint == "ping":
            return PING
        if call.endpoint == "get_modality_config":
            return self._modalities[client.modality_form or self._form]
        if call.endpoint == "reset":
            self._sessions.reset(call.options.session, client)
            return {}
        if not self._allow_kill:
            raise InputError("kill: refused, since the server was started without --allow-kill")
        self.stop("kill")
        return {"status": "ok", "message": "Server is stopping"}

    def _read(self, call: Call, num_bytes: int) -> observations.ParsedObservation:
        """The observations of a request, if it can be taken."""
        if self._stopping is not None:
            raise InputError("the server is stopping, and takes no more requests")
        if len(self._queue) >= self._limits.waiting:
            raise InputError(f"busy: {self._limits.waiting} requests wait; try again")
        waiting = sum(job.num_bytes for job in self._unanswered)
        if waiting + num_bytes > self._limits.waiting_bytes:
            raise InputError(
                f"busy: {waiting} bytes of requests wait, and {num_bytes} more are too many; try again"
            )
        return observations.read(call.observation, self._policy.requirements, self._limits.rows)

    def _compute(self) -> None:
        """What a thread does that computes."""
        while (jobs := self._queue.take()) is not None:
            for job in jobs:
                job.error = self._dropped(job) or job.error
            self._engine.run([job for job in jobs if not isinstance(job.error, Dropped)])
            self._queue.done(jobs)
            for job in jobs:
                self._finished.append((job, self._packed(job)))
            self._transport.wake()

    def _dropped(self, job: Job) -> Dropped | None:
        """Why a request is not computed, if nobody waits for its answer any more."""
        if not job.client.connection.is_open:
            return Dropped("gone", "dropped: its client is gone")
        waited, most = time.perf_counter() - job.received, self._limits.request_seconds
        if waited <= most:
            return None
        message = f"dropped: it waited {waited:.1f} s, more than the {most:g} s of --request-seconds"
        return Dropped("late", message)

    def _packed(self, job: Job) -> bytes:
        """The answer of a request that was computed or dropped."""
        if job.error is None:
            try:
                latency = round(1e3 * (time.perf_counter() - job.received), 3)
                info = {**job.info, "latency_ms": latency}
                answer = job.actions if job.call.is_bare else [job.actions, info]
                return pack(answer, as_msgpack_numpy=job.is_msgpack_numpy)
            except Exception as error:
                job.error = error
        return pack({"error": describe(job.error)})

    def _send_finished(self) -> None:
        while self._finished:
            job, payload = self._finished.popleft()
            is_sent = self._transport.send(job.client, job.frames, payload)
            self._unanswered.remove(job)
            error = None if job.error is None else describe(job.error)
            milliseconds = {**job.milliseconds, "total": 1e3 * (time.perf_counter() - job.received)}
            batch = job.batch if error is None else 0
            if error is None:
                self._statistics.computed(batch, milliseconds)
            if isinstance(job.error, Dropped):
                self._statistics.dropped[job.error.why] += 1
            elif not is_sent:
                self._statistics.dropped["unsent"] += 1
                error = error or "computed, but its client is gone or does not read"
            rounded = {part: round(value, 3) for part, value in milliseconds.items()}
            self._note(job.client, "get_action", error, batch=batch, milliseconds=rounded)

    def _note(self, client: Peer, endpoint: str, error: str | None, **fields: Any) -> None:
        self._statistics.count(endpoint, is_error=error is not None)
        self._log.request(client=client.connection.name, endpoint=endpoint, error=error, **fields)

    def _warn(self, client: str, message: str) -> None:
        self._log.event("warning", client=client, message=message)

    def _watch(self) -> None:
        """Says once if the checkpoint was replaced; the policy is in memory."""
        before, self._stamps = self._stamps, _stamps(self._folder)
        if self._stamps != before:
            message = (
                f"{self._policy.head.source}: the checkpoint has changed; this server keeps what it loaded. "
                "Restart it to serve the new one"
            )
            self._log.event("warning", message=message)


def describe(error: BaseException) -> str:
    """An error as it is sent, on one line: errors of saccade by their message, others with their type."""
    text = str(error)
    if not isinstance(error, SaccadeError | MemoryError) or not text:
        text = f"{type(error).__name__}: {text}"
    return printable("; ".join(line.strip() for line in text.splitlines()))[:LONGEST_ERROR]


def _stamps(path: Path | None) -> list[Any]:
    """What changes if the files of a checkpoint do."""
    if path is None:
        return []
    try:
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        stats = [(file.name, file.stat()) for file in files]
    except OSError as error:
        return [error.errno]
    return [(name, stat.st_ino, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
