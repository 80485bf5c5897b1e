"""Peak memory of loading, and the time to load from disk compared with reading the same files."""

from __future__ import annotations

import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

#: What is loaded: the backbone alone, and a whole policy with one embodiment.
WHATS = ("backbone", "policy")

#: Gigabytes (10^9 bytes) that a whole policy may use at most, loading included.
GOALS = {"int8": 2.6, "bfloat16": 4.6}

#: The longest cold load that is wanted, as a multiple of reading the files.
LOAD_GOAL = 1.3


def measure(folder: Path, what: str, precision: str, threads: int) -> dict[str, Any]:
    """Loads in a process of its own, with the page cache dropped before.

    Returns:
        `before`, `loaded` and `called`: the peak memory of the process in bytes before loading, behind it,
        and behind a call; `nbytes` of what was loaded, if it says so; `load` and `read`: seconds of loading,
        and of reading all tensor files, each from disk.
    """
    drop_cache(folder)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found: dict[str, Any] = pool.apply(_load, (folder, what, precision, threads))
    drop_cache(folder)
    start = time.perf_counter()
    for path in sorted(folder.glob("*.safetensors")):
        with path.open("rb", buffering=0) as file:
            piece = bytearray(1 << 24)
            while file.readinto(piece):
                pass
    return found | {"read": time.perf_counter() - start}


def _load(folder: Path, what: str, precision: str, threads: int) -> dict[str, Any]:
    import saccade
    from benches.backbone import setup

    before = peak_memory()
    start = time.perf_counter()
    if what == "backbone":
        loaded: Any = saccade.Backbone.from_pretrained(folder, precision=precision, num_threads=threads)
    else:
        loaded = saccade.Policy.from_pretrained(folder, precision=precision, num_threads=threads)
    seconds = time.perf_counter() - start
    found: dict[str, Any] = {"before": before, "loaded": peak_memory(), "load": seconds}
    found["nbytes"] = getattr(loaded, "nbytes", None)
    if what == "backbone":
        loaded(setup.inputs_of(setup.sizes_of(folder), 2))
    else:
        loaded.act(loaded.example_observation(seed=0), seed=0)
    return found | {"called": peak_memory()}


def peak_memory() -> int:
    """The largest resident memory that this process has had, in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("no VmHWM in /proc/self/status")


def drop_cache(folder: Path) -> None:
    """Asks the system to forget what it holds of the checkpoint's files."""
    for path in folder.glob("*.safetensors"):
        with path.open("rb") as file:
            os.fdatasync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
