"""A signal that interrupts a call after some time."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class Stopped(Exception):
    """What the signal's handler raises."""


@contextmanager
def stopped_after(seconds: float) -> Iterator[None]:
    """Raises `Stopped` in the main thread once this long has passed.

    And every two seconds after that: Python drops what is raised within a callback of its garbage collector.
    """

    def stop(*_: object) -> None:
        raise Stopped

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds, 2.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
