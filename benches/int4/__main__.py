"""What int4 costs and saves.

    python -m benches.int4 errors [--small] [--policy DIR]  of actions, by precision and by group of layers
    python -m benches.int4 loop [--policy DIR]              success in closed loop on the same episodes
    python -m benches.int4 libero FLOAT32 INT4 [...]        the same on LIBERO, in runs of `saccade libero`
    python -m benches.int4 full                             memory, loading and time at N1.5's published size
    python -m benches.int4 bench FILE [...]                 the head, in runs of `saccade bench --json`
    python -m benches.int4 calibrate                        how long its calibration takes, and its errors
    python -m benches.int4 report [--write]                 prints the page, or writes docs/results/int4.md

Each adds to out/int4.json what it measured; the report has the committed measurements for the rest, and
removes that file once it is written. Needs the lab with its simulator: trained policies are recorded in their
tasks first. A policy is one that `saccade train` wrote; the bundled one is measured without being named.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import saccade
from benches.checkpoints import written
from benches.int4 import accuracy, bench, closed_loop, groups, libero, size, time
from benches.int4.page import document
from benches.pages.report import report
from benches.peers.machine import describe
from saccade._internal.files import write_json

ROOT = Path(__file__).parents[2]
MEASURED = ROOT / "out" / "int4.json"
KEPT = Path(__file__).with_name("results.json")
PAGE = ROOT / "docs" / "results" / "int4.md"

#: The random models whose groups of layers are measured one by one, beside the trained ones.
BY_GROUP = 1


def note(line: str) -> None:
    """Says what was measured."""
    print(line, file=sys.stderr, flush=True)


def policies(args: argparse.Namespace) -> list[accuracy.Trained]:
    """The bundled policy, and those that are named."""
    found = [accuracy.trained(folder, args.work) for folder in (saccade.demo_checkpoint(), *args.policy)]
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        raise SystemExit(f"benches.int4: --policy: expected policies of other tasks, got {', '.join(names)}")
    return found


def errors(args: argparse.Namespace) -> dict[str, Any]:
    """Errors of actions."""
    trained, others = policies(args), accuracy.random_models(args.work, small=args.small)
    found: dict[str, Any] = {
        "observations": {"calibrated": accuracy.CALIBRATED, "measured": accuracy.MEASURED},
        "policies": {model.name: model.about() for model in trained},
        "models": {},
        "groups": {},
    }
    for model in (*trained, *others):
        folders = accuracy.copies(model, args.work)
        found["models"][model.name] = accuracy.measure(model, folders, note)
        if model in (*trained, *others[:BY_GROUP]):
            found["groups"][model.name] = groups.measure(model, folders, args.work, note)
    return found


def loop(args: argparse.Namespace) -> dict[str, Any]:
    """Success in closed loop."""
    return {
        model.name: closed_loop.measure(
            model, accuracy.copies(model, args.work), args.episodes, args.jobs, note
        )
        for model in policies(args)
    }


def full(args: argparse.Namespace) -> dict[str, Any]:
    """Memory, loading and time at published size."""
    checkpoint = written(args.work / "n15-outliers", outliers=True)
    sizes = size.measure(checkpoint, args.work, args.num_threads, note)
    return {"size": sizes, "time": time.measure(args.work, args.num_threads, note)}


def calibrate(args: argparse.Namespace) -> dict[str, Any]:
    """How long calibration takes at published size, and the errors of actions."""
    checkpoint = written(args.work / "n15-outliers", outliers=True)
    found = size.calibrate(checkpoint, args.work, args.num_threads, note)
    return found | {"errors": accuracy.measure(*size.calibrated(args.work), note)}


def on_libero(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Success on LIBERO."""
    return libero.measure(args.runs)


def by_bench(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Times of the head."""
    return bench.measure(args.files)


MEASUREMENTS = {
    "errors": errors,
    "loop": loop,
    "libero": on_libero,
    "full": full,
    "bench": by_bench,
    "calibrate": calibrate,
}


def main() -> int:
    """Measures, or reports."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m benches.int4", description=__doc__, formatter_class=raw)
    words = parser.add_subparsers(dest="what", required=True)
    of = {word: words.add_parser(word) for word in (*MEASUREMENTS, "report")}
    of["report"].add_argument("--write", action="store_true", help="write the page")
    for word in ("errors", "loop", "full", "calibrate"):
        work = ROOT / "out" / "int4"
        of[word].add_argument("--work", type=Path, default=work, help="recordings and checkpoints")
    for word in ("errors", "loop"):
        of[word].add_argument("--policy", type=Path, action="append", default=[], metavar="DIR")
    of["errors"].add_argument("--small", action="store_true", help="leave out the model of published width")
    of["loop"].add_argument("--episodes", type=int, default=300, help="of a policy (default: 300)")
    of["loop"].add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    of["libero"].add_argument("runs", type=Path, nargs="+", metavar="DIR", help="that --out named")
    of["bench"].add_argument("files", type=Path, nargs="+", metavar="FILE", help="that --json printed")
    for word in ("full", "calibrate"):
        of[word].add_argument("--num-threads", type=int, default=2)
    args = parser.parse_args()
    if args.what == "report":
        status = report(merged(), KEPT, PAGE, document, program="benches.int4", write=args.write)
        if args.write:
            MEASURED.unlink(missing_ok=True)
        return status
    before = json.loads(MEASURED.read_text()) if MEASURED.exists() else {}
    if "work" in args:
        args.work.mkdir(parents=True, exist_ok=True)
    MEASURED.parent.mkdir(exist_ok=True)
    measured = {"machine": describe()} | {"measured": MEASUREMENTS[args.what](args)}
    write_json(MEASURED, before | {args.what: measured})
    return 0


def merged() -> Path:
    """A file with what was measured since, and the committed measurements of the rest."""
    if not MEASURED.exists():
        return KEPT
    path = MEASURED.with_name("int4-report.json")
    write_json(path, json.loads(KEPT.read_text()) | json.loads(MEASURED.read_text()))
    return path


if __name__ == "__main__":
    sys.exit(main())
