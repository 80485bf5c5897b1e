"""Items in the processes of a Ray cluster. Those of processes and machines that died are repeated."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import ModuleType
from typing import Any

from saccade._internal.environment import arithmetic
from saccade.errors import InputError, SaccadeError
from saccade_lab.extras import LAB
from saccade_lab.parallel.files import Shipment, located, pack, place, relocated
from saccade_lab.parallel.workers import RETRIES, Item, Lost, Result, Workers

SECONDS_TO_CONNECT = 10.0


class ClusterError(SaccadeError):
    """Ray cannot go on, for example because the process that this one is connected to is gone."""


@dataclass(frozen=True)
class Job:
    """What all items of a run share. It is sent to each process once.

    Attributes:
        work: See ``saccade_lab.parallel.each``.
        shipments: Files and directories, by the absolute paths that ``work`` has for them.
        arithmetic: What decides the bits of results where it is sent from.
    """

    work: Callable[[Any], Any]
    shipments: dict[str, Shipment]
    arithmetic: dict[str, Any]


def each(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    workers: Workers,
    files: Sequence[str | Path],
) -> Iterator[tuple[Item, Result | Lost]]:
    """As ``saccade_lab.parallel.each``.

    Files are put into Ray's object store here; each machine fetches them when its first item begins. Ray's
    ``runtime_env`` cannot bring them: it is one message of at most 512 MiB. Ray repeats an item whose
    process, machine or result was lost.
    """
    LAB.require("ray")
    with connected(workers.address) as ray:
        check_cluster(ray, workers)
        sources, work = located(work, files)
        shipments = {path: pack(source, ray.put) for path, source in sources.items()}
        # In a list, because Ray would replace the reference by the job, once for every item.
        job = [ray.put(Job(work, shipments, arithmetic()))]
        task = ray.remote(run_item).options(
            num_cpus=workers.num_threads, max_retries=RETRIES, scheduling_strategy="SPREAD"
        )
        waiting = iter(items)
        running: dict[Any, Any] = {}
        try:
            while True:
                for item in islice(waiting, max(0, most_at_once(ray, workers) - len(running))):
                    running[task.remote(job, item)] = item
                if not running:
                    return
                (done,), _ = ray.wait(list(running), num_returns=1)
                item = running.pop(done)
                yield item, result_of(ray, done)
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
        InputError: This machine has another version of saccade, or other instructions.
        OSError: Files cannot be written.
    """
    import ray

    job: Job = ray.get(reference)
    check_arithmetic(job.arithmetic)
    places = {path: place(shipment, ray.get) for path, shipment in job.shipments.items()}
    work: Callable[[Any], Any] = relocated(job.work, places)
    return work


def check_arithmetic(expected: Mapping[str, Any]) -> None:
    """Checks that this machine computes the bits of the one that sends the work.

    Builds are not compared: machines that compile saccade themselves may each have another one.

    Raises:
        InputError: It has another version of saccade, or other instructions.
    """
    here, node = arithmetic(), os.uname().nodename
    if expected["saccade"] != here["saccade"]:
        raise InputError(
            f"saccade: expected version {expected['saccade']} on every machine of the cluster, got "
            f"{here['saccade']} on {node}"
        )
    wanted, got = (
        f"{one['instruction_set']} with dot products {', '.join(one['dot_products']) or 'none'}"
        for one in (expected, here)
    )
    if wanted != got:
        raise InputError(
            f"instructions: expected {wanted} on every machine of the cluster, as where the command runs, "
            f"got {got} on {node}: set SACCADE_ISA on all of them, see docs/parallel.md"
        )


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[ModuleType]:
    """Ray, connected to a cluster; disconnected at the end, unless it was connected before.

    Raises:
        InputError: There is no cluster at the address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster that is started here reports to nobody
    # Otherwise an item that runs out of memory is repeated without limit. Read when this process connects.
    os.environ.setdefault("RAY_task_oom_retries", str(RETRIES))
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
    """Raises ``OSError`` if nothing listens at ``HOST:PORT``, of which Ray would say so after minutes."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), SECONDS_TO_CONNECT).close()


def check_cluster(ray: ModuleType, workers: Workers) -> None:
    """Raises ``InputError`` if no machine has the cores of one item: Ray would wait for one forever."""
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
    """The result of an item, or ``Lost`` if its processes died again and again.

    Raises:
        ClusterError: Ray cannot go on.
        Exception: What the work raised.
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
