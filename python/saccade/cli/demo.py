"""`saccade demo`: the bundled policy acts on recorded images, drawn in the terminal."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from saccade._internal.environment import show_config
from saccade._internal.flags import UsageError
from saccade.cli import EXIT_OK, drawing

if TYPE_CHECKING:
    from saccade._internal.arrays import Float32Array
    from saccade.checkpoints.demo_frames import Moment

HELP = "run the bundled policy on recorded images: try this first"
EPILOG = """\
The policy is small (2 million parameters) and was trained on five simulated tasks, in the released models'
structure. It is no released model. Images and state were recorded in simulation, and so was what the
scripted expert did from there on. reach and push have the same scene: give one the other's words.

examples:
  saccade demo
  saccade demo --task drawer-open
  saccade demo --task push --instruction "reach the green ball"
"""
TASK = "push"
#: What the numbers of an action are: velocities of the hand along three axes, and the gripper's effort.
NUMBERS = ("hand x", "hand y", "hand z", "gripper")
#: A view is drawn no wider than this.
WIDEST = 40
GAP = 2
#: Columns that the actions take with the expert's beside them, and alone with some of their values.
WITH_EXPERT, WITH_VALUES = 74, 56
REPEATS = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    parser.add_argument("--task", default=TASK, metavar="NAME", help=f"recorded task (default: {TASK})")
    parser.add_argument("--instruction", metavar="TEXT", help="other words than the recorded ones")


def run(args: argparse.Namespace) -> int:
    """Acts, and draws images and actions."""
    from saccade.checkpoints import demo_checkpoint
    from saccade.checkpoints.demo_frames import moments
    from saccade.policy.policy import Policy

    recorded = moments()
    if args.task not in recorded:
        raise UsageError(f"--task: unknown name {args.task!r}, expected one of {', '.join(recorded)}")
    moment = recorded[args.task]
    started = time.perf_counter()
    policy = Policy.from_pretrained(demo_checkpoint())
    loaded = time.perf_counter() - started
    instruction = moment.instruction if args.instruction is None else args.instruction
    observation = moment.observation(instruction)
    seconds = []
    for _ in range(1 + REPEATS):  # the first call also allocates its memory
        started = time.perf_counter()
        found = policy.act(observation, seed=0)
        seconds.append(time.perf_counter() - started)
    actions = np.concatenate([found["hand"][0], found["gripper"][0]], axis=-1)
    expert = moment.actions if instruction == moment.instruction else None
    print(f'{moment.task}: "{instruction}"')
    print("\n".join(views(moment)))
    print("\n".join(chart(actions, expert, shutil.get_terminal_size().columns)))
    print(times(policy.head.num_threads, loaded, float(np.median(seconds[1:]))))
    print("Next: saccade act CHECKPOINT, saccade serve CHECKPOINT, saccade --help")
    return EXIT_OK


def views(moment: Moment) -> list[str]:
    """The cameras' images side by side, as wide as the terminal allows, under their names."""
    columns = shutil.get_terminal_size().columns
    count = len(moment.images)
    width = max(4, min(WIDEST, (columns - GAP * (count - 1)) // count))
    colours = drawing.colours_of(sys.stdout)
    names = [name.ljust(width) for name in moment.images]
    gap = " " * GAP
    pictures = [drawing.picture(image, width, colours) for image in moment.images.values()]
    return [gap.join(names).rstrip(), *drawing.beside(pictures, gap)]


def chart(actions: Float32Array, expert: Float32Array | None, columns: int) -> list[str]:
    """A line for each number of the actions ``(steps, 4)``: its course and some values, and the expert's.

    ``expert`` is None if it was given other words than the policy. It is left out if ``columns`` are too few,
    and so are the values where there are bars.
    """
    steps = len(actions)
    with_bars = drawing.can_write(sys.stdout, drawing.BARS)
    if columns < WITH_EXPERT:
        expert = None
    with_values = columns >= WITH_VALUES or not with_bars
    shown = [0, steps // 3, 2 * steps // 3, steps - 1] if with_values else []
    ends = [0, steps - 1]
    head = "".join(f"{f'step {step}':>8}" for step in shown)
    heading = f"{f'{steps} actions, -1 to 1':<24}{head}{'' if expert is None else '  recorded expert'}"
    lines = [heading.rstrip()]
    for number, name in enumerate(NUMBERS):
        values = actions[:, number].tolist()
        course = drawing.bars(values) if with_bars else ""
        line = f"{name:<8}{course:<16}{values_at(values, shown)}"
        if expert is not None:
            other = expert[:, number].tolist()
            line += "  " + (drawing.bars(other) if with_bars else values_at(other, ends))
        lines.append(line)
    return lines


def values_at(values: Sequence[float], steps: Sequence[int]) -> str:
    """Some of the values, each in eight columns."""
    return "".join(f"{values[step]:8.2f}" for step in steps)


def times(num_threads: int, loaded: float, chunk: float) -> str:
    """How long loading and a chunk took, and on what."""
    isa = show_config("dicts")["isa"]
    threads = f"{num_threads} thread" + ("" if num_threads == 1 else "s")
    return f"Loaded in {1e3 * loaded:.0f} ms; {1e3 * chunk:.1f} ms from images to actions ({isa}, {threads})"
