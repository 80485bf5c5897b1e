"""A moment of work for every processor before something short is timed."""

from __future__ import annotations

import os
import subprocess
import sys
import time

WAKE = 0.2
"""Seconds that every processor is busy."""
START = 0.02
"""Seconds to start a process, at most."""
BUSY = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
while time.monotonic() < float(sys.argv[2]):
    pass
"""


def wake() -> None:
    """Keeps every processor that this process may use busy, all of them until the same moment.

    A hypervisor may wake two processors of a machine on one core. On a virtual Zen 4, two processes, each
    pinned to its own processor, then ran at 0.6 of their speed for 80 ms after a pause: a third of a chunk in
    int8.

    Raises:
        RuntimeError: a process that was to be busy failed.
    """
    processors = sorted(os.sched_getaffinity(0))
    end = time.monotonic() + START * len(processors) + WAKE
    command = [sys.executable, "-S", "-c", BUSY]
    busy = [subprocess.Popen([*command, str(processor), repr(end)]) for processor in processors]
    statuses = [process.wait() for process in busy]
    if any(statuses):
        raise RuntimeError("a processor could not be kept busy")
