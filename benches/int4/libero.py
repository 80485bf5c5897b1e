"""Success on LIBERO: runs of `saccade libero` on the same episodes, at several precisions."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from saccade_lab.files import changed

#: What must be the same in all runs, beside all options but the precision. Checkpoints may differ: one whose
#: weights were rounded beforehand is another.
COMMON = ("protocol", "noise", "saccade", "instruction_set", "packages", "machine", "option_files")


def measure(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """The success of the episodes that float32 and other runs of a policy have, for each policy.

    Args:
        folders: Directories that `saccade libero --out` wrote. Each run of float32 begins with a policy, and
            runs of other precisions or of checkpoints that `saccade quantize` made from it follow.

    Returns:
        For each policy what its first run says, and `runs` by the name of each other one: its precision, and
        its checkpoint if that is another. Each has `tasks`, the suites, and `success` of both, episode by
        episode.

    Raises:
        SystemExit: There is a policy without other runs, the first run is not of float32, two of a policy are
            the same, they differ in more, or one has no episode of the first.
    """
    policies: list[list[tuple[Path, Any]]] = []
    for folder in folders:
        run = json.loads((folder / "results.json").read_text())
        if set(run["options"]["precision"].values()) == {"float32"} or not policies:
            policies.append([])
        policies[-1].append((folder, run))
    return [_policy(policy) for policy in policies]


def _policy(named: Sequence[tuple[Path, Any]]) -> dict[str, Any]:
    """What ``measure`` returns of one policy, from the folders and contents of its runs."""
    folders, runs = zip(*named, strict=True)
    first = runs[0]
    names = [_name(run, first) for run in runs]
    if len(runs) < 2 or names[0] != "float32" or len(set(names)) < len(names):
        raise SystemExit(f"benches.int4: expected runs of float32 and of others, got {', '.join(names)}")
    for folder, run in zip(folders, runs, strict=True):
        if differing := changed(_settings(first), _settings(run)):
            raise SystemExit(f"benches.int4: {folder}: another {', '.join(differing)} than in {folders[0]}")
    exact, *others = (
        {(one["suite"], one["task"], one["trial"]): one["success"] for one in run["episodes"]} for run in runs
    )
    pairs = {}
    for name, rounded in zip(names[1:], others, strict=True):
        common = sorted(exact.keys() & rounded.keys())
        if not common:
            raise SystemExit(
                f"benches.int4: expected episodes of {folders[0]}, got none in the run of {name}"
            )
        pairs[name] = {
            "tasks": sorted({suite for suite, _, _ in common}),
            "success": {"float32": [exact[key] for key in common], name: [rounded[key] for key in common]},
        }
    return {
        **{name: first[name] for name in ("checkpoint", "machine", "instruction_set", "saccade")},
        "protocol": {name: first["protocol"][name] for name in ("name", "start")},
        "runs": pairs,
    }


def _settings(run: Mapping[str, Any]) -> dict[str, Any]:
    """What must be the same in all runs."""
    options = {name: value for name, value in run["options"].items() if name != "precision"}
    return options | {name: run[name] for name in COMMON}


def _name(run: Mapping[str, Any], first: Mapping[str, Any]) -> str:
    """The precision of backbone and head, each if they differ, and the checkpoint if it is another one."""
    backbone, head = (run["options"]["precision"][part] for part in ("backbone", "head"))
    precision = head if backbone == head else f"backbone {backbone}, head {head}"
    is_same = run["checkpoint"]["sha256"] == first["checkpoint"]["sha256"]
    return precision if is_same else f"{precision}: {run['checkpoint']['name']}"
