"""`saccade demos`: scripted experts recorded through the policy's cameras."""

from __future__ import annotations

import argparse
import functools
from pathlib import Path

from saccade.cli import EXIT_OK, UsageError

HELP = "record demonstrations of the tasks with scripted experts"

EPILOG = """\
Tasks of the demo: reach, push, drawer-open, button-press-topdown, window-open. Harder ones, for studies:
two-goals, stereo-reach, two-stage, fork.

Writes OUT/TASK/SEED.npz. Stopped at any time, the same command goes on where it was. Two processes may record
into the same directory, each with tasks of its own.

examples:
  saccade demos --out out/demos                               what the shipped policy was trained on
  saccade demos --out out/demos --tasks reach --count 50
  saccade demos --out out/study --tasks two-goals,stereo-reach,two-stage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    parser.add_argument("--out", type=Path, required=True, help="directory of the recording")
    parser.add_argument(
        "--tasks", metavar="NAME,...", help="tasks, separated by commas (default: the five of the demo)"
    )
    parser.add_argument(
        "--count",
        type=int,
        help="demonstrations per task (default: 100; 300 of reach, 200 of each of the harder tasks)",
    )
    parser.add_argument("--image-size", type=int, default=64, help="pixels along each side (default: 64)")
    parser.add_argument(
        "--frame-stride", type=int, default=3, help="control steps between recorded observations (default: 3)"
    )


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then records task by task."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from saccade._files import writable_directory
    from saccade.cli.rollout import parse_tasks
    from saccade.sim import graphics
    from saccade.sim.tasks import DEMO_TASKS

    check_numbers(args)
    tasks = [task.name for task in DEMO_TASKS] if args.tasks is None else parse_tasks(args.tasks)
    graphics.check()
    # These import mujoco, which needs a working OpenGL.
    from saccade.sim.demos import DEFAULT_COUNTS, RecordingSettings, record_task

    settings = RecordingSettings(image_size=args.image_size, frame_stride=args.frame_stride)
    counts = {task: DEFAULT_COUNTS[task] if args.count is None else args.count for task in tasks}
    writable_directory(args.out)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        for task in tasks:
            bar = progress.add_task(task, total=counts[task])
            record_task(task, counts[task], args.out, settings, functools.partial(progress.advance, bar))
    print(f"{sum(counts.values())} demonstrations in {args.out}")
    return EXIT_OK


def check_numbers(args: argparse.Namespace) -> None:
    """Raises `UsageError` for a number that is too small."""
    for name, smallest in (("count", 1), ("image_size", 8), ("frame_stride", 1)):
        value = getattr(args, name)
        if value is not None and value < smallest:
            raise UsageError(f"--{name.replace('_', '-')}: given {value}, expected at least {smallest}")
