"""``saccade demos``: records scripted experts through the policy's cameras."""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from saccade._internal import flags as arguments
from saccade.cli import EXIT_OK, output
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB, require
from saccade_lab.files import writable_directory
from saccade_lab.parallel.arguments import workers_of

HELP = "record demonstrations of the tasks with scripted experts"
EXTRAS = LAB

EPILOG = """\
Tasks of the demo: reach, push, drawer-open, button-press-topdown, window-open. Harder tasks, for studies:
two-goals, stereo-reach, two-stage, fork, touch-yellow, touch-blue.

--out writes DIR/TASK/SEED.npz for `saccade train`, --record a data set that lerobot and
saccade.datasets.open read. If the command is interrupted, run it again: with --out it
continues where it stopped. The files are the same with any number of processes and machines.

--env libero_object or libero_spatial records the tasks 0 to 9 of a suite of LIBERO instead, each
from wider placements than those that LIBERO evaluates on, a third of libero_object's after a grasp
that missed (extra libero).

examples:
  saccade demos --out out/demos                               the data of the bundled policy
  saccade demos --out out/demos --tasks reach --episodes 50
  saccade demos --out out/study --tasks two-goals,stereo-reach,two-stage --jobs -1
  saccade demos --record out/recordings --tasks reach --episodes 20
  saccade demos --out out/demos --backend ray --address auto
  saccade demos --env libero_object --out out/libero --jobs 2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    from saccade_lab.sim.cameras import DEFAULT_IMAGE_SIZE

    parser.epilog = EPILOG
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="directory of the recording, for `saccade train`"
    )
    lab_flags.add_record(parser)
    parser.add_argument(
        "--env",
        choices=("libero_object", "libero_spatial"),
        help="a suite of LIBERO instead of Meta-World",
    )
    lab_flags.add_tasks(
        parser, "tasks to record (default: the five of the demo); numbers of LIBERO's tasks (default: all)"
    )
    lab_flags.add_episodes(
        parser,
        None,
        "demonstrations per task (default: 100; 300 of reach, 200 of each of the harder tasks, 40 of each "
        "task of LIBERO)",
    )
    arguments.add_integer(
        parser,
        "--image-size",
        minimum=8,
        help=f"pixels along each side of an image (default: {DEFAULT_IMAGE_SIZE}; 256 on LIBERO)",
    )
    arguments.add_integer(
        parser,
        "--frame-stride",
        default=None,
        help="control steps between recorded observations (default: 3; 5 on LIBERO; 1 with --record)",
    )
    arguments.add_processes(parser, "demonstrations")


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then records."""
    if args.out is None and args.record is None:
        raise arguments.UsageError("expected --out or --record, or both")
    if args.record is not None and args.frame_stride not in (None, 1):
        raise arguments.UsageError(f"--frame-stride: expected 1 with --record, got {args.frame_stride}")
    plan = meta_world(args) if args.env is None else libero(args)
    with contextlib.ExitStack() as stack:
        update = stack.enter_context(output.progress_bar("demos", plan.total))
        if args.out is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="saccade-demos-")))
        else:
            folder = writable_directory(args.out)
        done = 0

        def on_episode(task: str) -> None:
            nonlocal done
            done += 1
            update(done, description=task)

        plan.record(folder, on_episode)
        if args.record is not None:
            update(done, description="writing the data set")
            plan.export(folder, args.record)
    places = " and ".join(str(path) for path in (args.out, args.record) if path is not None)
    print(f"{plan.total} demonstrations in {places}")
    return EXIT_OK


@dataclass(frozen=True)
class Plan:
    """What is recorded.

    Attributes:
        total: Number of demonstrations.
        record: Records them in a directory, and calls a function with the task after each.
        export: Writes the recording of a directory as a data set, to a path.
    """

    total: int
    record: Callable[[Path, Callable[[str], None]], None]
    export: Callable[[Path, Path], None]


def meta_world(args: argparse.Namespace) -> Plan:
    """Checks the arguments for tasks of Meta-World."""
    from saccade_lab.sim.cameras import DEFAULT_IMAGE_SIZE
    from saccade_lab.sim.tasks import DEMO_TASKS

    lab_flags.check_tasks(args.tasks or ())
    workers = workers_of(args)
    require("demos")
    lab_flags.check_record(args.record)
    from saccade_lab.sim import demos, graphics

    graphics.check()
    stride = args.frame_stride or (3 if args.record is None else 1)
    size = args.image_size or DEFAULT_IMAGE_SIZE
    settings = demos.RecordingSettings(image_size=size, frame_stride=stride)
    tasks = args.tasks or [task.name for task in DEMO_TASKS]
    counts = {task: args.episodes or demos.DEFAULT_COUNTS[task] for task in tasks}

    def record(folder: Path, on_episode: Callable[[str], None]) -> None:
        demos.record_tasks(counts, folder, settings, on_episode, workers)

    def export(folder: Path, path: Path) -> None:
        demos.export(folder, counts, path)

    return Plan(sum(counts.values()), record, export)


def libero(args: argparse.Namespace) -> Plan:
    """Checks the arguments for tasks of LIBERO."""
    workers = workers_of(args)
    numbers = task_numbers(args.tasks)
    require("demos --env")
    lab_flags.check_record(args.record)
    from saccade_lab.libero import demos, packages
    from saccade_lab.sim import graphics

    packages.require()
    graphics.check()
    stride = args.frame_stride or (demos.FRAME_STRIDE if args.record is None else 1)
    size = args.image_size or demos.IMAGE_SIZE
    tasks = [
        demos.recording(args.env, number, size, stride)
        for number in (demos.all_tasks(args.env) if numbers is None else numbers)
    ]
    count = args.episodes or demos.DEFAULT_COUNT

    def record(folder: Path, on_episode: Callable[[str], None]) -> None:
        demos.record(tasks, count, folder, on_episode, workers)

    def export(folder: Path, path: Path) -> None:
        demos.export(folder, tasks, count, path)

    return Plan(len(tasks) * count, record, export)


def task_numbers(words: Sequence[str] | None) -> list[int] | None:
    """The numbers of LIBERO's tasks, in increasing order; None for all.

    Raises:
        UsageError: A word is no number.
    """
    wrong = [word for word in words or () if not word.isascii() or not word.isdigit()]
    if wrong:
        raise arguments.UsageError(f"--tasks: expected numbers of LIBERO's tasks, got {', '.join(wrong)}")
    return None if words is None else sorted({int(word) for word in words})
