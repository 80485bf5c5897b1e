"""`saccade study`: what the parts of an action head do, measured and reported with intervals."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade.cli import EXIT_OK, Parser
from saccade.study.study import STUDIES, load_study

if TYPE_CHECKING:
    from collections.abc import Sequence

HELP = "measure what the future tokens do, in closed loop and inside the head"

EPILOG = """\
OUT receives <study>.csv (a row a measurement) and <study>.json (settings, hashes, versions), after every cell
of work. Stopped at any time, the same command goes on where it was; with more tasks, episodes or arms it does
only what is new. `saccade study report OUT` makes one page of all studies in OUT.

examples:
  saccade study cuts --episodes 15 --out out/study
  saccade study patching --out out/study
  saccade study report out/study
"""


class StudyParser(Parser):
    """The parser of one study, which imports it only when its arguments are to be read."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)
        self.study: str | None = None

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """See argparse, which calls this for the chosen one only."""
        if self.study is not None:
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
        "report", help="one page of all studies in a directory", description="Makes one page of all studies."
    )
    report.add_argument("directory", type=Path, metavar="DIR", help="what the studies had as --out")
    report.add_argument("--json", action="store_true", help="print where the files are as JSON")


def add_common_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares what every study takes."""
    parser.add_argument(
        "--out", type=Path, default=Path("out/study"), help="where tables go (default: out/study)"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, help="cells at once; with loky -1 takes all cores (default: 1)"
    )
    parser.add_argument(
        "--backend", default="loky", metavar="loky|ray", help="processes here, or of a Ray cluster"
    )
    parser.add_argument("--json", action="store_true", help="print table and provenance as JSON")


def run(args: argparse.Namespace) -> int:
    """Runs the study, or makes the report."""
    return run_report(args) if args.study == "report" else measure(args)


def measure(args: argparse.Namespace) -> int:
    """Checks the arguments, works through the cells behind a progress bar, and says what came out."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from saccade._files import writable_directory
    from saccade.study.run import Finished, check_workers
    from saccade.study.run import run as run_study

    check_workers(args.backend, args.jobs)
    study = load_study(args.study).from_arguments(args)
    out = writable_directory(args.out)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task(args.study, total=None)

        def on_done(finished: Finished, done: int, total: int) -> None:
            progress.update(bar, completed=done, total=total, description=finished.cell.name)

        run_study(study, out, backend=args.backend, jobs=args.jobs, on_done=on_done)
    show(args.study, out, args.json)
    return EXIT_OK


def show(name: str, out: Path, as_json: bool) -> None:
    """Prints what the table allows to be said, and where it is."""
    from saccade.study import table as tables

    provenance = tables.read_provenance(tables.provenance_path(out, name))
    if as_json:
        rows: list[dict[str, Any]] = json.loads(
            tables.read_table(tables.table_path(out, name)).to_json(orient="records", double_precision=15)
        )
        print(json.dumps({"provenance": vars(provenance), "rows": rows}, indent=2, ensure_ascii=False))
        return
    section = load_study(name).summarise(tables.read_table(tables.table_path(out, name)), provenance)
    for line in section.concluded:
        print(f"- {line}")
    print(f"table   {tables.table_path(out, name)}")
    print(f"report  saccade study report {out}")


def run_report(args: argparse.Namespace) -> int:
    """Makes the report and says where it is."""
    from saccade.study.report import write_report

    page, markdown = write_report(args.directory)
    if args.json:
        print(json.dumps({"html": str(page), "markdown": str(markdown)}))
    else:
        print(f"page      {page}")
        print(f"markdown  {markdown}")
    return EXIT_OK
