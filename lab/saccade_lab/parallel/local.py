"""Items in processes of this machine, by joblib's loky. When a process dies, its items are repeated."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any

from saccade_lab.extras import LAB
from saccade_lab.parallel.workers import RETRIES, Item, Lost, Result

LOST = Lost(f"a worker process died in each of {RETRIES + 1} attempts, perhaps out of memory")
IDLE = 300  # seconds after which a process that has nothing to do ends
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # of torch and NumPy


def each(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int
) -> Iterator[tuple[Item, Result | Lost]]:
    """As ``saccade_lab.parallel.each``, in ``jobs`` processes, never in this one; -1 for one per core.

    loky says that a process died, but not in which item. The items that were given out then wait until the
    others are done, and are computed in one process, one after the other: now it is known which one ends its
    process, and items that only ran at the same time are not given up.
    """
    LAB.require("joblib")
    from joblib import cpu_count

    processes = cpu_count() if jobs == -1 else jobs
    suspects: list[int] = []
    left = dict.fromkeys(range(len(items)))
    while left:
        for index, result in _spread(work, items, list(left), processes):
            del left[index]
            if result is LOST:
                suspects.append(index)
            else:
                yield items[index], result
    for index in suspects:
        yield items[index], _alone(work, items, index)


def _spread(
    work: Callable[[Item], Result], items: Sequence[Item], chosen: Sequence[int], processes: int
) -> Iterator[tuple[int, Result | Lost]]:
    """Index and result of chosen items. If a process dies, those in progress are ``LOST``: the end."""
    from joblib.externals.loky import get_reusable_executor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    threads = {name: os.environ.get(name, str(_threads(processes))) for name in THREADS}
    pool = get_reusable_executor(max_workers=processes, timeout=IDLE, env=threads)
    waiting = iter(chosen)
    running: dict[Any, int] = {}
    try:
        while True:
            # Twice as many as processes, so that none has to wait for its next item.
            for index in islice(waiting, 2 * processes - len(running)):
                running[pool.submit(work, items[index])] = index
            if not running:
                return
            for done in wait(running, return_when=FIRST_COMPLETED).done:
                result = done.result()
                yield running.pop(done), result
    except BrokenProcessPool as error:
        # loky also raises this for an item that a process cannot unpickle, or a result that it cannot pickle.
        if not isinstance(error, TerminatedWorkerError):
            raise
        for index in running.values():
            yield index, LOST
        running.clear()
    finally:
        if running:  # of a caller that wants no more, or of work that raised an error
            pool.shutdown(wait=False, kill_workers=True)


def _threads(processes: int) -> int:
    """Threads that libraries of each process may use."""
    from joblib import cpu_count

    return max(1, int(cpu_count()) // processes)


def _alone(work: Callable[[Item], Result], items: Sequence[Item], index: int) -> Result | Lost:
    """The result of one item in one process that does nothing else at the same time."""
    for _ in range(RETRIES):  # one attempt has been made
        ((_, result),) = _spread(work, items, [index], 1)
        if result is not LOST:
            return result
    return LOST
