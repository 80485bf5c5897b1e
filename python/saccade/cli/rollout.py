"""`saccade rollout`: closed loop on camera pixels, with a table, videos and a result file."""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from saccade.sim.environment import TaskEnvironment
    from saccade.sim.policy import Policy
    from saccade.sim.rendering import UInt8Array
    from saccade.sim.report import Summary
    from saccade.sim.rollout import Episode

HELP = "drive the simulated robot with a policy and report how often it succeeds"

EPILOG = """\
Tasks of the demo, which the shipped policy knows: reach, push, drawer-open, button-press-topdown,
window-open. Harder ones, for policies of your own: two-goals, stereo-reach, two-stage, fork.

The same seed gives the same layout, wording and noise, whichever engine runs. Seeds from 1000000 on are kept
for training and are refused.

OUT receives results.json (after every episode), contact-sheet.png and, with --video, videos/TASK-SEED.mp4.
Ctrl-C stops; the episodes that are done are kept.

examples:
  saccade rollout --video
  saccade rollout --tasks reach,push --episodes 20 --out out/twenty
  saccade rollout --engine torch --threads 1 --json
  saccade rollout --instruction-from push --tasks reach     tell it another task's words: it should fail
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    parser.add_argument(
        "--checkpoint", type=Path, metavar="DIR", help="policy to run (default: the one shipped)"
    )
    parser.add_argument(
        "--engine", choices=("rust", "torch"), default="rust", help="what computes the action head"
    )
    parser.add_argument(
        "--tasks", metavar="NAME,...", help="tasks, separated by commas (default: all that it knows)"
    )
    parser.add_argument("--episodes", type=int, default=4, help="episodes per task (default: 4)")
    parser.add_argument(
        "--seed", type=int, default=0, help="first seed; the next episodes count up (default: 0)"
    )
    parser.add_argument("--threads", type=int, help="threads of the action head (default: the engine's own)")
    parser.add_argument(
        "--out", type=Path, default=Path("out/rollout"), help="where results go (default: out/rollout)"
    )
    parser.add_argument("--video", action="store_true", help="write an MP4 of every episode")
    parser.add_argument(
        "--instruction-from", metavar="TASK", help="tell the policy this task's instruction instead"
    )
    parser.add_argument("--json", action="store_true", help="print the result file instead of a table")


@dataclass
class Session:
    """One call of the command: what was asked for, and what has been done so far."""

    policy: Policy
    tasks: list[str]
    seeds: range
    instruction_from: str | None
    out: Path
    video: bool
    episodes: list[Episode] = field(default_factory=list)
    pictures: list[tuple[Episode, UInt8Array]] = field(default_factory=list)

    def record(self) -> dict[str, Any]:
        """What the result file holds now."""
        from saccade.sim.report import result_record

        return result_record(
            self.episodes,
            self.policy,
            seeds=self.seeds,
            tasks=self.tasks,
            instruction_from=self.instruction_from,
        )

    def run(self, on_episode: Callable[[Episode], None]) -> None:
        """Runs all episodes; what is done is in the result file after each of them."""
        from saccade._files import write_json
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
        """One episode, with its video if asked for."""
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
    from rich.console import Console

    from saccade._files import writable_directory, write_json

    session = prepare(args)
    from saccade.sim.report import write_contact_sheet  # imports mujoco, which needs a working OpenGL

    writable_directory(session.out)
    if session.video:
        writable_directory(session.out / "videos")
    interrupted = False
    try:
        roll_out(session, Console(stderr=True))
    except KeyboardInterrupt:
        interrupted = True
    write_json(session.out / "results.json", session.record())
    if session.pictures:
        write_contact_sheet(session.pictures, session.out / "contact-sheet.png")
    if args.json:
        print(json.dumps(session.record(), indent=2))
    else:
        show(session, Console())
    return EXIT_INTERRUPTED if interrupted else EXIT_OK


def prepare(args: argparse.Namespace) -> Session:
    """Loads the policy and checks the arguments; nothing is written yet."""
    from saccade.sim import graphics
    from saccade.sim.policy import DEMO_CHECKPOINT, Policy, check_trained_on
    from saccade.sim.tasks import check_evaluation_seeds, find_task

    seeds = check_evaluation_seeds(args.seed, args.episodes)
    if args.threads is not None and args.threads < 1:
        raise UsageError(f"--threads: given {args.threads}, expected at least 1")
    named = None if args.tasks is None else parse_tasks(args.tasks)
    if args.instruction_from is not None:
        find_task(args.instruction_from)
    graphics.check()
    policy = Policy.load(args.checkpoint or DEMO_CHECKPOINT, engine=args.engine, num_threads=args.threads)
    tasks = named or list(policy.config.tasks)
    check_trained_on(policy, tasks)
    policy.warmup()
    return Session(policy, tasks, seeds, args.instruction_from, args.out, args.video)


def parse_tasks(text: str) -> list[str]:
    """Task names out of a list with commas, each once."""
    from saccade.sim.tasks import find_task

    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise UsageError("--tasks: expected at least one name")
    return list(dict.fromkeys(find_task(name).name for name in names))


def roll_out(session: Session, console: Any) -> None:
    """Runs the episodes behind a progress bar."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("rollout", total=len(session.seeds) * len(session.tasks))

        def on_episode(episode: Episode) -> None:
            done = sum(episode.success for episode in session.episodes)
            description = f"{episode.task}: {done} of {len(session.episodes)} succeeded"
            progress.update(bar, advance=1, description=description)

        session.run(on_episode)


def show(session: Session, console: Any) -> None:
    """Prints the table and where the files are."""
    from saccade.sim.report import summarize, summarize_tasks

    if not session.episodes:
        console.print("no episode was completed")
        return
    engine = session.policy.engine.describe()
    described = ", ".join(f"{key} {value}" for key, value in engine.items() if key != "name")
    table = make_table(f"{engine['name']} engine ({described})")
    for summary in summarize_tasks(session.episodes):
        table.add_row(*cells(summary))
    table.add_section()
    table.add_row(*cells(summarize("all", session.episodes)), style="bold")
    console.print(table)
    console.print(f"results        {session.out / 'results.json'}", soft_wrap=True, highlight=False)
    console.print(f"contact sheet  {session.out / 'contact-sheet.png'}", soft_wrap=True, highlight=False)
    if session.video:
        console.print(f"videos         {session.out / 'videos'}", soft_wrap=True, highlight=False)


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
