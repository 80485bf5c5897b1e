"""Compares saccade with other engines that run the same head, on this machine.

    make bench-peers                                       the usual set, at most half an hour
    make bench-peers PEERS_ARGS="--only blocks --threads 1 2 --rounds 9"
    make bench-peers PEERS_ARGS="--full --minutes 600"     every piece at every size: hours
    make bench-peers PEERS_ARGS="--only cost"              how saccade's time grows with its sizes
    make bench-peers PEERS_ARGS="--only throughput --rounds 3 --minutes 120"
                       chunks per second of 1, 8 and 32 observations at once, on 1 thread to all cores
    make bench-peers PEERS_ARGS="--only policy"            the whole policy, images and instruction to a
                       chunk: N1.5, then N1.7; --release n1.7 measures that one alone
    python -m benches.peers report                         write the report of existing measurements
    python -m benches.peers report --write                 write docs/results/performance.md and its figures
    python -m benches.peers report --only policy --write   write docs/results/policy-speed.md

Every contender runs in a separate process with the requested number of threads and waits while another one
works. In a round, each does every piece of work once, in an order that rotates. Before anything is timed, its
result is compared with the reference in float32. What has a target comes first. Measurements are added to a
JSON file, so an interrupted run resumes, and contenders that have all their rounds are not started again.
At the end the file is copied to benches/peers/results/ under the name of the CPU's family. The whole policy
is measured apart from the head, and each release has a file and a record of its own; they share a page.

Needs the environment that `make bench-peers` sets up. A contender whose package is missing is left out, with
the reason in the report. The whole head in all contenders takes 12 GB of memory, the whole policy 19 GB;
`--memory` limits how much is used at a time.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benches.pages.report import require_commit
from benches.peers import machine, policy_report, processes, report
from benches.peers.cases import RELEASES, USUAL, WHOLE, WORKS, Case, default_cases, full_cases
from benches.peers.contenders import CONTENDERS, GROUPS, POLICY_GROUPS, PROCESSES, able
from benches.peers.goals import NEEDED
from benches.peers.processes import KilledError, Ready, note
from benches.peers.results import RECORDS, Results
from benches.peers.text import usual

SIZES = ("num-vl-tokens", "num-future-tokens", "batch", "samples", "steps")
"""Flags that change a size of every case; the whole policy has no choice of them."""
BUILDING = {"policy": 150.0}
"""Seconds to build the slowest batch of a piece, once its graphs are written; of others `BUILDING_PARTS`."""
BUILDING_PARTS = 40.0


def main(arguments: list[str] | None = None) -> int:
    """The exit status."""
    args = parse(arguments)
    results = Results(args.results)
    reporter: Any = policy_report if args.only == ["policy"] else report
    if args.command == "report":
        return int(reporter.command(results, args))
    machine_now = machine.describe()
    args.contenders = able(args.contenders, machine_now)
    if results.begin(machine_now):
        note(f"{args.results} is from another machine, commit or build; it is set aside and measured again")
    measure_all(results, args)
    if not args.prepare:
        reporter.write(results, args.results.parent)
        keep(results, args.record / args.release if args.only == ["policy"] else args.record)
    return 0


def measure_all(results: Results, args: argparse.Namespace) -> None:
    """Measures all cases, until they are done or the time limit is reached: first what has a target."""
    end = time.monotonic() + 60.0 * args.minutes
    cases = chosen_cases(args)
    if not args.prepare:
        for threads in args.threads:
            results.data["peaks"].append(machine.peaks(threads))
        results.save()
    needed = [name for name in args.contenders if name in NEEDED]
    with_targets = [] if args.prepare else [case for case in cases if case.piece in ("head", "blocks")]
    if not measure_cases(results, with_targets, needed, args, end):
        return
    wants_linear = args.linear_rounds and any(case.piece == "linear" for case in cases)
    if wants_linear and not args.prepare and not results.data["linear"]:
        note("linear layers: cargo bench")
        results.data["linear"].append(machine.linear_bench(args.linear_threads, args.linear_rounds))
        results.save()
    measure_cases(results, cases, args.contenders, args, end)


def measure_cases(
    results: Results, cases: list[Case], names: Sequence[str], args: argparse.Namespace, end: float
) -> bool:
    """Measures the named contenders; whether the time was enough."""
    for case in cases:
        for batch in batches(results, case, args, names):
            if time.monotonic() + BUILDING.get(case.piece, BUILDING_PARTS) > end:
                note("the time limit is reached; the next run continues here")
                return False
            processes.prepare(case, args.work)
            measure(results, case, batch, args, end)
    return True


def keep(results: Results, folder: Path) -> None:
    """Copies the measurements to the record of this CPU's family, if the whole head or policy is among
    them. Those of a tree with uncommitted changes are refused.
    """
    if usual(results, "head") or any(usual(results, "policy", release) for release in RELEASES):
        require_commit(results.data, results.path)
        path = folder / f"{results.slug}.json"
        results.save(path)
        print(path)


def chosen_cases(args: argparse.Namespace) -> list[Case]:
    """The cases that the command line selects."""
    cases = full_cases(args.threads) if args.full else default_cases(args.threads)
    changed = {
        name: getattr(args, name)
        for name in (flag.replace("-", "_") for flag in SIZES)
        if getattr(args, name) is not None
    }
    changed |= {"size": args.size, "release": args.release}
    cases = [replace(case, **changed) for case in cases if case.piece in args.only]
    return list(dict.fromkeys(cases))


def batches(results: Results, case: Case, args: argparse.Namespace, names: Sequence[str]) -> list[list[str]]:
    """Batches of contenders with unfinished rounds that fit into memory, each with the first of its group."""
    found: list[list[str]] = []
    for group in (POLICY_GROUPS if case.piece == "policy" else GROUPS).values():
        able = [name for name in group if case.piece in group[name].pieces and name in names]
        pending = [name for name in able if results.rounds(case, name) < args.rounds]
        if args.prepare:
            found += [[name] for name in able]
            continue
        anchor = able[0] if able else ""
        while pending:
            batch = [anchor]
            for name in [name for name in pending if name != anchor]:
                if gigabytes(case, [*batch, name]) <= args.memory:
                    batch.append(name)
            if len(batch) == 1 and pending != [anchor]:
                batch = pending[:1]  # it does not fit into memory together with the anchor
            found.append(batch)
            pending = [name for name in pending if name not in batch]
    return found


def gigabytes(case: Case, names: Sequence[str]) -> float:
    """Memory of contenders together, roughly: the weights of the whole policy or head, or of a fifth of it.

    A process needs the weights that its contenders share also if only one of them is left to measure.
    """
    shared = {CONTENDERS[name].process for name in names} - {""}
    own = sum(CONTENDERS[name].gigabytes for name in names) + sum(PROCESSES[process] for process in shared)
    return own * (1.0 if case.piece in (*WHOLE, "policy") else 0.3)


def measure(results: Results, case: Case, names: list[str], args: argparse.Namespace, end: float) -> None:
    """Builds a batch and runs its rounds; the file is written after each round."""
    with processes.contenders(names, case, args.work) as (pipes, said):
        if args.prepare:
            for name, answer in said.items():
                if isinstance(answer, Ready):
                    note(f"{name}: max abs error {answer.error:.2e} of {answer.scale:.2e}")
            return
        record = results.open(case)
        for name, answer in said.items():
            record["contenders"][name] = (
                {"error": answer.error, "scale": answer.scale, "notes": answer.notes, "seconds": {}}
                if isinstance(answer, Ready)
                else {"killed" if isinstance(answer, KilledError) else "failed": str(answer)}
            )
        results.save()
        rounds = args.rounds - min((results.rounds(case, name) for name in pipes), default=args.rounds)
        for index in range(rounds):
            if not pipes:
                break
            if time.monotonic() > end:
                note("the time limit is reached; the next run continues here")
                break
            note(f"{case}: round {index + 1} of {rounds}")
            seconds = processes.round_of(pipes, said, case.works, index)
            for name, works in seconds.items():
                for work, value in works.items():
                    record["contenders"][name]["seconds"].setdefault(work, []).append(value)
            results.save()


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benches.peers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = ("measure", "report")
    parser.add_argument("command", nargs="?", choices=commands, default="measure", help="default: measure")
    parser.add_argument("--full", action="store_true", help="every size, not only the usual one")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=WORKS,
        metavar="PIECE",
        help=f"of {', '.join(WORKS)} (default: {', '.join(USUAL)}; with --full all but policy)",
    )
    parser.add_argument(
        "--release", choices=RELEASES, default=RELEASES[0], help="of the whole policy (default n1.5)"
    )
    parser.add_argument(
        "--contenders",
        nargs="+",
        choices=CONTENDERS,
        metavar="NAME",
        help="default: all except settings that are slower than another setting of the same engine; of: "
        + ", ".join(CONTENDERS),
    )
    parser.add_argument(
        "--threads",
        type=int,
        nargs="+",
        help="counts (default 2; of throughput 1, 2, 4, ... all cores; of policy 2 and all cores)",
    )
    parser.add_argument("--rounds", type=int, default=5, help="repetitions of everything (default 5)")
    parser.add_argument(
        "--linear-rounds",
        type=int,
        default=8,
        help="rounds of `cargo bench --bench linear`; 0 skips it (default 8)",
    )
    parser.add_argument(
        "--linear-threads", type=int, nargs="+", default=[1, 2], help="its thread counts (default 1 2)"
    )
    parser.add_argument(
        "--minutes", type=float, default=30, help="time limit; the next run continues (default 30)"
    )
    parser.add_argument(
        "--memory",
        type=float,
        help="GB that contenders may use (default 12, of policy 19, or 0.6 or 0.8 of the machine's)",
    )
    parser.add_argument(
        "--prepare", action="store_true", help="write inputs and graphs, compare results, time nothing"
    )
    for name in SIZES:
        parser.add_argument(f"--{name}", type=int, help="use this value in every case of the head")
    parser.add_argument("--size", choices=("full", "small"), default="full", help="small: for a quick trial")
    parser.add_argument(
        "--work", type=Path, default=Path("out/peers"), help="weights and graphs (default out/peers)"
    )
    parser.add_argument(
        "--results",
        type=Path,
        help="the JSON file (default: results.json in --work; of policy policy-RELEASE.json)",
    )
    parser.add_argument(
        "--record",
        type=Path,
        help="folder with a JSON file per CPU family (default benches/peers/results); of policy a folder "
        "RELEASE in it (default benches/peers/results/policy)",
    )
    parser.add_argument("--write", action="store_true", help="report: write the page in docs from --record")
    args = parser.parse_args(arguments)
    args.only = args.only or ([work for work in WORKS if work != "policy"] if args.full else list(USUAL))
    if "policy" in args.only and args.only != ["policy"]:
        parser.error(f"--only: expected policy alone, got {' '.join(args.only)}")
    is_policy = args.only == ["policy"]
    given = [f"--{name}" for name in SIZES if getattr(args, name.replace("-", "_")) is not None]
    if is_policy and given:
        parser.error(f"{', '.join(given)}: not with --only policy, whose sizes are those of its checkpoint")
    if args.release != RELEASES[0] and not is_policy:
        parser.error(f"--release {args.release}: only with --only policy")
    args.results = args.results or args.work / (
        f"policy-{args.release}.json" if is_policy else "results.json"
    )
    args.record = args.record or (policy_report.RECORDS if is_policy else RECORDS)
    args.threads = args.threads or default_threads(args.only)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    args.memory = args.memory or (min(19.0, 0.8 * memory) if is_policy else min(12.0, 0.6 * memory))
    if args.contenders is None:
        args.contenders = [name for name, contender in CONTENDERS.items() if contender.usual]
    if args.rounds < 1 or min(args.threads) < 1:
        parser.error("--rounds and --threads must be at least 1")
    return args


def default_threads(only: list[str]) -> list[int]:
    """The thread counts of a run that names none."""
    counts = machine.thread_counts()
    if only == ["throughput"]:
        return counts
    return sorted({2, counts[-1]}) if only == ["policy"] else [2]


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # also ends the contenders' processes
    with contextlib.suppress(KeyboardInterrupt):
        sys.exit(main())
