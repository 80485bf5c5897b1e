"""Computes the requests of a batch together, each with the bits that it has alone."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.head.chunking import RELEASED, Chunking
from saccade.head.options import noise_or_draw
from saccade.policy.encoding import compute_features, encode_features
from saccade.policy.guidance import Without, named, without_words
from saccade.policy.preparing import prepare_inputs
from saccade.serve.batching import Job
from saccade.serve.requests import CHUNKING
from saccade.serve.sessions import Chunk, Session, Sessions

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

#: The parts of which the time is reported, in their order. "wait" is the time until a thread takes the
#: request: its decoding, and the queue.
PARTS = ("wait", "inputs", "backbone", "head")
#: With a backbone of at most this many bytes, each thread computes a batch of its own. Loops are short there:
#: threads that share them wait for each other. Measured once by hand, by a program that is not committed, on
#: two cores of AMD Zen 3, float32: observations a second with two batches of 4 on a thread each, divided by
#: those with one batch of 8 on two threads, by the size of backbone and head together: 1.17 at 4 MB, 1.10 at
#: 27 MB, 1.05 at 157 MB. Weights beyond the last-level cache are read from memory by each thread on its own,
#: and the gain was above 1.1 at 4 MB only. The limit lies between these sizes; nothing was measured at 16 MB.
SMALL_BACKBONE = 16 << 20


@dataclass(eq=False)
class _Work:
    """A request while it is computed."""

    job: Job
    noise: Float32Array
    session: Session | None
    continued: tuple[Chunk, Chunking] | None
    num_steps: int | None
    guidance: float | None
    features: Sequence[Any] = ()
    bare_features: Sequence[Any] = ()


class Engine:
    """Computes batches.

    Args:
        policy, num_steps, guidance, without: As for :class:`saccade.serve.Server`.
        sessions: The sessions of the server.

    Attributes:
        num_workers: Number of threads that are to call :meth:`run` at the same time, at most.
    """

    def __init__(
        self,
        policy: Policy,
        sessions: Sessions,
        num_steps: int | None = None,
        guidance: float | None = None,
        without: Without = "default",
    ) -> None:
        self._policy, self._sessions, self._num_steps = policy, sessions, num_steps
        self._guidance, self._without = guidance, without
        self._lock, self._running = threading.Lock(), 0
        if policy.backbone is None or policy.processor is None:
            raise InputError(f"policy: expected a whole policy, got one without a backbone: {policy!r}")
        self._backbone, self._processor = policy.backbone, policy.processor
        is_small = policy.backbone.nbytes <= SMALL_BACKBONE
        self.num_workers = policy.head.num_threads if is_small else 1

    def prepare(self, job: Job) -> None:
        """Prepares what the backbone takes of a request; nothing happens if it is prepared."""
        if not job.inputs and job.error is None:
            with _timed([job], "inputs"):
                try:
                    if self._weight(job) is not None:
                        bare = without_words([job.parsed], self._without, self._processor)
                        with named(self._without):
                            job.bare_inputs = prepare_inputs(bare, self._processor)
                    job.inputs = prepare_inputs([job.parsed], self._processor)
                except BaseException as error:
                    job.error = error

    def _weight(self, job: Job) -> float | None:
        """The weight of a request's guidance; None without, which 1 says too."""
        own = job.call.options.guidance
        weight = self._guidance if own is None else own
        return None if weight == 1 else weight

    def run(self, jobs: Sequence[Job]) -> Sequence[Job]:
        """Computes the actions or the error of requests. An error of one does not affect the others."""
        for job in jobs:
            waited = 1e3 * (time.perf_counter() - job.received)
            job.milliseconds["wait"] = waited - job.milliseconds.get("inputs", 0.0)
        with self._lock:
            self._running += 1
            # A request that is computed alone has all threads.
            alone = self.num_workers > 1 and (self._running > 1 or len(jobs) > 1)
        try:
            with _saccade.stay_on_this_thread() if alone else nullcontext():
                self._compute(jobs)
        finally:
            with self._lock:
                self._running -= 1
        return jobs

    def _compute(self, jobs: Sequence[Job]) -> None:
        works = []
        for job in jobs:
            self.prepare(job)
            if job.error is None:
                try:
                    works.append(self._begun(job))
                except BaseException as error:
                    job.error = error
        if works:
            self._try(works)

    def _begun(self, job: Job) -> _Work:
        options = job.call.options
        session = continued = None
        if options.session is not None:
            session = self._sessions.use(options.session, job.client)
            continued = session.continued(options, job.rows)
        noise = noise_or_draw(None, options.seed, self._policy.head.config, job.rows)
        num_steps = options.num_steps or self._num_steps
        return _Work(job, noise, session, continued, num_steps, self._weight(job))

    def _try(self, works: Sequence[_Work]) -> None:
        """Computes requests together, or if that fails each alone."""
        try:
            self._together(works)
            return
        except BaseException as error:
            if len(works) == 1:
                works[0].job.error = error
                return
        # One of them is the cause, or there is not enough memory for all of them, which is free only here.
        for work in works:
            self._try([work])

    def _together(self, works: Sequence[_Work]) -> None:
        inputs = [one for work in works for one in work.job.inputs]
        bare = [one for work in works for one in work.job.bare_inputs]
        with _timed([work.job for work in works], "backbone"):
            known = compute_features(inputs, self._backbone)
            # Views and the beginning of the prompt are those of the same observations with their words.
            second = iter(self._backbone.encode_many(bare, previous=known) if bare else ())
        features = iter(known)
        groups: dict[tuple[Chunking | None, int | None, float | None], list[_Work]] = {}
        for work in works:
            work.features = list(itertools.islice(features, len(work.job.inputs)))
            work.bare_features = list(itertools.islice(second, len(work.job.bare_inputs)))
            chunking = None if work.continued is None else work.continued[1]
            groups.setdefault((chunking, work.num_steps, work.guidance), []).append(work)
        for options, group in groups.items():
            with _timed([work.job for work in group], "head"):
                self._sample(group, *options, len(inputs))

    def _sample(
        self,
        works: Sequence[_Work],
        chunking: Chunking | None,
        num_steps: int | None,
        guidance: float | None,
        batch: int,
    ) -> None:
        previous = [work.continued[0].actions for work in works if work.continued is not None]
        head = self._policy.head
        context = encode_features([one for work in works for one in work.features], head)
        if guidance is not None:
            bare = [one for work in works for one in work.bare_features]
            context = replace(context, without=encode_features(bare, head))
        found = self._policy.sample(
            context,
            [work.job.parsed for work in works],
            noise=np.concatenate([work.noise for work in works]),
            num_steps=num_steps,
            guidance=guidance,
            previous_chunk=previous or None,
            chunking=chunking,
        )
        for work, actions in zip(works, found, strict=True):
            if work.session is not None:
                work.session.chunk = Chunk(actions, work.job.rows, _horizon(actions))
            work.job.actions, work.job.info, work.job.batch = actions, _info(work), batch


@contextmanager
def _timed(jobs: Sequence[Job], part: str) -> Iterator[None]:
    """Adds the time of a part to requests."""
    start = time.perf_counter()
    try:
        yield
    finally:
        elapsed = 1e3 * (time.perf_counter() - start)
        for job in jobs:
            job.milliseconds[part] = job.milliseconds.get(part, 0.0) + elapsed


def _horizon(actions: Any) -> int:
    """Number of actions in a chunk in any format."""
    array = next(iter(actions.values())) if isinstance(actions, Mapping) else actions
    return int(array.shape[-2])


def _info(work: _Work) -> dict[str, Any]:
    """What is returned with the actions to N1.6's and N1.7's clients."""
    options = work.job.call.options
    applied = dict(options.stated)
    if work.continued is None:
        for name in (*CHUNKING, *RELEASED):
            applied.pop(name, None)
    elif "frozen" in applied:
        applied["frozen"] = work.continued[1].frozen  # which are not more than there are to continue
    info: dict[str, Any] = {"applied_options": applied}
    if options.session is not None:
        info |= {"session": options.session, "continued": work.continued is not None}
    if options.ignored:
        info["ignored_options"] = list(options.ignored)
    return info
