"""The arguments, progress bar and messages of the commands that write a checkpoint from another one."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from saccade._internal import flags as arguments
from saccade.cli import output

if TYPE_CHECKING:
    from saccade.checkpoints import Written


def add_copy_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the checkpoint that is read and the one that is written."""
    arguments.add_checkpoint_argument(parser)
    arguments.add_out(parser, None, "directory of the checkpoint to write")
    arguments.add_config(parser)
    parser.add_argument("--force", action="store_true", help="replace a checkpoint at --out")
    arguments.add_json(parser, "print the report as JSON")


@contextlib.contextmanager
def copying(description: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar in bytes; yields a function that takes the bytes done and the bytes in all."""
    with output.progress_bar(description, in_bytes=True, transient=True) as update:
        yield lambda done, total: update(done, total)


def print_files_not_copied(report: Written) -> None:
    """Names the files next to the source's weights that were not copied, if there are any."""
    if report.left:
        print(f"not copied: {', '.join(map(str, report.left))}")
