"""Farms: chunks a second and episodes an hour by processes, threads and batch, and the memory they take.

    python -m benches.farm                             about 10 minutes; writes out/farm/results.json
    python -m benches.farm --minutes 60 --seconds 20   longer
    python -m benches.farm --policies demo             without the full-size policy
    python -m benches.farm report                      print the tables of existing measurements
    python -m benches.farm report --write              write docs/results/farm.md, keep the measurements
    python -m benches.farm --small --seconds 0.1       a quick trial of the program itself

Each setting is written to the results when it is done. The next run on the same machine measures what is
missing, so a run may be interrupted, or end by --minutes, and be continued.

A setting is a number of processes, the threads of each, and the observations that each computes together. For
`chunks`, processes act on random frames without pause. For `episodes`, they run the simulator, with as many
robots each as the batch has observations. The policies are the bundled one and a random one of N1.5's
published size, which is written to --work if it is not there (4.8 GB). saccade and torch, which is
`saccade_lab.reference`, take the same observations. A setting that does not fit into memory or time is
left out,
and the tables say so.

With `fork`, one process loads the policy and the others are forked from it; with `spawn`, each loads its own.
Memory is the sum of the proportional shares (PSS) of all processes, from /proc. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from benches import checkpoints, farm_report
from benches.farm_processes import Setting, measure
from benches.pages.report import report
from benches.peers import machine
from benches.peers.results import rounded
from saccade._internal.files import write_json

SECTIONS = ("chunks", "episodes")
POLICIES = ("demo", "full")
ENGINES = ("saccade", "torch")

#: Bytes for each one in the checkpoint, which is bfloat16 at full size; loading included.
FACTORS = {"float32": 2.2, "bfloat16": 1.15, "int8": 0.75}
#: Share of the free memory that is used at most.
FREE = 0.85


def main(arguments: list[str] | None = None) -> int:
    """The exit status."""
    args = parse(arguments)
    path: Path = args.work / ("results-small.json" if args.small else "results.json")
    if args.command == "report":
        return report(
            path,
            farm_report.COMMITTED,
            farm_report.PAGE,
            farm_report.document,
            program="benches.farm",
            write=args.write,
        )
    args.work.mkdir(parents=True, exist_ok=True)
    folders = {name: checkpoint(name, args) for name in args.policies}
    results = begin(path, folders, args)
    end = time.monotonic() + 60 * args.minutes
    done = {Setting(**{field.name: row[field.name] for field in fields(Setting)}) for row in results["rows"]}
    for setting in settings(args):
        if setting in done:
            continue
        reason = why_not(setting, results["bytes"][setting.policy], end)
        if reason is None:
            note(f"{setting.name} ...")
            measured = measure(setting, folders[setting.policy], args.seconds)
            reason = measured.get("failed")
            if reason is None:
                results["rows"].append(asdict(setting) | measured)
        if reason is not None:
            results["left_out"].append({"setting": asdict(setting), "reason": reason})
            note(f"{setting.name}: left out, {reason}")
        write_json(path, rounded(results))
    print(farm_report.document(results))
    note(f"wrote {path}")
    return 0


def begin(path: Path, folders: dict[str, Path], args: argparse.Namespace) -> dict[str, Any]:
    """The results so far, if they are of this machine, this build and these policies; otherwise none.

    Others are set aside under another name, because no table may mix them.

    Args:
        path: The JSON file.
        folders: Directory of each policy.
        args: The arguments.
    """
    now: dict[str, Any] = {
        "machine": machine.describe(),
        "seconds": args.seconds,
        "names": {name: name_of(name, args) for name in folders},
        "bytes": {name: weight(folder) for name, folder in folders.items()},
        "rows": [],
    }
    if path.exists():
        before = json.loads(path.read_text())
        same = all(before["machine"][key] == now["machine"][key] for key in ("cpu", "build", "versions"))
        for key in ("names", "bytes"):
            same = same and all(before[key].get(name, value) == value for name, value in now[key].items())
        if same and before["seconds"] == args.seconds:
            for key in ("names", "bytes"):  # also those of a run with other --policies
                now[key] = before[key] | now[key]
            now["rows"] = before["rows"]
            note(f"{path} has {len(now['rows'])} settings already; delete it to measure them again")
        else:
            aside = path.with_name(f"{path.stem}-{time.strftime('%Y%m%d-%H%M%S')}{path.suffix}")
            path.replace(aside)
            note(f"{path} has another machine, build, policy or --seconds; it is now {aside}")
    return {**now, "left_out": []}


def name_of(policy: str, args: argparse.Namespace) -> str:
    """What tables call a policy."""
    if policy == "demo":
        return "bundled policy" if args.demo is None else f"policy {args.demo.resolve().name}"
    if args.checkpoint is not None:
        return f"policy {args.checkpoint.resolve().name}"
    return "small random N1.5, for a trial" if args.small else "random N1.5 of the published size"


def settings(args: argparse.Namespace) -> Iterator[Setting]:
    """What is measured, in the order of its importance: time may end before."""
    cores = args.cores
    shapes = [(processes, cores // processes) for processes in reversed(divisors(cores))]  # all use all cores
    for policy, section in (("demo", "chunks"), ("demo", "episodes"), ("full", "chunks")):
        if policy not in args.policies or section not in args.sections:
            continue
        full = policy == "full"
        precision = args.precision if full else "float32"
        common: dict[str, Any] = {"section": section, "policy": policy, "precision": precision}
        torch = {**common, "precision": "float32", "engine": "torch", "sharing": "spawn"}
        if not full:
            least = args.episodes if section == "episodes" else 0
            yield Setting(**common, processes=1, threads=1, batch=1, least_episodes=least)
        for number, batch in enumerate(args.full_batches if full else args.batches):
            for processes, threads in shapes:
                yield Setting(**common, processes=processes, threads=threads, batch=batch)
            if number == 0 and cores > 1 and section == "chunks":
                processes, threads = shapes[0]
                yield Setting(**common, processes=processes, threads=threads, batch=batch, sharing="spawn")
            if "torch" in args.engines and (number == 0 or (section == "chunks" and not full)):
                for processes, threads in shapes:
                    yield Setting(**torch, processes=processes, threads=threads, batch=batch)


def divisors(cores: int) -> list[int]:
    """Numbers of processes that share the cores evenly.

    Example:
        >>> divisors(12)
        [1, 2, 3, 4, 6, 12]
    """
    return [number for number in range(1, cores + 1) if cores % number == 0]


def why_not(setting: Setting, size: int, end: float) -> str | None:
    """Why a setting is not measured: no time or no memory; None if it is.

    Args:
        setting: the setting.
        size: bytes of the checkpoint.
        end: when the time ends, by the monotonic clock.
    """
    if time.monotonic() > end:
        return "no time left"
    copies = setting.processes if setting.sharing == "spawn" else 1
    needed = copies * size * FACTORS[setting.precision]
    free = available_memory()
    if needed > FREE * free:
        return f"needs about {needed / 1e9:.0f} GB, {free / 1e9:.0f} GB are free"
    return None


def available_memory() -> int:
    """Bytes that programs can still have."""
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError("no MemAvailable in /proc/meminfo")


def checkpoint(name: str, args: argparse.Namespace) -> Path:
    """The directory of a policy; a random one is written if it is not there."""
    if name == "full":
        return checkpoints.n15(args.work, small=args.small, given=args.checkpoint)
    if args.demo is not None:
        return checkpoints.existing(args.demo)
    from saccade_lab.sim.policy import DEMO_CHECKPOINT

    return DEMO_CHECKPOINT


def weight(folder: Path) -> int:
    """Bytes of a checkpoint's tensors."""
    return sum(path.stat().st_size for path in folder.glob("*.safetensors"))


def note(text: str) -> None:
    """Progress, on standard error."""
    print(f"farm: {text}", file=sys.stderr, flush=True)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The arguments."""
    parser = argparse.ArgumentParser(
        prog="python -m benches.farm",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("command", nargs="?", choices=("measure", "report"), default="measure")
    add("--write", action="store_true", help="report: write docs/results/farm.md and benches/farm.json")
    add("--sections", nargs="+", choices=SECTIONS, default=SECTIONS)
    add("--policies", nargs="+", choices=POLICIES, default=POLICIES)
    add("--engines", nargs="+", choices=ENGINES, default=ENGINES, help="saccade is always measured")
    add("--batches", type=int, nargs="+", default=[1, 4, 16], metavar="N", help="default: 1 4 16")
    add("--full-batches", type=int, nargs="+", default=[1, 4], metavar="N", help="default: 1 4")
    add(
        "--precision", choices=FACTORS, default="bfloat16", help="of the full-size policy (default: bfloat16)"
    )
    add("--episodes", type=int, default=20, metavar="N", help="whose length is measured (default: 20)")
    add("--cores", type=int, default=len(os.sched_getaffinity(0)), metavar="N", help="default: all")
    add("--seconds", type=float, default=6.0, metavar="X", help="of each setting, at least (default: 6)")
    add("--minutes", type=float, default=10.0, metavar="X", help="no setting begins later (default: 10)")
    add("--demo", type=Path, metavar="DIR", help="another policy of the simulator")
    add("--checkpoint", type=Path, metavar="DIR", help="another full-size policy, of one robot")
    add("--work", type=Path, default=Path("out/farm"), metavar="DIR", help="default: out/farm")
    add("--small", action="store_true", help="a small policy in place of the full-size one, for a trial")
    args = parser.parse_args(arguments)
    if args.small and args.write:
        parser.error("--write: not with --small, which is a trial")
    if min(*args.batches, *args.full_batches, args.cores, args.episodes) < 1 or args.seconds <= 0:
        parser.error(
            "--batches, --full-batches, --cores and --episodes must be at least 1, --seconds above 0"
        )
    return args


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # also ends the processes of the setting
    with contextlib.suppress(KeyboardInterrupt):
        sys.exit(main())
    sys.exit(130)
