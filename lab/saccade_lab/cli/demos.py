"""``saccade demos``: records scripted experts through the policy's cameras."""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from pathlib import Path

from saccade._internal import flags as arguments
from saccade.cli import EXIT_OK, output
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB, require
from saccade_lab.files import writable_directory
from saccade_lab.parallel.arguments import add_arguments as add_worker_arguments
from saccade_lab.parallel.arguments import workers_of

HELP = "record demonstrations of the tasks with scripted experts"
EXTRAS = LAB

EPILOG = """\
Tasks of the demo: reach, push, drawer-open, button-press-topdown, window-open. Harder tasks, for studies:
two-goals, stereo-reach, two-stage, fork, touch-yellow, touch-blue.

--out writes DIR/TASK/SEED.npz for `saccade train`, --record a data set that lerobot and
saccade.datasets.open read. If the command is interrupted, run it again: with --out it
continues where it stopped. The files are the same with any number of processes and machines.

examples:
  saccade demos --out out/demos                               the data of the bundled policy
  saccade demos --out out/demos --tasks reach --episodes 50
  saccade demos --out out/study --tasks two-goals,stereo-reach,two-stage --jobs -1
  saccade demos --record out/recordings --tasks reach --episodes 20
  saccade demos --out out/demos --backend ray --address auto
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    from saccade_lab.sim.cameras import DEFAULT_IMAGE_SIZE

    parser.epilog = EPILOG
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="directory of the recording, for `saccade train`"
    )
    lab_flags.add_record(parser)
    lab_flags.add_tasks(parser, "tasks to record (default: the five of the demo)")
    lab_flags.add_episodes(
        parser,
        None,
        "demonstrations per task (default: 100; 300 of reach, 200 of each of the harder tasks)",
    )
    arguments.add_integer(
        parser,
        "--image-size",
        minimum=8,
        default=DEFAULT_IMAGE_SIZE,
        help="pixels along each side of an image",
    )
    arguments.add_integer(
        parser,
        "--frame-stride",
        default=None,
        help="control steps between recorded observations (default: 3; 1 with --record)",
    )
    add_worker_arguments(parser, "demonstrations")


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then records."""
    from saccade_lab.sim.tasks import DEMO_TASKS

    lab_flags.check_tasks(args.tasks or ())
    if args.out is None and args.record is None:
        raise arguments.UsageError("expected --out or --record, or both")
    if args.record is not None and args.frame_stride not in (None, 1):
        raise arguments.UsageError(f"--frame-stride: expected 1 with --record, got {args.frame_stride}")
    workers = workers_of(args)
    require("demos")
    lab_flags.check_record(args.record)
    from saccade_lab.sim import graphics
    from saccade_lab.sim.demos import DEFAULT_COUNTS, RecordingSettings, export, record_tasks

    graphics.check()
    stride = args.frame_stride or (3 if args.record is None else 1)
    settings = RecordingSettings(image_size=args.image_size, frame_stride=stride)
    tasks = args.tasks or [task.name for task in DEMO_TASKS]
    counts = {task: args.episodes or DEFAULT_COUNTS[task] for task in tasks}
    done = 0
    with contextlib.ExitStack() as stack:
        update = stack.enter_context(output.progress_bar("demos", sum(counts.values())))
        if args.out is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="saccade-demos-")))
        else:
            folder = writable_directory(args.out)

        def on_episode(task: str) -> None:
            nonlocal done
            done += 1
            update(done, description=task)

        record_tasks(counts, folder, settings, on_episode, workers)
        if args.record is not None:
            update(done, description="writing the data set")
            export(folder, counts, args.record)
    places = " and ".join(str(path) for path in (args.out, args.record) if path is not None)
    print(f"{sum(counts.values())} demonstrations in {places}")
    return EXIT_OK
