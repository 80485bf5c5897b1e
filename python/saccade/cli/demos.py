"""`saccade demos`: records scripted experts through the policy's cameras."""

from __future__ import annotations

import argparse

from saccade import _arguments as arguments
from saccade._files import writable_directory
from saccade.cli import EXIT_OK, _output, require

HELP = "record demonstrations of the tasks with scripted experts"

EPILOG = """\
Tasks of the demo: reach, push, drawer-open, button-press-topdown, window-open. Harder tasks, for studies:
two-goals, stereo-reach, two-stage, fork.

Writes DIR/TASK/SEED.npz. If the command is interrupted, run it again: it continues where it stopped. Two
processes may record different tasks into the same directory.

examples:
  saccade demos --out out/demos                               the data of the bundled policy
  saccade demos --out out/demos --tasks reach --episodes 50
  saccade demos --out out/study --tasks two-goals,stereo-reach,two-stage
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    from saccade.sim.cameras import DEFAULT_IMAGE_SIZE

    parser.epilog = EPILOG
    arguments.add_out(parser, None, "directory of the recording")
    arguments.add_tasks(parser, "tasks to record (default: the five of the demo)")
    arguments.add_episodes(
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


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then records task by task."""
    from saccade.sim.tasks import DEMO_TASKS

    arguments.check_tasks(args.tasks or ())
    require("demos")
    from saccade.sim import graphics
    from saccade.sim.demos import DEFAULT_COUNTS, RecordingSettings, record_task

    graphics.check()
    settings = RecordingSettings(image_size=args.image_size, frame_stride=args.frame_stride)
    tasks = args.tasks or [task.name for task in DEMO_TASKS]
    counts = {task: args.episodes or DEFAULT_COUNTS[task] for task in tasks}
    writable_directory(args.out)
    for task, count in counts.items():
        done = 0
        with _output.progress_bar(task, count) as update:

            def on_episode() -> None:
                nonlocal done
                done += 1
                update(done)

            record_task(task, count, args.out, settings, on_episode)
    print(f"{sum(counts.values())} demonstrations in {args.out}")
    return EXIT_OK
