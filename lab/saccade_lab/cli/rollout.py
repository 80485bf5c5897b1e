"""``saccade rollout``: runs a policy on camera images in closed loop; writes a result file and videos."""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade._internal.files import write_atomically, write_json
from saccade._internal.flags import add_data_config, add_overrides
from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, output
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB, require
from saccade_lab.files import data_config_text, path_text, writable_directory
from saccade_lab.parallel import Lost, Workers, check_lost, each
from saccade_lab.parallel.arguments import workers_of

if TYPE_CHECKING:
    from rich.table import Table

    from saccade_lab.sim.episodes import Episodes, Rolled
    from saccade_lab.sim.policy import Policy
    from saccade_lab.sim.report import Summary

HELP = "run a policy on the simulated robot, count successes"
EXTRAS = LAB

COLUMNS = 50  # of the contact sheet: with more seeds, only the first ones are shown

EPILOG = """\
Tasks of the demo, which the bundled policy knows: reach, push, drawer-open, button-press-topdown,
window-open. Harder tasks, for policies of your own: two-goals, stereo-reach, two-stage, fork,
touch-yellow, touch-blue.

The same seed gives the same layout, wording and noise with either engine. Seeds from 1000000 on are reserved
for training and refused.

--record writes a data set that lerobot and saccade.datasets.open read: every control step of every episode,
with what the policy saw, its actions, and the seeds of its noise. It is written when all episodes are done.

DIR receives results.json (after every episode), contact-sheet.png (of the first 50 seeds) and, with --video,
videos/TASK-SEED.mp4.
After Ctrl-C the episodes that are done are kept. With several processes the episodes are the same; an episode
whose process or machine died is run again.

examples:
  saccade rollout --video
  saccade rollout --tasks reach,push --episodes 20 --out out/twenty
  saccade rollout --checkpoint out/policy --engine torch --num-threads 1 --json
  saccade rollout --checkpoint out/policy --data-config my_data_config.json
  saccade rollout --tasks reach --episodes 10 --record out/reach
  saccade rollout --tasks reach --instruction-from push     the wrong instruction: it should fail
  saccade rollout --episodes 100 --jobs -1                  a process for each core
  saccade rollout --episodes 1000 --backend ray --address auto
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.epilog = EPILOG
    lab_flags.add_checkpoint(parser)
    parser.add_argument(
        "--engine",
        choices=("rust", "torch"),
        default="rust",
        help="what computes backbone and head (default: rust)",
    )
    add_data_config(parser)
    add_overrides(parser)
    lab_flags.add_tasks(parser)
    lab_flags.add_episodes(parser, 4)
    arguments.add_seed(parser, "seed of the first episode; the next ones count up")
    arguments.add_num_threads(
        parser, "threads of the action head (default: the physical cores; with several processes 1)"
    )
    arguments.add_processes(parser, "episodes")
    arguments.add_out(parser, "out/rollout")
    parser.add_argument("--video", action="store_true", help="write an MP4 of every episode")
    lab_flags.add_record(parser)
    parser.add_argument(
        "--instruction-from", metavar="TASK", help="give the policy the instruction of this task instead"
    )
    arguments.add_json(parser, "print results.json instead of a table")


@dataclass
class Session:
    """One run of the command: its arguments and the episodes so far."""

    episodes: Episodes
    tasks: list[str]
    seeds: range
    workers: Workers
    out: Path
    record_to: Path | None = None
    recordings: Path | None = None  # where they wait until all are there
    done: list[Rolled] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    @property
    def policy(self) -> Policy:
        """The policy, with which this process describes what it runs."""
        return self.episodes.policy

    def record(self) -> dict[str, Any]:
        """The content of the result file."""
        from saccade_lab.sim.report import result_record

        record = result_record(
            [rolled.episode for rolled in self.done],
            self.policy,
            seeds=self.seeds,
            tasks=self.tasks,
            instruction_from=self.episodes.instruction_from,
        )
        record |= self.episodes.overrides
        return record | {"processes": {"backend": self.workers.backend, "jobs": self.workers.jobs}}

    def run(self, on_episode: Callable[[Rolled], None]) -> None:
        """Runs all episodes and writes the result file after each of them, in the order of one process."""
        from saccade.robots.data_configs import RELEASED
        from saccade_lab.sim.episodes import Rolled

        items = [(task, seed) for task in self.tasks for seed in self.seeds]
        order = {item: position for position, item in enumerate(items)}
        files = [self.episodes.checkpoint]
        config = self.episodes.data_config
        if config is not None and config not in RELEASED:
            files.append(config)
        for (task, seed), rolled in each(self.episodes, items, self.workers, files):
            if isinstance(rolled, Lost):
                self.lost.append(f"{task} {seed}: {rolled.reason}")
                continue
            if rolled.video is not None and rolled.episode.video is not None:
                with write_atomically(self.out / rolled.episode.video) as temporary:
                    temporary.write_bytes(rolled.video)
            picture = rolled.picture if seed in self.seeds[:COLUMNS] else None
            self.done.append(Rolled(rolled.episode, picture))
            if self.recordings is not None and rolled.recording is not None:
                (self.recordings / f"{task}-{seed}").write_bytes(rolled.recording)
            self.done.sort(key=lambda one: order[one.episode.task, one.episode.seed])
            write_json(self.out / "results.json", self.record())
            on_episode(rolled)


def run(args: argparse.Namespace) -> int:
    """Checks everything that can be wrong, then rolls out."""
    from saccade_lab.sim.tasks import check_evaluation_seeds

    seeds = check_evaluation_seeds(args.seed, args.episodes)
    lab_flags.check_tasks(args.tasks or ())
    if args.instruction_from is not None:
        lab_flags.check_known("--instruction-from", [args.instruction_from], lab_flags.known_tasks())
    workers = workers_of(args, args.num_threads)
    require("rollout")
    lab_flags.check_record(args.record)
    session = prepare(args, seeds, workers)
    from saccade_lab.sim import environment_cache
    from saccade_lab.sim.report import write_contact_sheet

    writable_directory(session.out)
    if args.video:
        writable_directory(session.out / "videos")
    interrupted = False
    with tempfile.TemporaryDirectory(prefix="saccade-rollout-") as folder:
        session.recordings = None if args.record is None else Path(folder)
        try:
            roll_out(session)
            write_recordings_of(session)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            environment_cache.close()
    write_json(session.out / "results.json", session.record())
    pictures = [(rolled.episode, rolled.picture) for rolled in session.done if rolled.picture is not None]
    if pictures:
        write_contact_sheet(pictures, session.out / "contact-sheet.png")
    if args.json:
        output.print_json(session.record(), indent=2)
    else:
        show(session)
    check_lost(session.lost, len(session.tasks) * len(session.seeds))
    return EXIT_INTERRUPTED if interrupted else EXIT_OK


def prepare(args: argparse.Namespace, seeds: range, workers: Workers) -> Session:
    """Loads the policy; nothing is written yet."""
    from saccade_lab.sim import graphics
    from saccade_lab.sim.episodes import Episodes
    from saccade_lab.sim.policy import DEMO_CHECKPOINT, check_trained_on

    graphics.check()
    num_threads = args.num_threads if workers.alone else workers.num_threads
    checkpoint = path_text(args.checkpoint or DEMO_CHECKPOINT)
    episodes = Episodes(
        checkpoint,
        args.engine,
        num_threads,
        args.instruction_from,
        args.video,
        data_config_text(args.data_config),
        args.action_horizon,
        None if args.processor_options is None else json.dumps(args.processor_options),
        args.record is not None,
    )
    tasks = list(args.tasks or episodes.policy.config.tasks)
    check_trained_on(episodes.policy, tasks)
    return Session(episodes, tasks, seeds, workers, args.out, args.record)


def write_recordings_of(session: Session) -> None:
    """Writes the data set, if one is wanted and there are episodes."""
    from saccade_lab.sim.environment import SIMULATION_HZ
    from saccade_lab.sim.recordings import NOISE, Recording, write_recordings

    folder, config = session.recordings, session.policy.config
    if session.record_to is None or folder is None or not session.done:
        return
    names = [f"{rolled.episode.task}-{rolled.episode.seed}" for rolled in session.done]
    write_recordings(
        session.record_to,
        (Recording.from_bytes((folder / name).read_bytes()) for name in names),
        [camera.name for camera in config.cameras],
        config.image_size,
        SIMULATION_HZ,
        extra=NOISE,
    )


def roll_out(session: Session) -> None:
    """Runs the episodes with a progress bar."""
    with output.progress_bar("rollout", len(session.seeds) * len(session.tasks)) as update:

        def on_episode(rolled: Rolled) -> None:
            done = len(session.done)
            succeeded = sum(one.episode.success for one in session.done)
            update(done, description=f"{rolled.episode.task}: {succeeded} of {done} succeeded")

        session.run(on_episode)


def show(session: Session) -> None:
    """Prints the table and where the files are."""
    from saccade_lab.sim.report import summarize, summarize_tasks

    console = output.console()
    episodes = [rolled.episode for rolled in session.done]
    if not episodes:
        print("no episode was completed")
        return
    engine = session.policy.describe()
    said = {
        key: " ".join(value) or "none" if isinstance(value, list) else value for key, value in engine.items()
    }
    described = ", ".join(f"{key} {value}" for key, value in said.items() if key != "name")
    table = make_table(f"{engine['name']} engine ({described})")
    for summary in summarize_tasks(episodes):
        table.add_row(*cells(summary))
    table.add_section()
    table.add_row(*cells(summarize("all", episodes)), style="bold")
    console.print(table)
    print(f"results        {session.out / 'results.json'}")
    print(f"contact sheet  {session.out / 'contact-sheet.png'}")
    if session.episodes.video:
        print(f"videos         {session.out / 'videos'}")
    if session.record_to is not None and session.record_to.is_dir():
        print(f"recordings     {session.record_to}")


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
    from saccade_lab.sim.rollout import PARTS

    low, high = summary.interval
    return [
        summary.task,
        f"{summary.successes}/{summary.episodes}",
        f"{100 * low:.0f}–{100 * high:.0f}",
        "–" if summary.median_steps is None else f"{summary.median_steps:.0f}",
        *(f"{summary.milliseconds[part]:.1f}" for part in PARTS),
    ]
