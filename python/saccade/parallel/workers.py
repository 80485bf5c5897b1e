"""Where pieces of work run, and the one function that runs them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from saccade.errors import InputError

BACKENDS = ("loky", "ray")
RETRIES = 3  # of a piece whose process died, before it is given up

Piece = TypeVar("Piece")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """The processes that pieces of work run in.

    Attributes:
        backend: `"loky"` for processes of this machine, `"ray"` for those of a Ray cluster.
        jobs: Number of pieces at the same time. -1: one for each core, of this machine or of the cluster.
        address: Address of the Ray cluster. Default: that of the environment variable `RAY_ADDRESS`, then a
            cluster that runs on this machine, then one that is started here for this run.
        num_threads: Threads of one piece, which it reserves on a Ray cluster.

    Raises:
        InputError: an unknown backend, a number out of range, or an address without Ray.

    Example:
        >>> Workers().alone, Workers(jobs=4).alone, Workers("ray", jobs=-1).alone
        (True, False, False)
    """

    backend: str = "loky"
    jobs: int = 1
    address: str | None = None
    num_threads: int = 1

    def __post_init__(self) -> None:
        if self.backend not in BACKENDS:
            raise InputError(f"backend: unknown name {self.backend!r}, expected one of {', '.join(BACKENDS)}")
        if self.jobs < 1 and self.jobs != -1:
            raise InputError(f"jobs: given {self.jobs}, expected at least 1, or -1 for all cores")
        if self.address is not None and self.backend != "ray":
            raise InputError(f"address: only with the backend ray, given {self.backend}")
        if self.num_threads < 1:
            raise InputError(f"num_threads: given {self.num_threads}, expected at least 1")

    @property
    def alone(self) -> bool:
        """Whether the pieces run one after the other in this process."""
        return self.backend == "loky" and self.jobs == 1


#: One piece after the other in this process.
ALONE = Workers()


@dataclass(frozen=True)
class Lost:
    """What takes the place of a result if the processes that computed a piece died again and again.

    Attributes:
        reason: What is known about it.
    """

    reason: str


def each(
    work: Callable[[Piece], Result],
    pieces: Sequence[Piece],
    workers: Workers,
    files: Sequence[str | Path] = (),
) -> Iterator[tuple[Piece, Result | Lost]]:
    """Computes pieces, in this process or in others, and yields each with its result when it is done.

    A piece whose process or machine died is computed again, so its result must not depend on how often it is
    begun. If its processes die `RETRIES` + 1 times, its result is `Lost`, and the others go on.

    Args:
        work: function from a piece to its result. In other processes it is pickled, and keeps nothing from
            one call to the next but what its module keeps.
        pieces: arguments of `work`.
        workers: where they run.
        files: files and directories that `work` reads, exactly as its fields name them: strings or paths,
            also in dataclasses, sequences and mappings. They are brought to each machine of a cluster once,
            and `work` then gets their paths there. Those that do not exist are left as they are.

    Yields:
        Piece and result, in the order of `pieces` if `workers.alone`, otherwise in any order.

    Raises:
        MissingExtraError: joblib or ray is needed and not installed.
        InputError: there is no cluster at the address, or its machines have another version of saccade.
        Exception: what `work` raised. Pieces that were begun are abandoned.

    Example:
        >>> sorted(each(abs, [-1, 2, -3], Workers()))
        [(-3, 3), (-1, 1), (2, 2)]
    """
    if workers.alone:
        return ((piece, work(piece)) for piece in pieces)
    if workers.backend == "ray":
        from saccade.parallel import cluster

        return cluster.each(work, pieces, workers, files)
    from saccade.parallel import local

    return local.each(work, pieces, workers.jobs)
