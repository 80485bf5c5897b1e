"""N1.5 at its published size in int8 and int4: files, memory, loading, how long calibration takes."""

from __future__ import annotations

import multiprocessing
import shutil
import time
from pathlib import Path
from typing import Any

import saccade
from benches.backbone.memory import measure as measure_loading
from benches.backbone.memory import peak_memory
from benches.int4.accuracy import Model, Note
from saccade.checkpoints import Calibration, convert, quantize

#: Loads of each, by turns.
ROUNDS = 3
#: Observations that weights are rounded for, and others that errors are measured on.
CALIBRATED, MEASURED = 16, 4


def measure(checkpoint: Path, work: Path, threads: int, note: Note) -> dict[str, Any]:
    """What each precision takes, with the layers of one embodiment.

    Returns:
        By precision `file_bytes`, on disk, and `loads`, each in a process of its own, as
        `benches.backbone.memory.measure` returns it.
    """
    one = with_one_embodiment(checkpoint, work)
    found: dict[str, Any] = {}
    for precision in ("int8", "int4"):
        folder = work / precision
        note(f"writing {precision}")
        quantize(one, folder, to=precision, force=True)
        # The layers of other embodiments are holes.
        files = [path.stat() for path in folder.glob("*.safetensors")]
        found[precision] = {"file_bytes": sum(512 * file.st_blocks for file in files), "loads": []}
    for _ in range(ROUNDS):
        for precision, one_of in found.items():
            loaded = measure_loading(work / precision, "policy", precision, threads)
            note(f"{precision}: {loaded}")
            one_of["loads"].append(loaded)
    return found


def with_one_embodiment(checkpoint: Path, work: Path) -> Path:
    """A copy with the layers of the robot that the checkpoint has statistics of."""
    one = work / "one-embodiment"
    kept = saccade.Normalizer.from_pretrained(checkpoint).embodiment_id
    convert(checkpoint, one, embodiment_ids=None if kept is None else [kept], force=True)
    return one


def calibrate(checkpoint: Path, work: Path, threads: int, note: Note) -> dict[str, Any]:
    """Rounds all weights to four bits for random observations, in a process of its own.

    Returns:
        `observations`, `weights`: their number, and that of the rounded weights; `seconds`; `peak`: the peak
        memory in bytes.
    """
    one = with_one_embodiment(checkpoint, work)
    # Layers that an interrupted run left would take no time.
    shutil.rmtree(work / "calibrated-full.calibrating", ignore_errors=True)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found: dict[str, Any] = pool.apply(_calibrate, (one, work / "calibrated-full", threads))
    note(f"calibration: {found}")
    return found


def calibrated(work: Path) -> tuple[Model, dict[str, Path]]:
    """What `calibrate` made, as `accuracy.measure` takes it, beside a copy with plain rounding."""
    one, plain = work / "one-embodiment", work / "int4"
    quantize(one, plain, to="int4", force=True)
    policy = saccade.Policy.from_pretrained(one)
    observations = [policy.example_observation(seed=CALIBRATED + seed) for seed in range(MEASURED)]
    folders = {"int4": plain, "int4, calibrated": work / "calibrated-full"}
    return Model("outliers, N1.5 at its published size", one, [], observations), folders


def _calibrate(checkpoint: Path, out: Path, threads: int) -> dict[str, Any]:
    policy = saccade.Policy.from_pretrained(checkpoint, num_threads=threads)
    observations = [policy.example_observation(seed=seed) for seed in range(CALIBRATED)]
    start = time.perf_counter()
    report = quantize(checkpoint, out, to="int4", calibration=Calibration(policy, observations), force=True)
    return {
        "observations": CALIBRATED,
        "weights": report.num_calibrated,
        "seconds": time.perf_counter() - start,
        "peak": peak_memory(),
    }
