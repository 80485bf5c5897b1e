"""The one function that runs work items, and the error that names those that are lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from saccade.errors import SaccadeError
from saccade_lab.parallel.workers import Item, Lost, Result, Workers


def each(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    workers: Workers,
    files: Sequence[str | Path] = (),
) -> Iterator[tuple[Item, Result | Lost]]:
    """Computes items, in this process or in others, and yields each with its result when it is done.

    A item whose process or machine died, for whatever reason, is computed again, so its result must not
    depend on how often it is begun. If its processes die ``RETRIES`` + 1 times, its result is ``Lost``, and
    the others go on.

    Args:
        work: Function from an item to its result. In other processes it is pickled, and keeps nothing from
            one call to the next but what its module keeps.
        items: Arguments of ``work``.
        workers: Where they run.
        files: Files and directories that ``work`` reads. Its fields name them by strings or paths, also in
            dataclasses, sequences and mappings; relative paths and links mean what they mean here. They are
            brought to each machine of a cluster once, and ``work`` then gets their paths there. Those that do
            not exist are left as they are.

    Yields:
        Item and result, in the order of ``items`` if ``workers.alone``, otherwise in any order.

    Raises:
        MissingExtraError: Joblib or ray is needed and not installed.
        InputError: There is no cluster at the address, or its machines have another version of saccade.
        Exception: What ``work`` raised. Items that were begun are abandoned.

    Example:
        >>> sorted(each(abs, [-1, 2, -3], Workers()))
        [(-3, 3), (-1, 1), (2, 2)]
    """
    if workers.alone:
        return ((item, work(item)) for item in items)
    if workers.backend == "ray":
        from saccade_lab.parallel import cluster

        return cluster.each(work, items, workers, files)
    from saccade_lab.parallel import local

    return local.each(work, items, workers.jobs)


def check_lost(lost: Sequence[str], total: int) -> None:
    """Checks that no episode is lost.

    Args:
        lost: Each lost episode and the reason, in words.
        total: Number of episodes.

    Raises:
        SaccadeError: There are some; the message says how many and names three.
    """
    if lost:
        raise SaccadeError(f"{len(lost)} of {total} episodes are missing: {'; '.join(lost[:3])}")
