"""Pieces in processes of this machine, by joblib. A process that dies costs its piece a retry."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from saccade import _extras
from saccade.parallel.workers import RETRIES, Lost, Piece, Result

LOST = f"a worker process died in each of {RETRIES + 1} attempts, perhaps out of memory"


def each(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int
) -> Iterator[tuple[Piece, Result | Lost]]:
    """As `saccade.parallel.each`, in `jobs` processes; -1 for one per core.

    joblib says that a process died, but not in which piece. The pieces that were given out then wait until
    the others are done, and are computed in one process, one after the other: now it is known which one ends
    its process, and pieces that only ran at the same time are not given up.
    """
    _extras.require("joblib")
    suspects: list[int] = []
    left = list(range(len(pieces)))
    while left:
        given: list[int] = []
        try:
            for index, result in _spread(work, pieces, left, jobs, given):
                given.remove(index)
                left.remove(index)
                yield pieces[index], result
        except BrokenProcessPool:
            suspects += given
            left = [index for index in left if index not in given]
    for index in suspects:
        yield pieces[index], _alone(work, pieces, index)


def _spread(
    work: Callable[[Piece], Result],
    pieces: Sequence[Piece],
    chosen: Sequence[int],
    jobs: int,
    given: list[int],
) -> Iterator[tuple[int, Result]]:
    """Index and result of chosen pieces. `given` receives the indices that were given out.

    Raises:
        BrokenProcessPool: a process died.
    """
    import joblib

    def tasks() -> Iterator[Any]:
        for index in list(chosen):
            given.append(index)
            yield joblib.delayed(_Numbered(work))(index, pieces[index])

    # A process that is alone must not be this one, which has to survive.
    parallel = joblib.Parallel(n_jobs=jobs, backend="loky", return_as="generator_unordered", batch_size=1)
    yield from parallel(tasks())


def _alone(work: Callable[[Piece], Result], pieces: Sequence[Piece], index: int) -> Result | Lost:
    """The result of one piece in one process that does nothing else at the same time."""
    for _ in range(RETRIES):  # one attempt has been made
        try:
            # Two processes, of which one has nothing to do: with one, joblib would work in this process.
            ((_, result),) = _spread(work, pieces, [index], 2, [])
            return result
        except BrokenProcessPool:
            continue
    return Lost(LOST)


@dataclass(frozen=True)
class _Numbered:
    """`work` that also returns the index of its piece."""

    work: Callable[[Any], Any]

    def __call__(self, index: int, piece: Any) -> tuple[int, Any]:
        return index, self.work(piece)
