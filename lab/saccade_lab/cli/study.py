"""``saccade study``: measures what the parts of an action head contribute, and reports it with intervals."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade.cli import EXIT_OK, Parser, output
from saccade_lab.extras import LAB, require
from saccade_lab.files import writable_directory
from saccade_lab.parallel.arguments import workers_of
from saccade_lab.study.study import STUDIES, Study, load_study

if TYPE_CHECKING:
    from collections.abc import Sequence

HELP = "measure what the parts of an action head contribute"
EXTRAS = LAB

EPILOG = """\
DIR receives STUDY.csv (one row per measurement) and STUDY.json (settings, hashes, versions) after every cell
of work. If a study is interrupted, run the same command again: it continues where it stopped. With more
tasks, episodes or arms it computes only what is missing. `saccade study report DIR` makes one page of all
studies in DIR.

examples:
  saccade study cuts --episodes 15 --out out/study
  saccade study patching --out out/study
  saccade study report out/study
"""


class StudyParser(Parser):
    """The parser of one study, whose module is imported only if that study was chosen."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)
        self.study: str | None = None

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """See argparse, which calls this for the chosen study only."""
        if self.study is not None:
            require("study --features")  # what declaring the arguments imports
            load_study(self.study).add_arguments(self)
            add_common_arguments(self)
            self.study = None
        return super().parse_known_args(args, namespace)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the studies, each a command of its own, and the report."""
    parser.epilog = EPILOG
    studies = parser.add_subparsers(
        dest="study", metavar="study", title="studies", required=True, parser_class=StudyParser
    )
    for name, (_, help_line) in STUDIES.items():
        sub = studies.add_parser(name, help=help_line, description=help_line[0].upper() + help_line[1:] + ".")
        sub.study = name
    report = studies.add_parser(
        "report",
        help="one page of all studies in a directory",
        description="Makes one page of all studies in a directory, from their tables alone.",
        epilog="examples:\n  saccade study report out/study",
    )
    report.add_argument("directory", type=Path, metavar="DIR", help="the --out of the studies")
    arguments.add_json(report, "print the paths of the files as JSON")


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares what every study takes."""
    arguments.add_out(parser, "out/study", "directory of the tables")
    arguments.add_processes(parser, "cells")
    arguments.add_json(parser, "print table and provenance as JSON")


def run(args: argparse.Namespace) -> int:
    """Runs the study, or makes the report."""
    if args.study == "report":
        require("study report")
        return run_report(args)
    recorded = [getattr(args, name, None) for name in ("features", "frames")]
    require("study" if recorded == [None, None] else "study --features")
    kind = load_study(args.study)
    show(kind, compute(kind, args), args.json)
    return EXIT_OK


def compute(kind: type[Study], args: argparse.Namespace) -> Path:
    """Checks the arguments, and works through the cells with a progress bar.

    Args:
        kind: The study.
        args: As its ``add_arguments`` and ``add_common_arguments`` declare them.

    Returns:
        The directory of the table.
    """
    from saccade_lab.study.run import Finished
    from saccade_lab.study.run import run as run_study

    workers = workers_of(args)
    with output.progress_bar("loading", transient=True) as loading:
        args.on_observation = lambda done, total: loading(done, total, "reading the images")
        study = kind.from_arguments(args)
    out = writable_directory(args.out)
    with output.progress_bar(kind.name) as update:

        def on_done(finished: Finished, done: int, total: int) -> None:
            update(done, total, finished.cell.name)

        run_study(study, out, workers=workers, on_done=on_done)
    return out


def show(kind: type[Study], out: Path, as_json: bool) -> None:
    """Prints the conclusions that the table supports, and where it is."""
    from saccade_lab.study import table as tables

    path = tables.table_path(out, kind.name)
    provenance = tables.read_provenance(tables.provenance_path(out, kind.name))
    if as_json:
        rows: list[dict[str, Any]] = json.loads(
            tables.read_table(path).to_json(orient="records", double_precision=15)
        )
        output.print_json({"provenance": vars(provenance), "rows": rows}, indent=2)
        return
    for line in kind.summarise(tables.read_table(path), provenance).concluded:
        print(f"- {line}")
    print(f"table   {path}")
    print(f"report  saccade study report {out}")


def run_report(args: argparse.Namespace) -> int:
    """Makes the report and prints where it is."""
    from saccade_lab.study.report import write_report

    page, markdown = write_report(args.directory)
    if args.json:
        output.print_json({"html": str(page), "markdown": str(markdown)})
    else:
        print(f"page      {page}")
        print(f"markdown  {markdown}")
    return EXIT_OK
