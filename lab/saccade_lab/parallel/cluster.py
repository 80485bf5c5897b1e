"""Items in the processes of a Ray cluster. Those of processes and machines that died are repeated."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import saccade
from saccade.errors import InputError, SaccadeError
from saccade_lab.extras import LAB
from saccade_lab.parallel.files import Shipment, located, pack, place, relocated
from saccade_lab.parallel.workers import RETRIES, Lost, Item, Result, Workers

SECONDS_TO_CONNECT = 10.0


class ClusterError(SaccadeError):
    """Ray cannot go on, for example because the process that this one is connected to is gone."""


@dataclass(frozen=True)
class Job:
    """What all items of a run share. It is sent to each process once.

    Attributes:
        work: See `saccade_lab.parallel.each`.
        shipments: Files and directories, by the absolute paths that `work` has for them.
        version: The saccade that sends it.
    """

    work: Callable[[Any], Any]
    shipments: dict[str, Shipment]
    version: str


def each(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    workers: Workers,
    files: Sequence[str | Path],
) -> Iterator[tuple[Item, Result | Lost]]:
    """As `saccade_lab.parallel.each`.

    Files are put into Ray's object store here; each machine fetches them when its first item begins. A item
    whose process, machine or result was lost is given to Ray again after the others, which leaves time for
    memory to become free. Ray itself would repeat one that ran out of memory without limit.
    """
    LAB.require("ray")
    with connected(workers.address) as ray:
        check_cluster(ray, workers)
        sources, work = located(work, files)
        shipments = {path: pack(source, ray.put) for path, source in sources.items()}
        # In a list, because Ray would replace the reference by the job, once for every item.
        job = [ray.put(Job(work, shipments, saccade.__version__))]
        task = ray.remote(run_item).options(
            num_cpus=workers.num_threads, max_retries=0, scheduling_strategy="SPREAD"
        )
        attempts = [0] * len(items)
        waiting = deque(range(len(items)))
        running: dict[Any, int] = {}
        try:
            while waiting or running:
                while waiting and len(running) < most_at_once(ray, workers):
                    index = waiting.popleft()
                    attempts[index] += 1
                    running[task.remote(job, items[index])] = index
                (done,), _ = ray.wait(list(running), num_returns=1)
                index = running.pop(done)
                result = result_of(ray, done)
                if not isinstance(result, Died):
                    yield items[index], result
                elif attempts[index] <= RETRIES:
                    waiting.append(index)
                else:
                    died = f"its process or machine died in each of {RETRIES + 1} attempts: {result.reason}"
                    yield items[index], Lost(died)
        finally:
            for reference in running:
                with contextlib.suppress(Exception):  # of a cluster that is gone, which another error says
                    ray.cancel(reference)


def run_item(job: list[Any], item: Any) -> Any:
    """What a process of the cluster runs: the work on one item."""
    return received(job[0])(item)


@functools.lru_cache(maxsize=1)
def received(reference: Any) -> Callable[[Any], Any]:
    """The work with the paths of this machine. It is kept for the next item.

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


@dataclass(frozen=True)
class Died:
    """What takes the place of a result if the process or the machine of a item died.

    Attributes:
        reason: What Ray says of it.
    """

    reason: str


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
    """Raises `InputError` if no machine has the cores of one item: Ray would wait for one forever."""
    cores = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    if max(cores, default=0) < workers.num_threads:
        raise InputError(
            f"address: expected a cluster with a machine of at least {workers.num_threads} cores, got "
            f"{', '.join(f'{count:g}' for count in cores) or 'none'}"
        )


def most_at_once(ray: ModuleType, workers: Workers) -> int:
    """Number of items that are handed to Ray. For all cores twice as many, so that none has to wait.

    Machines may join or leave at any time.
    """
    if workers.jobs != -1:
        return workers.jobs
    cores = ray.cluster_resources().get("CPU", 0)
    return max(1, int(2 * cores / workers.num_threads))


def result_of(ray: ModuleType, reference: Any) -> Any:
    """The result of a item, or `Died`.

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
        return Died(str(error).strip().splitlines()[0])
    except gone.RayError as error:
        raise ClusterError(f"ray: {str(error).strip().splitlines()[-1]}") from None
