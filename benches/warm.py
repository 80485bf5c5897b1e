"""Calls that are not timed, before those that are."""

from __future__ import annotations

import time
from collections.abc import Callable

WARM = 0.2
"""Seconds of calls before a measurement."""


def warm_up(work: Callable[[], object]) -> None:
    """Calls `work` for `WARM` seconds, at least once.

    Threads and caches are warm then. A hypervisor may also wake two of a machine's processors on one core: on
    a virtual Zen 4, two processes, each pinned to its own processor, then ran at 0.6 of their speed, mostly
    for 80 ms, sometimes for longer.
    """
    begin = time.perf_counter()
    while True:
        work()
        if time.perf_counter() - begin >= WARM:
            return
