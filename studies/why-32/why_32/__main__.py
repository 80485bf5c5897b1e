"""`python -m why_32`: runs the study, or writes its report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from saccade._internal import flags
from saccade.cli import EXIT_OK, Parser, describe, plain_warnings, refuse, terminable
from saccade.errors import SaccadeError
from saccade_lab.cli.study import compute
from saccade_lab.files import writable_directory
from saccade_lab.study.table import read_study, table_path
from why_32.report import require_commits, write_report
from why_32.study import Answer

HERE = Path(__file__).parent.parent
ALLOW_CHANGED = ("two-cameras",)  # measured with uncommitted changes: README.md, "Machines"


def build_parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    parser = Parser(prog="python -m why_32", description="How many future tokens does a policy need?")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=Parser)
    run = commands.add_parser("run", help="train the policies of the plan and judge them")
    Answer.add_arguments(run)
    flags.add_out(run, "out/why-32", "directory of the table and of what is trained")
    flags.add_processes(run, "cells")
    report = commands.add_parser("report", help="write report.md and its figures from the table")
    report.add_argument(
        "directory", type=Path, nargs="?", default=HERE, metavar="DIR", help="the --out of run"
    )
    report.add_argument("--out", type=Path, metavar="DIR", help="directory of the report (default: the same)")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: The arguments; None takes those of the process.

    Returns:
        The exit status: 0, or 2 with one line on standard error for bad input.
    """
    args = build_parser().parse_args(argv)
    try:
        with terminable(), plain_warnings():
            if args.command == "report":
                run_report(args)
            else:
                print(table_path(compute(Answer, args), Answer.name))
    except (flags.UsageError, SaccadeError, OSError) as error:
        return refuse(describe(error))
    return EXIT_OK


def run_report(args: argparse.Namespace) -> None:
    """Writes the report and prints where it is."""
    table, provenance = read_study(args.directory, Answer.name)
    require_commits(table, allow_changed=ALLOW_CHANGED)
    out = writable_directory(args.out or args.directory)
    print(write_report(Answer.summarise(table, provenance), provenance, out))


if __name__ == "__main__":
    sys.exit(main())
