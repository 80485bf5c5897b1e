"""The vision-language backbone: speed against transformers, reuse, memory, errors.

    python -m benches.backbone                        all sections; about 40 minutes on two cores
    python -m benches.backbone speed --rounds 9       some sections: speed, reuse, memory, accuracy
    python -m benches.backbone report                 print the page of all committed records
    python -m benches.backbone report --write         write docs/results/backbone.md from them
    python -m benches.backbone --small --rounds 2     a quick trial of the program itself

The checkpoint is random, at N1.5's published size; it is written once, 4.8 GB. In `speed` every contender has
a process of its own and they take turns: in a round each does every piece once, in an order that rotates.
Before anything is timed, features are compared with the reference in float32. Run it on an idle machine with
24 GB of memory; `accuracy` needs 12 GB for float64. A section that runs again replaces its results. At the
end the results are copied to benches/backbone/results/ under the name of the CPU's family, if they are of a
commit, of the usual sizes, and of all sections that the record there has.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from benches import checkpoints
from benches.backbone import accuracy, memory, report, reuse, setup
from benches.backbone.contenders import GROUPS, Task, contenders, note, round_of
from benches.files import write_record
from benches.peers import machine
from benches.peers.results import set_aside
from saccade._internal.small_files import read_json
from saccade.errors import InputError

PRECISIONS = ("float32", "bfloat16", "int8")

Results = dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    """The exit status."""
    args = parse(arguments)
    path = args.work / ("results-small.json" if args.small else "results.json")
    if args.sections == ["report"]:
        return report.report(write=args.write)
    results: Results = read_json(path, InputError) if path.exists() else {}
    machine_now = machine.describe()
    if set_aside(path, results.get("machine", {}), machine_now):
        note(f"{path} is from another machine, commit or build; it is set aside and measured again")
        results = {}
    results["machine"] = machine_now
    planned = results | dict.fromkeys(args.sections)
    refusal = not_as_usual(args) or report.refusal(planned)
    if refusal:
        note(f"{refusal}: the results will not be kept in {report.RECORDS}")
    args.work.mkdir(parents=True, exist_ok=True)
    for section in args.sections:
        measured = {"speed": speed, "reuse": reuse_section, "memory": memory_section, "accuracy": errors}
        results[section] = measured[section](args)
        write_record(path, results)
    print(report.page([results]))
    if not refusal:
        print(report.keep(results))
    return 0


def not_as_usual(args: argparse.Namespace) -> str:
    """What keeps the results from being a record, whose page says how they were measured; or nothing."""
    usual = parse([])
    names = [
        name
        for name in ("threads", "views", "layers", "checkpoint", "small")
        if getattr(args, name) != getattr(usual, name)
    ]
    names += [name for name in ("rounds", "loads") if getattr(args, name) < getattr(usual, name)]
    return f"not as usual: {', '.join(f'--{name}' for name in names)}" if names else ""


def checkpoint(args: argparse.Namespace) -> Path:
    """The checkpoint of the sections that run at full size."""
    return checkpoints.n15(args.work, small=args.small, given=args.checkpoint)


def speed(args: argparse.Namespace) -> list[Results]:
    """The backbone alone, by threads: peaks, and the seconds of each piece of each contender."""
    folder = checkpoint(args)
    given = {str(views): setup.inputs_of(setup.sizes_of(folder), views) for views in args.views}
    for views in args.views:
        setup.expected(folder, views, args.work)
    found = []
    groups = list(GROUPS) if args.compiled else ["usual"]
    for threads in args.threads:
        for group in groups:
            tasks = [Task(name, folder, threads, tuple(args.views), args.work) for name in GROUPS[group]]
            entry: Results = {"threads": threads, "group": group, "peaks": [], "contenders": {}}
            entry["config"] = json.loads((folder / "config.json").read_text())
            entry["tokens"] = {views: inputs.input_ids.shape[1] for views, inputs in given.items()}
            with contenders(tasks) as (pipes, said):
                for name, answer in said.items():
                    failed = isinstance(answer, Exception)
                    entry["contenders"][name] = (
                        {"failed": str(answer)}
                        if failed
                        else {work: {"error": error, "seconds": []} for work, error in answer.items()}
                    )
                for index in range(args.rounds if pipes else 0):
                    note(f"{threads} threads, {group}: round {index + 1} of {args.rounds}")
                    entry["peaks"].append(machine.peaks(threads))
                    for (name, work), seconds in round_of(pipes, said, index).items():
                        entry["contenders"][name][work]["seconds"].append(seconds)
            found.append(entry)
    return found


def reuse_section(args: argparse.Namespace) -> list[Results]:
    """Steps of a whole policy with unchanged views."""
    folder, found = checkpoint(args), []
    for threads in args.threads:
        for precision in PRECISIONS:
            note(f"reuse: {precision}, {threads} threads")
            measured = reuse.measure(folder, precision, threads, args.rounds)
            found.append({"threads": threads, "precision": precision, **measured})
    return found


def memory_section(args: argparse.Namespace) -> list[Results]:
    """Peak memory and cold loads."""
    folder, found = checkpoint(args), []
    for what in memory.WHATS:
        for precision in PRECISIONS:
            note(f"memory: {what}, {precision}")
            runs = [memory.measure(folder, what, precision, args.threads[0]) for _ in range(args.loads)]
            found.append({"what": what, "precision": precision, "runs": runs})
    return found


def errors(args: argparse.Namespace) -> list[Results]:
    """Errors against float64."""
    found = []
    layers = None if args.layers is None else (args.layers[0], args.layers[1])
    for model, outliers in accuracy.MODELS.items():
        folder = accuracy.checkpoint(args.work, outliers=outliers, layers=layers, small=args.small)
        runs = accuracy.measure(folder, 1, note)
        found.append({"model": model, "layers": layers, "runs": runs})
    return found


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benches.backbone",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "sections", nargs="*", metavar="SECTION", help=f"default: {' '.join(report.SECTIONS)}"
    )
    cores = len(os.sched_getaffinity(0))
    parser.add_argument(
        "--threads", type=int, nargs="+", default=list(dict.fromkeys((2, cores))), help="default: 2 and all"
    )
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2], help="default: 1 2")
    parser.add_argument("--rounds", type=int, default=7, help="repetitions (default 7)")
    parser.add_argument("--loads", type=int, default=3, help="cold loads of each kind (default 3)")
    parser.add_argument("--compiled", action="store_true", help="also torch.compile, in rounds of its own")
    parser.add_argument(
        "--layers", type=int, nargs=2, metavar=("VISION", "TEXT"), help="fewer layers in `accuracy`"
    )
    parser.add_argument(
        "--checkpoint", type=Path, help="a checkpoint of N1.5; default: a random one in --work"
    )
    parser.add_argument("--work", type=Path, default=Path("out/backbone"), help="default: out/backbone")
    parser.add_argument("--small", action="store_true", help="small sizes, for a quick trial")
    parser.add_argument("--write", action="store_true", help="report: write docs/results/backbone.md")
    args = parser.parse_args(arguments)
    args.sections = args.sections or list(report.SECTIONS)
    if not set(args.sections) <= set(report.SECTIONS) and args.sections != ["report"]:
        parser.error(
            f"expected sections among {', '.join(report.SECTIONS)}, or report, got {' '.join(args.sections)}"
        )
    if args.rounds < 1 or args.loads < 1 or min(args.threads) < 1 or min(args.views) < 1:
        parser.error("--rounds, --loads, --threads and --views must be at least 1")
    return args


if __name__ == "__main__":
    sys.exit(main())
