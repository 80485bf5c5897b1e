"""Contenders, each in a process of its own: saccade's precisions, and transformers in two dtypes.

A contender builds its works, which are calls by name, then answers the name of a work with its seconds.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from benches.backbone import setup
from benches.warm import warm_up
from saccade._internal.arrays import Float32Array

PAUSE = 0.2  # seconds of rest before a measurement; the threads of the one before have gone to sleep by then

#: Contenders that run together. Those that are compiled need twice the memory of their weights.
GROUPS = {
    "usual": (
        "saccade-float32",
        "saccade-bfloat16",
        "saccade-int8",
        "transformers-float32",
        "transformers-bfloat16",
    ),
    "compiled-bfloat16": ("saccade-bfloat16", "compiled-bfloat16"),
    "compiled-float32": ("saccade-float32", "compiled-float32"),
}


@dataclass(frozen=True)
class Task:
    """What a contender builds."""

    name: str
    checkpoint: Path
    threads: int
    views: tuple[int, ...]
    work: Path


Call = Callable[[], Float32Array]


def works_of(task: Task) -> dict[str, Call]:
    """The calls of a contender: `"<views>"`, or `"<attention>, <views>"` for transformers. Each returns the
    features.
    """
    engine, precision = task.name.split("-")
    inputs = {views: setup.inputs_of(setup.sizes_of(task.checkpoint), views) for views in task.views}
    if engine == "saccade":
        import saccade

        backbone = saccade.Backbone.from_pretrained(
            task.checkpoint, precision=precision, num_threads=task.threads
        )

        def ours(views: int) -> Call:
            return lambda: np.asarray(backbone(inputs[views]).backbone_features)

        return {str(views): ours(views) for views in task.views}
    import torch

    from benches.backbone import peer

    torch.set_num_threads(task.threads)
    dtype = getattr(torch, precision)
    model = peer.Peer.load(task.checkpoint, setup.sizes_of(task.checkpoint), dtype)
    run: Any = model
    if engine == "compiled":
        import torch._inductor.config as inductor

        inductor.freezing = True  # weights become constants, packed for the product kernels
        run = torch.compile(model, dynamic=False)

    def theirs(attention: str, views: int) -> Call:
        given = peer.arguments(inputs[views], dtype)

        def call() -> Float32Array:
            model.use_attention(attention)
            # Freezing asks for no_grad; eager code is a little faster in inference mode.
            with torch.no_grad() if engine == "compiled" else torch.inference_mode():
                features: Float32Array = run(*given).float().numpy()
                return features

        return call

    kinds = ("sdpa",) if engine == "compiled" else ("sdpa", "eager")
    return {f"{kind}, {views}": theirs(kind, views) for kind in kinds for views in task.views}


def worker(pipe: Connection, task: Task) -> None:
    """A contender's process."""
    try:
        works = works_of(task)
        errors = {}
        for name, call in works.items():  # the first call allocates and may compile; it is not timed
            expected = setup.expected(task.checkpoint, int(name.split(", ")[-1]), task.work)
            errors[name] = float(np.abs(call() - expected).max() / np.abs(expected).max())
        pipe.send(errors)
        while (asked := pipe.recv()) is not None:
            warm_up(works[asked])
            start = time.perf_counter()
            works[asked]()
            pipe.send(time.perf_counter() - start)
    except Exception as error:
        pipe.send(RuntimeError(f"{type(error).__name__}: {error}"))


@contextlib.contextmanager
def contenders(tasks: list[Task]) -> Iterator[tuple[dict[str, Connection], dict[str, Any]]]:
    """Processes that have built their works one after the other, and what each said: the error of each work
    relative to the largest feature, or why it failed. Only those that are ready have a pipe.
    """
    spawn = multiprocessing.get_context("spawn")
    pipes: dict[str, Connection] = {}
    said: dict[str, Any] = {}
    processes = []
    try:
        for task in tasks:
            note(f"building {task.name}, {task.threads} threads")
            ours, theirs = spawn.Pipe()
            process = spawn.Process(target=worker, args=(theirs, task), daemon=True)
            with environment(task):
                process.start()
            theirs.close()
            processes.append(process)
            try:
                said[task.name] = ours.recv()
            except EOFError:
                process.join()
                said[task.name] = RuntimeError(f"the process ended with status {process.exitcode}")
            if isinstance(said[task.name], Exception):
                note(f"{task.name} failed: {said[task.name]}")
            else:
                pipes[task.name] = ours
        yield pipes, said
    finally:
        for pipe in pipes.values():
            with contextlib.suppress(OSError):
                pipe.send(None)
        for process in processes:
            process.join(timeout=10)
            process.kill()
            process.join()


@contextlib.contextmanager
def environment(task: Task) -> Iterator[None]:
    """Environment variables of a contender's process."""
    before = os.environ.copy()
    os.environ.update(
        {
            "OMP_NUM_THREADS": str(task.threads),
            "MKL_NUM_THREADS": str(task.threads),
            "SACCADE_NUM_THREADS": str(task.threads),
            "THP_MEM_ALLOC_ENABLE": "1",  # torch then asks for huge pages
            "TORCHINDUCTOR_CACHE_DIR": str((task.work / "inductor").absolute()),
        }
    )
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def round_of(pipes: dict[str, Connection], said: dict[str, Any], index: int) -> dict[tuple[str, str], float]:
    """Seconds of every work of every contender, once; contender number `index` begins."""
    names = list(pipes)
    turn = index % len(names)
    seconds = {}
    for name in names[turn:] + names[:turn]:
        for work in said[name]:
            time.sleep(PAUSE)
            pipes[name].send(work)
            answer = pipes[name].recv()
            if isinstance(answer, Exception):
                raise answer
            seconds[name, work] = answer
    return seconds


def note(message: str) -> None:
    """Prints progress on stderr."""
    print(f"benches.backbone: {message}", file=sys.stderr, flush=True)
