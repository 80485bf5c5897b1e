"""The processes of `benches.latency`: contenders that have built their heads, and random weights for them."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import saccade
from benches.peers import inputs
from benches.peers.cases import Case
from benches.peers.contenders import CONTENDERS
from benches.peers.engines import Task
from benches.warm import warm_up
from saccade_lab.random_checkpoint.head import write_head


def worker(pipe: Connection, name: str, case: Case, source: Path, scratch: Path) -> None:
    """A contender's process: builds its head, then answers `(work, count)` with `count` times in seconds."""
    try:
        arrays = inputs.inputs_of(case, saccade.HeadConfig.from_file(source / "config.json"))
        arrays["expected"] = arrays["noise"]  # of the result's shape
        if CONTENDERS[name].engine not in ("saccade_head", "lerobot"):
            from saccade_lab.reference import ActionHead

            arrays |= inputs.times_of(ActionHead.from_pretrained(source), case.steps)
        engine = importlib.import_module(f"benches.peers.engines.{CONTENDERS[name].engine}")
        works = dict(engine.build(Task(case, dict(CONTENDERS[name].options), source, arrays, scratch)).works)
        encode, sample = works["encode"], works["sample"]
        works["both"] = lambda: (encode(), sample())
        for work in works.values():
            work()
        pipe.send("ready")
        while (asked := pipe.recv()) is not None:
            work, times = asked
            warm_up(works[work])
            pipe.send([timed(works[work]) for _ in range(times)])
    except Exception as error:
        pipe.send(RuntimeError(f"{name}: {type(error).__name__}: {error}"))


def timed(work: Callable[[], Any]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


class Contenders:
    """Processes that have built their heads; `ask` one of them for times."""

    def __init__(self, names: list[str], case: Case, source: Path, scratch: Path) -> None:
        self._pipes: dict[str, Connection] = {}
        self._processes = []
        spawn = multiprocessing.get_context("spawn")
        for name in names:
            note(f"building {name}, {case.threads} threads")
            self._pipes[name], theirs = spawn.Pipe()
            process = spawn.Process(target=worker, args=(theirs, name, case, source, scratch), daemon=True)
            with environment({"OMP_NUM_THREADS": str(case.threads), "THP_MEM_ALLOC_ENABLE": "1"}):
                process.start()
            theirs.close()  # so that the end of the process ends the pipe
            self._processes.append(process)
            self._answer(name)

    def _answer(self, name: str) -> Any:
        try:
            answer = self._pipes[name].recv()
        except (EOFError, OSError):
            raise RuntimeError(f"{name}: its process ended, perhaps for lack of memory") from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def ask(self, name: str, work: str, times: int) -> list[float]:
        """Seconds of each of `times` consecutive calls, after calls that warm up."""
        self._pipes[name].send((work, times))
        return list(self._answer(name))

    def __enter__(self) -> Contenders:
        return self

    def __exit__(self, *error: object) -> None:
        for pipe in self._pipes.values():
            with contextlib.suppress(OSError):
                pipe.send(None)
        for process in self._processes:
            process.join(timeout=10)
            process.kill()


@contextlib.contextmanager
def environment(added: dict[str, str]) -> Iterator[None]:
    """The environment of processes started within; torch reads its settings when it is imported."""
    before = os.environ.copy()
    os.environ.update(added)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def checkpoint(config: dict[str, Any], folder: Path) -> Path:
    """Random weights, written under a temporary name if they are not there yet, then renamed."""
    if not folder.exists():
        part = folder.with_name(folder.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        write_head(part, config, dtype="F32")  # what all contenders hold in float32
        part.rename(folder)
        # While they are still written the rest is slower: on a Zen 5, 671 instead of 1080 chunks/s of one
        # caller.
        os.sync()
    return folder


def note(message: str) -> None:
    """Prints progress on stderr."""
    print(f"latency: {message}", file=sys.stderr, flush=True)
