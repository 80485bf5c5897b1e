"""What int4 costs and saves: errors of actions, sensitive layers, memory and loading.

    python -m benches.int4 [--work DIR] [--small]           measures, into out/int4.json
    python -m benches.int4 --full CHECKPOINT                also memory and loading of this N1.5
    python -m benches.int4 report [--write]                 prints the page, or writes docs/results/int4.md

Needs the lab with its simulator: the bundled policy is recorded in its tasks first. About half an hour.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from benches.int4 import accuracy, groups, size
from benches.int4.page import document
from benches.pages.report import report
from benches.peers.machine import describe
from saccade._internal.files import write_json

ROOT = Path(__file__).parents[2]
MEASURED = ROOT / "out" / "int4.json"
KEPT = Path(__file__).with_name("results.json")
PAGE = ROOT / "docs" / "results" / "int4.md"

#: The models whose groups of layers are measured one by one.
BY_GROUP = 2


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """All measurements."""

    def note(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    found: dict[str, Any] = {"machine": describe(), "accuracy": {}, "groups": {}, "size": None}
    args.work.mkdir(parents=True, exist_ok=True)
    for index, model in enumerate(accuracy.models(args.work, small=args.small)):
        folders = accuracy.copies(model, args.work)
        found["accuracy"][model.name] = accuracy.measure(model, folders, note)
        if index < BY_GROUP:
            found["groups"][model.name] = groups.measure(model, folders, args.work, note)
    if args.full is not None:
        found["size"] = size.measure(args.full, args.work, args.num_threads, note)
    return found


def main() -> int:
    """Measures, or reports."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("what", nargs="?", choices=("measure", "report"), default="measure")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "int4", help="recordings and checkpoints")
    parser.add_argument("--small", action="store_true", help="leave out the model of published width")
    parser.add_argument("--full", type=Path, metavar="CHECKPOINT", help="a whole N1.5 of published size")
    parser.add_argument("--num-threads", type=int, default=2)
    parser.add_argument("--write", action="store_true", help="report: write the page")
    args = parser.parse_args()
    if args.what == "report":
        return report(MEASURED, KEPT, PAGE, document, program="benches.int4", write=args.write)
    MEASURED.parent.mkdir(exist_ok=True)
    write_json(MEASURED, measure(args))
    return 0


if __name__ == "__main__":
    sys.exit(main())
