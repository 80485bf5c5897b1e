"""`saccade rollout`: runs a policy on camera images in closed loop; writes a result file and videos."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade import _arguments as arguments
from saccade._files import writable_directory, write_json
from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, _output, require

if TYPE_CHECKING:
    from rich.table import Table

    from saccade._arrays import UInt8Array
    from saccade.sim.environment import TaskEnvironment
    from saccade.sim.policy import Policy
    from saccade.sim.report import Summary
    from saccade.sim.rollout import Episode

HELP = "run a policy on the simulated robot and report how often it succeeds"

EPILOG = """\
Tasks of the demo, which the bundled policy knows: reach, push, drawer-open, button-press-topdown,
window-open. Harder tasks, for policies of your own: two-goals, stereo-reach, two-stage, fork.

The same seed gives the same layout, wording and noise with either engine. Seeds from 1000000 on are reserved
for training and refused.

DIR receives results.json (after every episode), contact-sheet.png and, with --video, videos/TASK-SEED.mp4.
After Ctrl-C the episodes that are done are kept.

examples:
  saccade rollout --video
  saccade rollout --tasks reach,push --episodes 20 --out out/twenty
  saccade rollout --checkpoint out/policy --engine torch --num-threads 1 --json
  saccade rollout --tasks reach --instruction-from push     the wrong instruction: it should fail
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    arguments.add_checkpoint(parser)
    parser.add_argument(
        "--engine",
        choices=("rust", "torch"),
        default="rust",
        help="what computes backbone and head (default: rust)",
    )
    arguments.add_tasks(parser)
    arguments.add_episodes(parser, 4)
    arguments.add_seed(parser, "seed of the first episode; the next ones count up")
    arguments.add_num_threads(parser)
    arguments.add_out(parser, "out/rollout")
    parser.add_argument("--video", action="store_true", help="write an MP4 of every episode")
    parser.add_argument(
        "--instruction-from", metavar="TASK", help="give the policy the instruction of this task instead"
    )
    arguments.add_json(parser, "print results.json instead of a table")


@dataclass
class Session:
    """One run of the command: its arguments and the episodes so far."""

    policy: Policy
    tasks: list[str]
    seeds: range
    instruction_from: str | None
    out: Path
    video: bool
    episodes: list[Episode] = field(default_factory=list)
    pictures: list[tuple[Episode, UInt8Array]] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """The content of the result file."""
        from saccade.sim.report import result_record

        return result_record(
            self.episodes,
            self.policy,
            seeds=self.seeds,
            tasks=self.tasks,
            instruction_from=self.instruction_from,
        )

    def run(self, on_episode: Callable[[Episode], None]) -> None:
        """Runs all episodes and writes the result file after each of them."""
        from saccade.sim.rollout import environment_for

        for task in self.tasks:
            with contextlib.closing(
                environment_for(self.policy, task, render_mode="rgb_array")
            ) as environment:
                for seed in self.seeds:
                    episode = self.run_one(environment, seed)
                    picture = environment.render()
                    assert picture is not None
                    self.episodes.append(episode)
                    self.pictures.append((episode, picture))
                    write_json(self.out / "results.json", self.record())
                    on_episode(episode)

    def run_one(self, environment: TaskEnvironment, seed: int) -> Episode:
        """Runs one episode, and writes its video if requested."""
        from saccade.sim.rollout import run_episode
        from saccade.sim.video import VideoWriter

        if not self.video:
            return run_episode(environment, self.policy, seed, instruction_from=self.instruction_from)
        name = f"videos/{environment.task.name}-{seed}.mp4"
        with VideoWriter(self.out / name) as video:
            episode = run_episode(
                environment, self.policy, seed, instruction_from=self.instruction_from, on_step=video.add
            )
        episode.video = name
        return episode


def run(args: argparse.Namespace) -> int:
    """Checks everything that can be wrong, then rolls out."""
    from saccade.sim.tasks import check_evaluation_seeds

    seeds = check_evaluation_seeds(args.seed, args.episodes)
    arguments.check_tasks(args.tasks or ())
    if args.instruction_from is not None:
        arguments.check_known("--instruction-from", [args.instruction_from], arguments.known_tasks())
    require("rollout")
    session = prepare(args, seeds)
    from saccade.sim.report import write_contact_sheet

    writable_directory(session.out)
    if session.video:
        writable_directory(session.out / "videos")
    interrupted = False
    try:
        roll_out(session)
    except KeyboardInterrupt:
        interrupted = True
    write_json(session.out / "results.json", session.record())
    if session.pictures:
        write_contact_sheet(session.pictures, session.out / "contact-sheet.png")
    if args.json:
        _output.print_json(session.record(), indent=2)
    else:
        show(session)
    return EXIT_INTERRUPTED if interrupted else EXIT_OK


def prepare(args: argparse.Namespace, seeds: range) -> Session:
    """Loads the policy; nothing is written yet."""
    from saccade.sim import graphics
    from saccade.sim.policy import DEMO_CHECKPOINT, Policy, check_trained_on

    graphics.check()
    policy = Policy.load(args.checkpoint or DEMO_CHECKPOINT, engine=args.engine, num_threads=args.num_threads)
    tasks = list(args.tasks or policy.config.tasks)
    check_trained_on(policy, tasks)
    policy.warmup()
    return Session(policy, tasks, seeds, args.instruction_from, args.out, args.video)


def roll_out(session: Session) -> None:
    """Runs the episodes with a progress bar."""
    with _output.progress_bar("rollout", len(session.seeds) * len(session.tasks)) as update:

        def on_episode(episode: Episode) -> None:
            done = len(session.episodes)
            succeeded = sum(episode.success for episode in session.episodes)
            update(done, description=f"{episode.task}: {succeeded} of {done} succeeded")

        session.run(on_episode)


def show(session: Session) -> None:
    """Prints the table and where the files are."""
    from saccade.sim.report import summarize, summarize_tasks

    console = _output.console()
    if not session.episodes:
        print("no episode was completed")
        return
    engine = session.policy.describe()
    described = ", ".join(f"{key} {value}" for key, value in engine.items() if key != "name")
    table = make_table(f"{engine['name']} engine ({described})")
    for summary in summarize_tasks(session.episodes):
        table.add_row(*cells(summary))
    table.add_section()
    table.add_row(*cells(summarize("all", session.episodes)), style="bold")
    console.print(table)
    print(f"results        {session.out / 'results.json'}")
    print(f"contact sheet  {session.out / 'contact-sheet.png'}")
    if session.video:
        print(f"videos         {session.out / 'videos'}")


def make_table(title: str) -> Table:
    """The empty table; it fits 80 columns."""
    from rich import box
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    table.caption = "milliseconds per chunk: render, backbone, encode, sample"
    table.caption_justify = "left"
    table.add_column("task", no_wrap=True)
    for heading in ("success", "95 %", "steps", "render", "backbone", "encode", "sample"):
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def cells(summary: Summary) -> list[str]:
    """One row of the table."""
    from saccade.sim.rollout import PARTS

    low, high = summary.interval
    return [
        summary.task,
        f"{summary.successes}/{summary.episodes}",
        f"{100 * low:.0f}–{100 * high:.0f}",
        "–" if summary.median_steps is None else f"{summary.median_steps:.0f}",
        *(f"{summary.milliseconds[part]:.1f}" for part in PARTS),
    ]
