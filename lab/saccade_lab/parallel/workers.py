"""Where work items run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from saccade.errors import InputError

BACKENDS = ("loky", "ray")
RETRIES = 3  # of an item whose process died, before it is given up

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Workers:
    """The processes that work items run in.

    Attributes:
        backend: ``"loky"`` for processes of this machine, ``"ray"`` for those of a Ray cluster.
        jobs: Number of items at the same time. -1: one for each core, of this machine or of the cluster.
            With loky 1 stands for this process, which an item may then end; -1 never does, also on one core.
        address: Address of the Ray cluster. Default: that of the environment variable ``RAY_ADDRESS``, then a
            cluster that runs on this machine, then one that is started here for this run.
        num_threads: Threads of one item, which it reserves on a Ray cluster.

    Raises:
        InputError: An unknown backend, a number out of range, or an address without Ray.

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
        """Whether the items run one after the other in this process."""
        return self.backend == "loky" and self.jobs == 1


#: One item after the other in this process.
ALONE = Workers()


@dataclass(frozen=True)
class Lost:
    """What takes the place of a result if the processes that computed an item died again and again.

    Attributes:
        reason: What is known about it.
    """

    reason: str
