"""The arguments, progress bar and messages of the commands that write a checkpoint from another one."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from saccade._internal import flags as arguments
from saccade.cli import EXIT_OK, output

if TYPE_CHECKING:
    from saccade.checkpoints import Written

Report = TypeVar("Report", bound="Written")


def add_copy_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the checkpoint that is read and the one that is written."""
    arguments.add_checkpoint_argument(parser)
    arguments.add_out(parser, None, "directory of the checkpoint to write")
    arguments.add_config(parser)
    parser.add_argument("--force", action="store_true", help="replace a checkpoint at --out")
    arguments.add_json(parser, "print the report as JSON")


def copy(write: Callable[..., Report], doing: str, args: argparse.Namespace, **options: Any) -> Report:
    """Writes the copy with a function of `saccade.checkpoints`, under a progress bar in bytes."""
    common = {"config": args.config, "force": args.force}
    with output.progress_bar(doing, in_bytes=True, transient=True) as update:
        return write(args.checkpoint, args.out, progress=update, **common, **options)


def print_report(args: argparse.Namespace, report: Written, lines: list[str], **more: object) -> int:
    """Prints the report: as JSON with `more`, or lines about it and the files that were not copied."""
    if args.json:
        output.print_json({**dataclasses.asdict(report), **more}, default=str)
        return EXIT_OK
    left = [f"not copied: {', '.join(map(str, report.left))}"] if report.left else []
    print("\n".join([*lines, *left]))
    return EXIT_OK
