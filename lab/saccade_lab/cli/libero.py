"""``saccade libero``: how often a checkpoint succeeds on LIBERO, by a released protocol."""

from __future__ import annotations

import argparse
import datetime
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade._internal.files import write_atomically
from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, output
from saccade.errors import InputError
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB, require
from saccade_lab.files import path_text, writable_directory
from saccade_lab.parallel import Lost, Workers, check_lost, each
from saccade_lab.parallel.arguments import workers_of

if TYPE_CHECKING:
    from saccade_lab.libero.episode import Key
    from saccade_lab.libero.episodes import Episodes, Rolled
    from saccade_lab.libero.policy import LiberoPolicy
    from saccade_lab.libero.results import Results

#: Protocols whose programs fail after the last official state; others begin again with the first one.
END_WITH_STATES = ("isaac-n15",)

HELP = "run a policy on LIBERO by a released protocol"
EXTRAS = LAB

EPILOG = """\
Suites: libero_spatial, libero_object, libero_goal, libero_10 (10 tasks each), libero_90, and LIBERO-PRO's
perturbed ones, libero_object_lan, _object, _swap and _task, and so on.

A protocol is what one of three released programs does: where episodes begin, how long they last, how many
actions of a chunk are executed, the size of frames, what the gripper's number means. Rates of different
protocols do not compare. It is printed, and stands in the results. auto takes that of the program that the
checkpoint comes from, and reads the gripper's meaning from the statistics. docs/libero.md has all three.

DIR receives results.json after every episode, index.html, pictures/, and with --video videos/. A run that was
interrupted goes on where it stopped; more tasks or trials are added to what is there.

examples:
  saccade libero my-policy/ --suite libero_object
  saccade libero my-policy/ --suite libero_object --tasks 0,3 --trials 2 --out out/two --video
  saccade libero my-policy/ --suite libero_object,libero_object_swap --protocol isaac-n17 --trials 50 --jobs 2
  saccade libero GR00T-N1.5-libero/ --suite libero_goal --precision int8 \\
      --data-config examples.Libero.custom_data_config:LiberoDataConfigMeanStd
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    from saccade_lab.libero.protocols import AUTO, PROTOCOLS

    parser.epilog = EPILOG
    arguments.add_checkpoint_argument(parser)
    arguments.add_list(
        parser, "--suite", default=("libero_object",), help="suites to run (default: libero_object)"
    )
    arguments.add_list(
        parser,
        "--tasks",
        item=int,
        metavar="N",
        minimum=0,
        help="tasks of each suite, counted from 0 (default: all)",
    )
    arguments.add_integer(parser, "--trials", default=10, help="episodes of each task")
    parser.add_argument(
        "--protocol",
        choices=(AUTO, *PROTOCOLS),
        default=AUTO,
        help="the released program that is followed (default: auto, by the checkpoint)",
    )
    arguments.add_seed(parser, "seed of the noise, which is another one in each episode")
    parser.add_argument(
        "--same-noise",
        action="store_true",
        help="noise of every episode from the seeds N, N + 1, ..., as `lerobot-eval --policy.seed=N` has it",
    )
    arguments.add_policy_options(parser)
    arguments.add_num_threads(parser, "threads (default: the physical cores; with several processes 1)")
    arguments.add_processes(parser, "episodes")
    arguments.add_out(parser, "out/libero")
    parser.add_argument("--video", action="store_true", help="write an MP4 of every episode")
    arguments.add_json(parser, "print results.json instead of a table")


@dataclass
class Session:
    """One run of the command: what it is asked for, and the episodes so far."""

    episodes: Episodes
    items: list[Key]
    results: Results
    workers: Workers
    out: Path
    about: Mapping[str, Any]
    lost: list[str] = field(default_factory=list)

    def run(self) -> None:
        """Runs the episodes that are missing, with a progress bar; the result file follows each of them."""
        from saccade.evaluation.source import OPTION_FILES

        todo = self.results.missing(self.items)
        done = len(self.items) - len(todo)
        begun, count = time.monotonic(), 0
        files = [self.episodes.checkpoint]
        files += [
            value
            for name in OPTION_FILES
            if isinstance(value := self.episodes.options.get(name), str) and Path(value).exists()
        ]
        with output.progress_bar("libero", len(self.items)) as update:
            update(done)
            for key, rolled in each(self.episodes, todo, self.workers, files):
                if isinstance(rolled, Lost):
                    self.lost.append(f"{' '.join(map(str, key))}: {rolled.reason}")
                    continue
                self.keep(key, rolled)
                count += 1
                update(done + count, description=self.progress(begun, count, len(todo)))

    def keep(self, key: Key, rolled: Rolled) -> None:
        """Adds an episode, and writes the files about it."""
        name = "-".join(map(str, key))
        files = {f"pictures/{name}.png": rolled.picture, f"videos/{name}.mp4": rolled.video}
        for path, content in files.items():
            if content is not None:
                with write_atomically(self.out / path) as temporary:
                    temporary.write_bytes(content)
        self.results.add(rolled.episode)
        self.results.write(self.out, self.about)

    def without_video(self) -> str:
        """How many episodes have no video, in words; nothing if all have one."""
        done = list(self.results.episodes)
        count = sum(not (self.out / f"videos/{'-'.join(map(str, key))}.mp4").is_file() for key in done)
        return f" ({count} of {len(done)} episodes have none: they ran without --video)" if count else ""

    def progress(self, begun: float, count: int, total: int) -> str:
        """How many have succeeded, and when the last episode is expected to end."""
        own = [self.results.episodes[item] for item in self.items if item in self.results.episodes]
        succeeded = sum(one.success for one in own)
        left = (time.monotonic() - begun) / count * (total - count)
        end = datetime.datetime.now() + datetime.timedelta(seconds=left)
        return f"libero: {succeeded} succeeded, ends about {end:%a %H:%M}"


def run(args: argparse.Namespace) -> int:
    """Checks everything that can be wrong, then runs the episodes."""
    from saccade_lab.libero.suites import find_suite

    for suite in map(find_suite, args.suite):
        lab_flags.indices("--tasks", args.tasks, suite.num_tasks)
    workers = workers_of(args, args.num_threads)
    require("libero")
    session = prepare(args, workers)
    from saccade_lab.libero.page import write_page
    from saccade_lab.sim import environment_cache

    for folder in ("pictures", "videos") if args.video else ("pictures",):
        writable_directory(session.out / folder)
    interrupted = False
    try:
        session.run()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        environment_cache.close()
    session.results.write(session.out, session.about)
    record = session.results.record(session.about)
    write_page(record, session.out)
    if args.json:
        output.print_json(record, indent=2)
    else:
        show(session, record)
    check_lost(session.lost, len(session.items))
    return EXIT_INTERRUPTED if interrupted else EXIT_OK


def prepare(args: argparse.Namespace, workers: Workers) -> Session:
    """Loads the policy and what is there of the results; nothing is written yet."""
    from saccade._internal.environment import library
    from saccade._internal.hub import locate
    from saccade.evaluation.source import OPTION_FILES, weights_hash
    from saccade_lab.libero import packages
    from saccade_lab.libero.episode import Noise
    from saccade_lab.libero.episodes import Episodes
    from saccade_lab.libero.results import Results, software
    from saccade_lab.libero.suites import find_suite
    from saccade_lab.sim import graphics

    packages.require()
    graphics.check()
    location = locate(args.checkpoint)
    checkpoint = location.path
    options = arguments.policy_options(args)
    options["num_threads"] = args.num_threads if workers.alone else workers.num_threads
    given = {name: Path(options[name]) for name in OPTION_FILES if options[name] is not None}
    found = {name: path for name, path in given.items() if path.exists()}
    options |= {name: str(path) for name, path in given.items()}
    options |= {name: path_text(path) for name, path in found.items()}  # other machines have it elsewhere
    noise = Noise(args.seed, args.same_noise)
    episodes = Episodes(path_text(checkpoint), args.protocol, options, noise, args.video)
    with output.progress_bar("loading", transient=True):
        policy = episodes.policy
        sha256 = weights_hash(checkpoint)
    settings = {
        "protocol": policy.record(list(args.suite)),
        "checkpoint": {
            "name": location.id or checkpoint.resolve().name,
            "commit": location.commit,
            "sha256": sha256,
        },
        "options": {name: value for name, value in options.items() if name not in ("num_threads", *found)},
        "option_files": option_files(checkpoint, options["tokenizer"], found),
        "noise": vars(noise),
        **software(options["precision"]),
    }
    results = Results.begin(args.out, settings)
    items = [
        (suite.name, task, trial)
        for suite in map(find_suite, args.suite)
        for task in lab_flags.indices("--tasks", args.tasks, suite.num_tasks)
        for trial in range(args.trials)
    ]
    tasks = tasks_of(policy, {(suite, task) for suite, task, _ in (*results.episodes, *items)})
    check_trials(policy, tasks, args.trials)
    about = {
        "tasks": tasks,
        "engine": {"num_threads": policy.whole.head.num_threads, "library": library()},
        "processes": {"backend": workers.backend, "jobs": workers.jobs},
    }
    if not args.json:
        announce(settings["protocol"])
    return Session(episodes, items, results, workers, args.out, about)


def option_files(
    checkpoint: Path, tokenizer: str | None, given: Mapping[str, Path]
) -> dict[str, dict[str, str]]:
    """Name and hash of the files that are read besides the checkpoint, by the option that names them.

    Args:
        checkpoint: Directory of the checkpoint.
        tokenizer: The option ``tokenizer``: a path, an id, or None for that of the checkpoint, or a published
            one for a checkpoint without one.
        given: The options that are paths.
    """
    from saccade._internal.hub_files import POLICY, TOKENIZER
    from saccade._internal.tokenizers import tokenizer_path
    from saccade.evaluation.source import contents_hash

    files = {name: (path, POLICY) for name, path in given.items()}
    published = None if "tokenizer" in given else tokenizer_path(checkpoint, tokenizer)
    if published is not None:
        files["tokenizer"] = (published, TOKENIZER)
    return {
        name: {"name": path.resolve().name, "sha256": contents_hash(path, patterns)}
        for name, (path, patterns) in files.items()
    }


def tasks_of(policy: LiberoPolicy, ran: Iterable[tuple[str, int]]) -> list[dict[str, Any]]:
    """Tasks for the results: instruction, and number of official states if episodes begin in these."""
    from saccade_lab.libero.suites import find_task, initial_states

    found = []
    for suite, number in sorted(ran):
        task = find_task(suite, number)
        states = len(initial_states(task)) if policy.protocol.official_states else None
        found.append(
            {"suite": suite, "task": number, "instruction": task.instruction, "official_states": states}
        )
    return found


def check_trials(policy: LiberoPolicy, tasks: Iterable[Mapping[str, Any]], trials: int) -> None:
    """Refuses trials that the protocol's program does not have."""
    name = policy.protocol.name
    for task in tasks if name in END_WITH_STATES else ():
        if trials > task["official_states"]:
            raise InputError(
                f"--trials: given {trials}, expected at most {task['official_states']}: the program of "
                f"{name} ends with the last official state of {task['suite']} {task['task']}"
            )


def announce(protocol: Mapping[str, Any]) -> None:
    """Prints the protocol."""
    from saccade_lab.libero.protocols import described

    for name, text in described(protocol).items():
        print(f"{name:<16}{text}")
    print(flush=True)


def show(session: Session, record: Mapping[str, Any]) -> None:
    """Prints the rates, the time by part, and where the files are."""
    if not session.results.episodes:
        print("no episode was completed")
        return
    told = {(task["suite"], task["task"]): task["instruction"] for task in record["tasks"]}
    rows = []
    for rate in session.results.rates():
        low, high = rate.interval
        name = rate.suite or "all suites"
        rows.append(
            [
                f"{name} {rate.task}" if rate.task is not None else f"{name}, all",
                told.get((rate.suite, rate.task), ""),
                f"{rate.successes}/{rate.episodes}",
                f"{100 * rate.successes / rate.episodes:.1f}",
                f"{100 * low:.1f} to {100 * high:.1f}",
                "" if rate.median_steps is None else f"{rate.median_steps:g}",
            ]
        )
    spent = ", ".join(f"{part} {seconds:.1f}" for part, seconds in record["seconds"].items())
    output.show(
        [
            output.Section(
                f"Success by the protocol {record['protocol']['name']}, with Wilson's intervals"
                + (", all episodes with the same noise" if record["noise"]["is_common"] else ""),
                ["", "instruction", ">success", ">%", ">95 %", ">steps"],
                rows,
            )
        ]
    )
    for remark in record["remarks"]:
        print(remark)
    print(f"seconds in an episode: {spent}")
    print(f"results  {session.out / 'results.json'}")
    print(f"page     {session.out / 'index.html'}")
    if session.episodes.video:
        print(f"videos   {session.out / 'videos'}{session.without_video()}")
