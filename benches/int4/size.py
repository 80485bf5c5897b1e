"""Files, memory and loading of N1.5 at its published size, as `saccade quantize` writes int8 and int4."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import saccade
from benches.backbone.memory import measure as measure_loading
from benches.int4.accuracy import Note
from saccade.checkpoints import convert, quantize

#: Loads of each, by turns.
ROUNDS = 3


def measure(checkpoint: Path, work: Path, threads: int, note: Note) -> dict[str, Any]:
    """What each precision takes, with the layers of one embodiment.

    Returns:
        By precision `file_bytes`, on disk, and `loads`, each in a process of its own, as
        `benches.backbone.memory.measure` returns it.
    """
    one = work / "one-embodiment"
    kept = saccade.Normalizer.from_pretrained(checkpoint).embodiment_id
    convert(checkpoint, one, embodiment_ids=None if kept is None else [kept], force=True)
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
