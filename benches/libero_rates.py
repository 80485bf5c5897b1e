"""How often a policy succeeds on LIBERO: a record of runs of `saccade libero`, and a table of docs/libero.md.

    python -m benches.libero_rates DIR [DIR ...]       finished runs of one policy, each with its results.json

Writes `benches/results/libero-rates.json`, or with `--out` the record of another policy beside it, and prints
the table. The record names what wrote it, and the runs name the version, the packages and the hash of the
checkpoint.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benches.pages.report import require_commit
from benches.peers import machine
from saccade._internal.files import write_json
from saccade_lab.intervals import wilson
from saccade_lab.libero.suites import SUITES

RECORD = Path(__file__).parent / "results" / "libero-rates.json"

#: What is kept of a run, and what must be the same in all of them.
COMMON = (
    "checkpoint",
    "options",
    "noise",
    "saccade",
    "instruction_set",
    "dot_products",
    "packages",
    "machine",
)

#: What the perturbations of LIBERO-PRO change.
PERTURBED = {
    "swap": "exchanged positions",
    "task": "another goal",
    "lan": "other words",
    "object": "other looks",
}


def record_of(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the runs found, by suite.

    Args:
        runs: Contents of `results.json`.

    Raises:
        SystemExit: They are not of one policy, or two have the same suite.
    """
    first = runs[0]
    for run in runs:
        differing = [name for name in COMMON if run[name] != first[name]]
        if differing:
            raise SystemExit(f"benches.libero_rates: runs that differ in {', '.join(differing)}")
    suites: dict[str, Any] = {}
    for run in runs:
        for row in run["summary"]:
            if row["task"] is None:  # all of a suite
                continue
            suite = suites.setdefault(row["suite"], {"protocol": run["protocol"]["name"], "tasks": {}})
            if row["task"] in suite["tasks"]:
                raise SystemExit(f"benches.libero_rates: {row['suite']} is in two runs")
            suite["tasks"][row["task"]] = {name: row[name] for name in ("successes", "episodes")}
    words = {(one["suite"], one["task"]): one["instruction"] for run in runs for one in run["tasks"]}
    for name, suite in suites.items():
        for task, counts in suite["tasks"].items():
            counts["instruction"] = words[name, task]
    return {name: first[name] for name in COMMON} | {"suites": suites}


def table(record: Mapping[str, Any]) -> str:
    """A row for the first suite, each of its tasks, and each other suite, with Wilson's 95 % intervals."""
    rows = ["| | successes | rate |", "|---|---|---|"]
    first, *_ = record["suites"]
    for name, suite in record["suites"].items():
        counts = list(suite["tasks"].values())
        perturbed = PERTURBED.get(name.removeprefix(f"{SUITES[name].base}_"))
        shown = f"**{name}**" + (f", {perturbed}" if perturbed else "")
        rows.append(row(shown, *(sum(one[key] for one in counts) for key in ("successes", "episodes"))))
        if name == first:
            rows += [row(one["instruction"], one["successes"], one["episodes"]) for one in counts]
    return "\n".join(rows)


def row(name: str, successes: int, episodes: int) -> str:
    """One row.

    Example:
        >>> row("all", 40, 50)
        '| all | 40 of 50 | 80 % (67 to 89) |'
    """
    low, high = wilson(successes, episodes)
    rate = f"{100 * successes / episodes:.0f} % ({100 * low:.0f} to {100 * high:.0f})"
    return f"| {name} | {successes} of {episodes} | {rate} |"


def main(arguments: list[str] | None = None) -> int:
    """Writes the record and prints the table."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="python -m benches.libero_rates", description=__doc__, formatter_class=raw
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--out", type=Path, default=RECORD)
    args = parser.parse_args(arguments)
    here = machine.describe()
    require_commit(here, args.out)
    runs = [json.loads((run / "results.json").read_text()) for run in args.runs]
    record = {"written_at": here["commit"], "cpu": here["cpu"], "family": here["family"], **record_of(runs)}
    write_json(args.out, json.loads(json.dumps(record)))
    print(table(record))
    return 0


if __name__ == "__main__":
    sys.exit(main())
