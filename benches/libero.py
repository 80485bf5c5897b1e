"""What an episode of LIBERO costs, by part, and how many a machine runs in an hour.

    python -m benches.libero POLICY --large FOLDER

POLICY is a small checkpoint, as `saccade train --demos` makes it from demonstrations of LIBERO: its episodes
are run to their end, by each number of processes. FOLDER is one of N1.5's published size, as
`python -m saccade_lab.random_checkpoint FOLDER --robot libero` writes it. Its episodes would take a third of
an hour each, so of each the first looks are run, and the rest is computed from their mean. Writes
`benches/results/libero.json` and prints the tables of docs/libero.md. Nothing else may run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benches.pages.report import require_commit
from benches.peers import machine
from saccade._internal.files import write_json
from saccade_lab.libero.episode import PARTS, Episode
from saccade_lab.libero.episodes import Episodes
from saccade_lab.parallel import Lost, Workers, each

RECORD = Path(__file__).parent / "results" / "libero.json"
SUITE, TASKS = "libero_object", 10
OFFICIAL_TRIALS = 50  # of a task: 500 episodes are a full run
#: Trials of each task in a run of the small policy, and the numbers of processes that run them.
TRIALS, PROCESSES = 1, (1, 2)
#: Episodes of the large policy that begin, each with its own task, and the looks that each of them runs.
LARGE_EPISODES, LOOKS = 3, 6
LARGE_OPTIONS = {
    "precision": "int8",
    "data_config": "examples.Libero.custom_data_config:LiberoDataConfig",
}


def whole_episodes(checkpoint: Path, jobs: int) -> dict[str, Any]:
    """Runs one episode of each task to its end in some processes, each with one thread."""
    work = Episodes(str(checkpoint), "lerobot", {"num_threads": 1})
    keys = [(SUITE, task, trial) for task in range(TASKS) for trial in range(TRIALS)]
    begun = time.perf_counter()
    rolled = [one for _, one in each(work, keys, Workers("loky", jobs), [str(checkpoint)])]
    seconds = time.perf_counter() - begun
    lost = [one.reason for one in rolled if isinstance(one, Lost)]
    if lost:
        raise SystemExit(f"benches.libero: an episode was lost: {lost[0]}")
    episodes = [one.episode for one in rolled if not isinstance(one, Lost)]
    return {
        "jobs": jobs,
        "episodes": len(episodes),
        "successes": sum(one.success for one in episodes),
        "wall_seconds": seconds,
        **means(episodes),
    }


def means(episodes: Iterable[Episode]) -> dict[str, Any]:
    """Steps, chunks and seconds by part of an episode."""
    listed = list(episodes)
    return {
        "steps": sum(one.steps for one in listed) / len(listed),
        "chunks": sum(one.chunks for one in listed) / len(listed),
        "seconds": {part: sum(one.seconds[part] for one in listed) / len(listed) for part in PARTS},
    }


def first_looks(checkpoint: Path, num_threads: int) -> dict[str, Any]:
    """Runs the first looks of episodes in this process, and computes what whole ones would take."""
    work = Episodes(str(checkpoint), "isaac-n15", {**LARGE_OPTIONS, "num_threads": num_threads})
    policy = work.policy
    limit = policy.protocol.limit(SUITE)
    policy.protocol = replace(policy.protocol, limits={SUITE: LOOKS * policy.execute_steps})
    episodes = [work((SUITE, task, 0)).episode for task in range(LARGE_EPISODES)]
    return {
        "num_threads": num_threads,
        "episodes": len(episodes),
        "looks_of_each": LOOKS,
        "whole": extrapolated(means(episodes), limit),
    }


def extrapolated(begun: Mapping[str, Any], limit: int) -> dict[str, Any]:
    """What an episode of ``limit`` steps takes by the means of episodes that were ended before.

    The last observation is drawn too, so there is one picture more than there are chunks.
    """
    chunks = begun["chunks"] * limit / begun["steps"]
    times = {"reset": 1.0, "draw": (chunks + 1) / (begun["chunks"] + 1)}
    longer = limit / begun["steps"]
    seconds = {part: spent * times.get(part, longer) for part, spent in begun["seconds"].items()}
    return {"steps": limit, "chunks": chunks, "seconds": seconds}


def table(record: Mapping[str, Any]) -> str:
    """Markdown: the parts of an episode, then what a machine does in an hour."""
    rows = [(f"small, {one['jobs']} at a time", one) for one in record["small"]]
    large = record.get("large")
    if large is not None:
        rows.append((f"N1.5, int8, {large['num_threads']} threads", large["whole"]))
    lines = [
        f"| seconds of an episode | steps | chunks | {' | '.join(PARTS)} | all |",
        "|---|---|---|" + "---|" * (len(PARTS) + 1),
    ]
    for name, one in rows:
        parts = " | ".join(f"{one['seconds'][part]:.1f}" for part in PARTS)
        total = sum(one["seconds"].values())
        lines.append(f"| {name} | {one['steps']:.0f} | {one['chunks']:.0f} | {parts} | {total:.1f} |")
    lines += ["", "| | episodes an hour | a full run, 500 episodes |", "|---|---|---|"]
    for one in record["small"]:
        lines.append(hourly(f"small, {one['jobs']} at a time", one["wall_seconds"] / one["episodes"]))
    if large is not None:
        name = f"N1.5, int8, {large['num_threads']} threads, computed"
        lines.append(hourly(name, sum(large["whole"]["seconds"].values())))
    return "\n".join(lines)


def hourly(name: str, seconds: float) -> str:
    """A row of the second table, from the wall time of an episode."""
    return f"| {name} | {3600 / seconds:.3g} | {seconds * OFFICIAL_TRIALS * TASKS / 3600:.2g} hours |"


def main(arguments: list[str] | None = None) -> int:
    """Measures, writes the record and prints the tables."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m benches.libero", description=__doc__, formatter_class=raw
    )
    parser.add_argument("policy", type=Path)
    parser.add_argument("--large", type=Path, metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=RECORD)
    args = parser.parse_args(arguments)
    here = machine.describe()
    require_commit(here, args.out)
    record: dict[str, Any] = {"machine": here, "suite": SUITE}
    record["small"] = [whole_episodes(args.policy, jobs) for jobs in PROCESSES]
    if args.large is not None:
        record["large"] = first_looks(args.large, here["cores"])
    write_json(args.out, json.loads(json.dumps(record)))
    print(table(record))
    return 0


if __name__ == "__main__":
    sys.exit(main())
