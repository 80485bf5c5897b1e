"""The flags of commands that run in several processes."""

from __future__ import annotations

import argparse

from saccade_lab.parallel.workers import Workers


def add_arguments(parser: argparse.ArgumentParser, items: str) -> None:
    """Declares where a command runs.

    Args:
        parser: Parser of the command.
        items: What is computed at the same time, in the plural.
    """
    group = parser.add_argument_group("several processes")
    group.add_argument(
        "--jobs",
        type=int,
        metavar="N",
        help=f"{items} computed at the same time, in processes of their own; -1 for one per core; with 1 "
        "the command itself computes (default: 1; with ray -1)",
    )
    group.add_argument(
        "--backend",
        default="loky",
        metavar="loky|ray",
        help="processes on this machine, or on a Ray cluster (default: loky)",
    )
    group.add_argument(
        "--address",
        metavar="ADDRESS",
        help="address of the Ray cluster (default: RAY_ADDRESS, or the one that runs on this machine)",
    )


def workers_of(args: argparse.Namespace, num_threads: int | None = None) -> Workers:
    """The processes, from the flags of ``add_arguments``.

    Args:
        args: The parsed arguments.
        num_threads: Threads of one item; None for 1.

    Raises:
        InputError: As ``Workers``.
    """
    jobs = args.jobs
    if jobs is None:
        jobs = -1 if args.backend == "ray" else 1
    return Workers(args.backend, jobs, args.address, num_threads or 1)
