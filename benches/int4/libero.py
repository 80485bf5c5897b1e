"""Success on LIBERO: runs of `saccade libero` on the same episodes, at several precisions."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

#: What must be the same in all runs.
COMMON = ("checkpoint", "protocol", "noise", "saccade", "instruction_set", "packages", "machine")


def measure(folders: Sequence[Path]) -> dict[str, Any]:
    """The success of the episodes that all runs have.

    Args:
        folders: Directories that `saccade libero --out` wrote: the first of float32, the others of other
            precisions.

    Returns:
        `checkpoint` and `machine` as the runs say, the name of the `protocol`, `tasks`: the suites, and
        `success`: by precision of each episode, in the same order.

    Raises:
        SystemExit: The first run is not of float32, two have the same precision, or runs differ in more.
    """
    runs = [json.loads((folder / "results.json").read_text()) for folder in folders]
    names = [_precision(run) for run in runs]
    if names[0] != "float32" or len(set(names)) < len(names):
        raise SystemExit(f"benches.int4: expected runs of float32 and of others, got {', '.join(names)}")
    for folder, run in zip(folders, runs, strict=True):
        differing = [name for name in COMMON if run[name] != runs[0][name]]
        if differing:
            raise SystemExit(f"benches.int4: {folder}: another {', '.join(differing)} than in {folders[0]}")
    found = [
        {(one["suite"], one["task"], one["trial"]): one["success"] for one in run["episodes"]} for run in runs
    ]
    common = sorted(set.intersection(*map(set, found)))
    return {
        "checkpoint": runs[0]["checkpoint"],
        "machine": runs[0]["machine"],
        "protocol": runs[0]["protocol"]["name"],
        "tasks": sorted({suite for suite, _, _ in common}),
        "success": {name: [one[key] for key in common] for name, one in zip(names, found, strict=True)},
    }


def _precision(run: Mapping[str, Any]) -> str:
    """The precision of a run: that of backbone and head, or both if they differ."""
    return ", ".join(dict.fromkeys(run["options"]["precision"].values()))
