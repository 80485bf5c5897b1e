"""``saccade demos``: records scripted experts through the policy's cameras."""

from __future__ import annotations

import argparse

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
two-goals, stereo-reach, two-stage, fork.

Writes DIR/TASK/SEED.npz. If the command is interrupted, run it again: it continues where it stopped. The
files are the same with any number of processes and machines.

examples:
  saccade demos --out out/demos                               the data of the bundled policy
  saccade demos --out out/demos --tasks reach --episodes 50
  saccade demos --out out/study --tasks two-goals,stereo-reach,two-stage --jobs -1
  saccade demos --out out/demos --backend ray --address auto
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    from saccade_lab.sim.cameras import DEFAULT_IMAGE_SIZE

    parser.epilog = EPILOG
    arguments.add_out(parser, None, "directory of the recording")
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
        parser, "--frame-stride", default=3, help="control steps between recorded observations"
    )
    add_worker_arguments(parser, "demonstrations")


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then records."""
    from saccade_lab.sim.tasks import DEMO_TASKS

    lab_flags.check_tasks(args.tasks or ())
    workers = workers_of(args)
    require("demos")
    from saccade_lab.sim import graphics
    from saccade_lab.sim.demos import DEFAULT_COUNTS, RecordingSettings, record_tasks

    graphics.check()
    settings = RecordingSettings(image_size=args.image_size, frame_stride=args.frame_stride)
    tasks = args.tasks or [task.name for task in DEMO_TASKS]
    counts = {task: args.episodes or DEFAULT_COUNTS[task] for task in tasks}
    writable_directory(args.out)
    done = 0
    with output.progress_bar("demos", sum(counts.values())) as update:

        def on_episode(task: str) -> None:
            nonlocal done
            done += 1
            update(done, description=task)

        record_tasks(counts, args.out, settings, on_episode, workers)
    print(f"{sum(counts.values())} demonstrations in {args.out}")
    return EXIT_OK
