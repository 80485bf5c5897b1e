"""What `saccade evaluate` and `diagnose` share: flags, and episodes in one process or in many."""

from __future__ import annotations

import argparse
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from saccade._internal import extras
from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError, add_policy_options, policy_options
from saccade.cli import LAB, output
from saccade.cli.output import Section, show

if TYPE_CHECKING:
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.source import Source

Record = TypeVar("Record")

#: Entry points of the lab: what it adds to these commands.
EXTENSIONS = "saccade.extensions"


def add_run(parser: argparse.ArgumentParser, episodes: str) -> None:
    """Declares checkpoint, recordings, episodes, processes and the directory of the results."""
    arguments.add_checkpoint_argument(parser)
    parser.add_argument(
        "recordings", metavar="DATASET", help="directory or published id of a LeRobotDataset (extra: data)"
    )
    arguments.add_list(parser, "--episodes", item=int, metavar="N", minimum=0, help=episodes)
    arguments.add_seed(parser, "seed of the noise")
    arguments.add_out(parser, None)
    arguments.add_json(parser, "print results.json instead of a table")
    add_policy_options(parser)
    arguments.add_num_threads(parser, "threads (default: the physical cores; with several processes 1)")
    arguments.add_processes(parser, "episodes", "several processes (need the lab)")


def source_of(args: argparse.Namespace) -> Source:
    """Checkpoint and recordings of the arguments."""
    from saccade.evaluation.source import Source

    options = policy_options(args)
    if is_spread(args) and options["num_threads"] is None:
        options["num_threads"] = 1
    return Source.of(args.checkpoint, args.recordings, options)


def is_spread(args: argparse.Namespace) -> bool:
    """Whether other processes compute."""
    return args.backend != "loky" or args.jobs not in (None, 1)


def extension(name: str) -> Callable[..., Any] | None:
    """What the lab adds to a command, by the name of its entry point; None if the lab is not installed."""
    try:
        found = importlib.metadata.distribution(LAB).entry_points.select(group=EXTENSIONS, name=name)
    except importlib.metadata.PackageNotFoundError:
        return None
    for entry in found:
        loaded: Callable[..., Any] = entry.load()
        return loaded
    return None


def check_processes(args: argparse.Namespace) -> None:
    """Checks the processes that are wanted, and that the lab is installed if they are others than this one.

    Raises:
        UsageError: A flag is out of range, or the lab is missing; the message says how to install it.
    """
    arguments.processes(args)
    if is_spread(args) and extension("spread") is None:
        raise UsageError(
            f"--jobs, --backend: need {LAB}, which is not installed. Install with: "
            f"{extras.install_lab('sim')}"
        )


def computed(
    work: Callable[[int], Record],
    episodes: Sequence[int],
    files: EpisodeFiles[Record],
    args: argparse.Namespace,
    source: Source,
    description: str,
) -> list[Record]:
    """The records of episodes: those of an earlier run, and the others computed, each written at once."""
    found = {episode: files.load(episode) for episode in episodes}
    todo = [episode for episode, record in found.items() if record is None]
    done = len(found) - len(todo)
    with output.progress_bar(description, len(episodes)) as update:
        update(done)
        for episode, record in _each(work, todo, args, source):
            files.save(episode, record)
            found[episode] = files.load(episode)  # what a later run reads
            done += 1
            update(done)
    return [record for record in found.values() if record is not None]


def _each(
    work: Callable[[int], Record], todo: Sequence[int], args: argparse.Namespace, source: Source
) -> Iterator[tuple[int, Record]]:
    if not is_spread(args):
        return ((episode, work(episode)) for episode in todo)
    spread = extension("spread")
    assert spread is not None
    paths = [Path(source.checkpoint), Path(source.recordings)]
    options = [source.options.get(name) for name in ("data_config", "tokenizer")]
    paths += [Path(option) for option in options if isinstance(option, str)]
    found: Iterator[tuple[int, Record]] = spread(
        work,
        todo,
        **arguments.processes(args),
        num_threads=args.num_threads,
        files=[path for path in paths if path.exists()],
    )
    return found


def write_page(name: str, folder: Path, *given: Any) -> bool:
    """Lets the lab draw the page in DIR; without it, says on standard error what to install.

    An earlier run's page is removed first: it may have other episodes, and shows older results.
    """
    for stale in (folder / "index.html", *(folder / "curves").glob("[0-9]*.png")):
        stale.unlink(missing_ok=True)
    draw = extension(name)
    if draw is None:
        output.note(
            "saccade", f"pictures and the page need {LAB}; install it with: {extras.install_lab('sim')}"
        )
        return False
    draw(*given, folder)
    return True


def print_results(
    args: argparse.Namespace, written: Mapping[str, Any], tables: Sequence[Section], drawn: bool
) -> None:
    """Prints results.json, or tables and where the files are."""
    if args.json:
        output.print_json(written, indent=2)
        return
    show(tables)
    print(f"results  {args.out / 'results.json'}")
    if drawn:
        print(f"page     {args.out / 'index.html'}")
