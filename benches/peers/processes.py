"""One process per contender, or per group that shares weights, and rounds in which contenders take turns.

Only one contender runs at a time, so idle threads of another do not disturb it, and no allocator is shared.
In a round every contender does every work once, in an order that rotates, so that a drift of the clock
affects all.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import numpy as np

from benches.peers import inputs, policy_inputs
from benches.peers.cases import Case
from benches.peers.contenders import CONTENDERS
from benches.peers.engines import Built, Task
from benches.warm import warm_up

PAUSE = 0.2  # seconds of rest before a measurement; the threads of the one before have gone to sleep by then
SAMPLE = 0.05  # minimum seconds of a sample: long compared with the clock's resolution and a scheduler tick


@dataclass(frozen=True)
class Ready:
    """A contender that has built its works.

    Attributes:
        error: Largest absolute difference from the reference.
        scale: Largest absolute value of the reference.
        notes: The engine's.
        works: The works that it can time.
    """

    error: float
    scale: float
    notes: str
    works: tuple[str, ...]


class KilledError(RuntimeError):
    """A contender's process was killed from outside, for instance for want of memory."""


KILLING = frozenset({signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
"""Signals from outside; those that follow from what a process did, such as SIGSEGV, are its own failures."""


def worker(pipe: Connection, names: tuple[str, ...], case: Case, work_folder: Path) -> None:
    """The process of one contender, or of several that share it: builds and says for each in turn whether it
    is ready, then does what each message, a name and a work, says and answers with seconds.
    """
    shared: dict[str, Any] = {}
    built: dict[str, Built] = {}
    for name in names:
        try:
            built[name], ready = build(name, case, work_folder, shared)
            pipe.send(ready)
        except Exception as error:
            pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))
    repeats: dict[str, dict[str, int]] = {name: {} for name in names}
    try:
        while (asked := pipe.recv()) is not None:
            name, work = asked
            warm_up(built[name].works[work])
            pipe.send(seconds_of(built[name], work, repeats[name]))
    except Exception as error:
        pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))


def build(name: str, case: Case, work_folder: Path, shared: dict[str, Any]) -> tuple[Built, Ready]:
    """The works of a contender, each called once: the first call allocates and may compile."""
    contender = CONTENDERS[name]
    graphs = graphs_folder(case, work_folder)
    graphs.mkdir(parents=True, exist_ok=True)
    if case.piece == "policy":
        arrays = policy_inputs.expected_of(case, work_folder)
        source = policy_inputs.source_of(case, work_folder)
    else:
        arrays = inputs.expected_of(case, work_folder)
        # Values are the same in both; who holds them in fewer bits has less to read.
        stored = "float32" if "float32" in contender.options.values() else "bfloat16"
        source = inputs.checkpoint(case, work_folder, stored)
    task = Task(case, dict(contender.options), source, arrays, graphs, shared)
    engine = importlib.import_module(f"benches.peers.engines.{contender.engine}")
    built: Built = engine.build(task)
    error, scale = difference(built.result(), arrays["expected"])
    if not built.is_warm:
        for work in built.works.values():
            work()
    return built, Ready(error, scale, built.notes, tuple(built.works))


def difference(result: Any, expected: Any) -> tuple[float, float]:
    """Largest absolute difference and largest absolute expected value.

    Raises:
        ValueError: another shape, or a value that is not finite.
    """
    if result.shape != expected.shape:
        raise ValueError(f"the result has shape {result.shape}, expected {expected.shape}")
    if not np.isfinite(result).all():
        raise ValueError("the result has values that are not finite")
    return float(np.abs(result - expected).max()), float(np.abs(expected).max())


def seconds_of(built: Built, work: str, repeats: dict[str, int]) -> float:
    """Seconds of one call of a layer or piece; the mean over a sample if calls are short."""
    run, times = built.works[work], repeats.get(work, 1)
    start = time.perf_counter()
    for _ in range(times):
        run()
    seconds = (time.perf_counter() - start) / times
    if work not in repeats:
        repeats[work] = max(1, int(SAMPLE / seconds))
        if repeats[work] > 1:
            return seconds_of(built, work, repeats)
    return seconds / built.calls.get(work, 1)


def graphs_folder(case: Case, work_folder: Path) -> Path:
    """Folder of the graphs of a case, independent of its threads and steps."""
    parts = (case.size, case.piece, case.num_vl_tokens, case.num_future_tokens, case.batch, case.samples)
    if case.piece == "policy":
        return work_folder / "graphs" / f"{case.size}-policy-{case.release}"
    return work_folder / "graphs" / "-".join(map(str, parts))


def prepare(case: Case, work_folder: Path) -> None:
    """Writes checkpoint and expected result in a separate process, so that this one stays small."""
    process = multiprocessing.get_context("spawn").Process(target=write_inputs, args=(case, work_folder))
    process.start()
    process.join()
    if process.exitcode != 0:
        raise SystemExit(f"bench-peers: the inputs of {case} could not be made")


def write_inputs(case: Case, work_folder: Path) -> None:
    """Runs in the process of `prepare`."""
    if case.piece == "policy":
        policy_inputs.expected_of(case, work_folder)
        return
    inputs.expected_of(case, work_folder)
    inputs.checkpoint(case, work_folder, "bfloat16")


@contextlib.contextmanager
def contenders(
    names: list[str], case: Case, work_folder: Path
) -> Iterator[tuple[dict[str, Connection], dict[str, Ready | RuntimeError]]]:
    """Processes that have built their works, and what each contender said, an error too.

    They build at the same time. Only those that are ready have a pipe, which contenders of one process share.
    """
    spawn = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    said: dict[str, Ready | RuntimeError] = {}
    ours: dict[str, Connection] = {}
    processes: dict[str, SpawnProcess] = {}
    try:
        note(f"{case}: building {', '.join(names)}")
        members = sharing(names)
        for first, together in members.items():
            ours[first], theirs = spawn.Pipe()
            process = spawn.Process(
                target=worker, name=first, args=(theirs, together, case, work_folder), daemon=True
            )
            with environment_of(first, case, work_folder):
                process.start()
            theirs.close()
            processes[first] = process
        for first, together in members.items():
            for name in together:
                try:
                    said[name] = ours[first].recv()
                except EOFError:
                    processes[first].join()
                    said[name] = ended(processes[first].exitcode)
                if isinstance(said[name], Ready):
                    pipes[name] = ours[first]
                else:
                    note(f"{name} failed: {said[name]}")
        yield pipes, said
    finally:
        for pipe in ours.values():  # also to those that are not ready, which wait, too
            with contextlib.suppress(OSError):
                pipe.send(None)
        for process in processes.values():
            process.join(timeout=10)
            process.kill()
            process.join()


def sharing(names: list[str]) -> dict[str, tuple[str, ...]]:
    """The contenders of each process, by the first of them."""
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(CONTENDERS[name].process or name, []).append(name)
    return {together[0]: tuple(together) for together in found.values()}


def ended(status: int | None) -> RuntimeError:
    """What is said of a process that ended with this exit status, without a word of its own."""
    if status is not None and -status in KILLING:
        return KilledError(f"the process was killed by signal {-status}; the next run tries again")
    return RuntimeError(f"the process ended with status {status}")


@contextlib.contextmanager
def environment_of(name: str, case: Case, work_folder: Path) -> Iterator[None]:
    """Environment variables of a contender's process."""
    before = os.environ.copy()
    os.environ.update(
        {
            "OMP_NUM_THREADS": str(case.threads),
            "MKL_NUM_THREADS": str(case.threads),
            "SACCADE_NUM_THREADS": str(case.threads),
            "THP_MEM_ALLOC_ENABLE": "1",  # torch then asks for huge pages
            "TORCHINDUCTOR_CACHE_DIR": str((work_folder / "inductor").absolute()),
            **CONTENDERS[name].environment,
        }
    )
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def round_of(
    pipes: dict[str, Connection], said: Mapping[str, Any], works: tuple[str, ...], index: int
) -> dict[str, dict[str, float]]:
    """Seconds of every contender and work, once; contender number `index` begins.

    One whose process ends meanwhile has no seconds, and is taken out of `pipes`.
    """
    names = list(pipes)
    turn = index % len(names)
    seconds: dict[str, dict[str, float]] = {}
    for name in names[turn:] + names[:turn]:
        try:
            seconds[name] = {
                work: timed(pipes[name], name, work) for work in works if work in said[name].works
            }
        except (EOFError, ConnectionError):
            note(f"{name}: the process ended in this round; the next run continues here")
            del pipes[name]
    return seconds


def timed(pipe: Connection, name: str, work: str) -> float:
    """Seconds of one work of a contender, after a pause."""
    time.sleep(PAUSE)
    pipe.send((name, work))
    answer = pipe.recv()
    if isinstance(answer, Exception):
        raise answer
    return float(answer)


def note(message: str) -> None:
    """Prints progress on stderr."""
    print(f"bench-peers: {message}", file=sys.stderr, flush=True)
