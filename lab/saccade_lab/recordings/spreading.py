"""Episodes of a command of saccade in several processes, of this machine or of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from saccade_lab.parallel import Lost, Workers, check_lost, each
from saccade_lab.parallel.workers import Result


def spread(
    work: Callable[[int], Result],
    episodes: Sequence[int],
    *,
    jobs: int,
    backend: str,
    address: str | None,
    num_threads: int | None,
    files: Sequence[Path],
) -> Iterator[tuple[int, Result]]:
    """Computes episodes, and yields each when it is done.

    Args:
        work: Function from an episode to its record.
        episodes: Its arguments.
        jobs, backend, address: As ``Workers``.
        num_threads: Threads of one episode; None for 1.
        files: Files and directories that ``work`` reads, which are brought to each machine.

    Raises:
        MissingExtraError, InputError: As ``saccade_lab.parallel.each``.
        SaccadeError: Processes died again and again; raised when all other episodes are done.
    """
    workers = Workers(backend, jobs, address, num_threads or 1)
    lost = []
    for episode, record in each(work, episodes, workers, files):
        if isinstance(record, Lost):
            lost.append(f"episode {episode}: {record.reason}")
        else:
            yield episode, record
    check_lost(lost, len(episodes))
