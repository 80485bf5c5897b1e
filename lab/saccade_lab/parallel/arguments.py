"""The processes that the flags of a command ask for."""

from __future__ import annotations

import argparse

from saccade._internal.flags import processes
from saccade_lab.parallel.workers import Workers


def workers_of(args: argparse.Namespace, num_threads: int | None = None) -> Workers:
    """The processes, from the flags of ``saccade._internal.flags.add_processes``.

    Args:
        args: The parsed arguments.
        num_threads: Threads of one item; None for 1.

    Raises:
        UsageError: As ``processes``.
        InputError: As ``Workers``.
    """
    return Workers(**processes(args), num_threads=num_threads or 1)
