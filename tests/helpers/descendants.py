"""The processes that a process started, and how such a process is interrupted."""

import signal
import time
from pathlib import Path


def descendants(pid: int) -> list[int]:
    """The processes that a process started, and those that they started."""
    try:
        children = [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return [*children, *(below for child in children for below in descendants(child))]


def command_of(pid: int) -> str:
    """What a process runs, empty if it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def all_end(pids: list[int], *, seconds: float) -> bool:
    """Whether all processes are gone after that time at most."""
    end = time.monotonic() + seconds
    while any(map(command_of, pids)):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def usual_interrupt() -> None:
    """Gives SIGINT its usual effect, as `preexec_fn`: shells ignore it in what they run in the background."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
