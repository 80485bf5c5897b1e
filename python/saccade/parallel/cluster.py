"""Pieces in the processes of a Ray cluster. Ray repeats the pieces of processes and machines that died."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import saccade
from saccade import _extras
from saccade.errors import InputError, SaccadeError
from saccade.parallel.files import Shipment, pack, place, relocated
from saccade.parallel.workers import RETRIES, Lost, Piece, Result, Workers

SECONDS_TO_CONNECT = 10.0


class ClusterError(SaccadeError):
    """Ray cannot go on, for example because the process that this one is connected to is gone."""


@dataclass(frozen=True)
class Job:
    """What all pieces of a run share. It is sent to each process once.

    Attributes:
        work: See `saccade.parallel.each`.
        shipments: Files and directories, by the paths that `work` has for them.
        version: The saccade that sends it.
    """

    work: Callable[[Any], Any]
    shipments: dict[str, Shipment]
    version: str


def each(
    work: Callable[[Piece], Result],
    pieces: Sequence[Piece],
    workers: Workers,
    files: Sequence[str | Path],
) -> Iterator[tuple[Piece, Result | Lost]]:
    """As `saccade.parallel.each`.

    Files are put into Ray's object store here; each machine fetches them when its first piece begins. Ray
    itself repeats pieces whose process, machine or result was lost, at most `RETRIES` times each.
    """
    _extras.require("ray")
    with connected(workers.address) as ray:
        check_cluster(ray, workers)
        paths = [path for path in dict.fromkeys(map(str, files)) if Path(path).exists()]
        shipments = {path: pack(Path(path), ray.put) for path in paths}
        # In a list, because Ray would replace the reference by the job, once for every piece.
        job = [ray.put(Job(work, shipments, saccade.__version__))]
        task = ray.remote(run_piece).options(
            num_cpus=workers.num_threads, max_retries=RETRIES, scheduling_strategy="SPREAD"
        )
        running: dict[Any, Piece] = {}
        waiting = iter(pieces)
        try:
            while True:
                for piece in waiting:
                    running[task.remote(job, piece)] = piece
                    if len(running) >= most_at_once(ray, workers):
                        break
                if not running:
                    return
                (done,), _ = ray.wait(list(running), num_returns=1)
                yield running.pop(done), result_of(ray, done)
        finally:
            for reference in running:
                with contextlib.suppress(Exception):  # of a cluster that is gone, which another error says
                    ray.cancel(reference)


def run_piece(job: list[Any], piece: Any) -> Any:
    """What a process of the cluster runs: the work on one piece."""
    return received(job[0])(piece)


@functools.lru_cache(maxsize=1)
def received(reference: Any) -> Callable[[Any], Any]:
    """The work with the paths of this machine. It is kept for the next piece.

    Raises:
        InputError: this machine has another version of saccade.
        OSError: files cannot be written.
    """
    import ray

    job: Job = ray.get(reference)
    if job.version != saccade.__version__:
        raise InputError(
            f"saccade: expected version {job.version} on every machine of the cluster, got "
            f"{saccade.__version__} on {os.uname().nodename}"
        )
    places = {path: place(shipment, ray.get) for path, shipment in job.shipments.items()}
    work: Callable[[Any], Any] = relocated(job.work, places)
    return work


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[ModuleType]:
    """Ray, connected to a cluster; disconnected at the end, unless it was connected before.

    Raises:
        InputError: there is no cluster at the address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster that is started here reports to nobody
    import ray

    if ray.is_initialized():
        yield ray
        return
    address = address or os.environ.get("RAY_ADDRESS")
    try:
        check_reachable(address)
        # What processes print would run through the progress bar.
        ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"address: no Ray cluster at {address or 'this machine'}: {reason}") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def check_reachable(address: str | None) -> None:
    """Raises `OSError` if nothing listens at `HOST:PORT`, of which Ray would say so after minutes."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), SECONDS_TO_CONNECT).close()


def check_cluster(ray: ModuleType, workers: Workers) -> None:
    """Raises `InputError` if no machine has the cores of one piece: Ray would wait for one forever."""
    cores = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    if max(cores, default=0) < workers.num_threads:
        raise InputError(
            f"address: expected a cluster with a machine of at least {workers.num_threads} cores, got "
            f"{', '.join(f'{count:g}' for count in cores) or 'none'}"
        )


def most_at_once(ray: ModuleType, workers: Workers) -> int:
    """Number of pieces that are handed to Ray. For all cores twice as many, so that none has to wait.

    Machines may join or leave at any time.
    """
    if workers.jobs != -1:
        return workers.jobs
    cores = ray.cluster_resources().get("CPU", 0)
    return max(1, int(2 * cores / workers.num_threads))


def result_of(ray: ModuleType, reference: Any) -> Any:
    """The result of a piece, or `Lost`.

    Raises:
        ClusterError: Ray cannot go on.
        Exception: what the work raised.
    """
    gone = ray.exceptions
    try:
        return ray.get(reference)
    except gone.RayTaskError as error:
        if isinstance(error.cause, Exception):
            raise error.cause from None
        raise
    except (
        gone.WorkerCrashedError,
        gone.NodeDiedError,
        gone.OutOfMemoryError,
        gone.ObjectLostError,
    ) as error:
        reason = str(error).strip().splitlines()[0]
        return Lost(f"its process or machine died in each of {RETRIES + 1} attempts: {reason}")
    except gone.RayError as error:
        raise ClusterError(f"ray: {str(error).strip().splitlines()[-1]}") from None
