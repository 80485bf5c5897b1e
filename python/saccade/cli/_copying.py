"""What the commands that write a checkpoint from another have in common: arguments, a bar, what is said."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from saccade.checkpoints import Written


def add_copy_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares from what to what is written, and how it is told."""
    parser.add_argument("source", type=Path, help="checkpoint: a directory or one .safetensors file")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory to write")
    parser.add_argument("--config", type=Path, help="default: config.json beside the weights")
    parser.add_argument("--force", action="store_true", help="replace a checkpoint that is there")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


@contextlib.contextmanager
def copying(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar on standard error for work on a checkpoint; what it gives is called with bytes done and bytes in
    all.

    Args:
        what: is done.
    """
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    # Where nobody sees it, it would still leave an empty line.
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("", total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)


def left_behind(report: Written) -> None:
    """Says what lay beside the source's weights and was not copied, if anything."""
    if report.left:
        print(f"not copied: {', '.join(map(str, report.left))}")
