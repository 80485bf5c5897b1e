"""Calls that are not timed, before those that are."""

from __future__ import annotations

import time
from collections.abc import Callable

WARM = 0.2
"""Seconds of calls before a measurement."""


def warm_up(work: Callable[[], object]) -> None:
    """Calls `work` for `WARM` seconds, at least once.

    Threads and caches are warm then, and processors are where they stay. A hypervisor may wake two of a
    machine's processors on one core: on a virtual Zen 4, two processes, each pinned to its own processor, ran at
    0.6 of their speed for 80 ms after a pause. Other processes that keep all processors busy beforehand do not
    help, since a processor is idle again for a moment before the first call.
    """
    begin = time.perf_counter()
    while True:
        work()
        if time.perf_counter() - begin >= WARM:
            return
