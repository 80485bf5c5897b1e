"""Times of the head that `saccade bench` took, on this machine or on others."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

PRECISIONS = ("int8", "int4")
CALLS = ("encode", "sample")
#: What is kept of a run beside its times.
KEPT = ("family", "isa", "num_threads")


def measure(files: Sequence[Path]) -> list[dict[str, Any]]:
    """What each run found.

    Args:
        files: What `saccade bench --json` printed, of runs with int8 and int4.

    Returns:
        For each run its machine and the vision-language tokens of a call; `time`, seconds of each round by
        call and precision; and `read`, in bytes a second, what a sample's kernels of each precision read in
        the profile, and what their threads can.

    Raises:
        SystemExit: A run has not both precisions or no profile, or other samples than one of one observation.
    """
    found = []
    for file in files:
        run = json.loads(file.read_text())
        seconds = {(one["precision"], one["call"]): one["seconds"] for one in run["results"]}
        profiled = {one["precision"] for one in run["profile"] if one["call"] == "sample"}
        is_whole = profiled.issuperset(PRECISIONS) and seconds.keys() >= set(product(PRECISIONS, CALLS))
        if not is_whole or (run["call"]["batch"], run["call"]["num_samples"]) != (1, 1):
            raise SystemExit(
                f"benches.int4: {file}: expected int8 and int4 with --profile, one sample of one observation"
            )
        found.append(
            {
                "saccade": run["saccade"],
                "num_vl_tokens": run["call"]["num_vl_tokens"],
                "machine": {name: run["machine"][name] for name in KEPT},
                "time": {call: {name: seconds[name, call] for name in PRECISIONS} for call in CALLS},
                "read": {name: rate(run["profile"], name) for name in PRECISIONS}
                | {"peak": run["machine"]["read_bytes_per_second"]},
            }
        )
    return found


def rate(profiles: Sequence[Mapping[str, Any]], precision: str) -> float:
    """Bytes a second of the linear layers of a sample."""
    (parts,) = (one["parts"] for one in profiles if (one["precision"], one["call"]) == (precision, "sample"))
    layers = [part for part in parts if part["kernel"].endswith(precision)]
    return float(sum(part["bytes"] for part in layers) / sum(part["seconds"] for part in layers))
