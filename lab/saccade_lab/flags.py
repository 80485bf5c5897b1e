"""The flags that commands of the lab and studies share, besides those of saccade."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from saccade._internal.arrays import PRECISIONS
from saccade._internal.extras import SACCADE
from saccade._internal.flags import (
    Arguments,
    UsageError,
    add_config,
    add_data_config,
    add_features,
    add_integer,
    add_list,
    add_overrides,
    add_pictures,
    add_preprocessing,
    add_seed,
)
from saccade.errors import InputError
from saccade_lab.sim.tasks import TASKS

#: The flags that ``add_frames`` declares besides ``--frames``.
WITH_FRAMES = (
    *("instruction", "state", "precision", "embodiment", "preprocessing", "tokenizer"),
    *("data_config", "action_horizon", "processor_options"),
    *("other_frames", "other_instruction"),  # of `saccade study patching`
)


def add_checkpoint(
    parser: Arguments,
    help: str = "directory of a policy (default: the bundled policy)",
) -> None:
    """Declares the checkpoint of a command that has a default for it."""
    parser.add_argument("--checkpoint", type=Path, metavar="PATH", help=help)


def add_num_vl_tokens(parser: Arguments, default: int | None, help: str) -> None:
    """Declares T_vl."""
    add_integer(parser, "--num-vl-tokens", default=default, help=help)


def add_tasks(parser: Arguments, help: str = "tasks to run (default: all that the policy knows)") -> None:
    """Declares the names of tasks; see ``check_tasks``."""
    add_list(parser, "--tasks", help=help)


def add_episodes(parser: Arguments, default: int | None, help: str = "episodes per task") -> None:
    """Declares the number of episodes of each task."""
    add_integer(parser, "--episodes", default=default, help=help)


def add_record(parser: Arguments) -> None:
    """Declares the folder of a data set; see ``check_record``."""
    parser.add_argument(
        "--record",
        type=Path,
        metavar="DIR",
        help="write a data set in lerobot's format to this new folder (extra data of saccade)",
    )


def check_record(path: Path | None) -> None:
    """Checks that a data set can be written to a folder.

    Raises:
        MissingExtraError: A package of saccade's extra ``data`` is not installed.
        InputError: There is something in the folder.
    """
    if path is None:
        return
    SACCADE.require("pyarrow", "av")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"--record: expected a new or empty folder, got {path}, where something is")


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Declares images and an instruction for a whole checkpoint; see ``check_frames``."""
    seen = parser.add_argument_group("images and an instruction for a whole checkpoint")
    add_pictures(seen, "--frames")
    seen.add_argument(
        "--precision", choices=PRECISIONS, help="of the backbone (default: float32, as the head always)"
    )
    add_preprocessing(seen)
    add_data_config(seen)
    add_overrides(seen)


def check_frames(args: argparse.Namespace, *refused: str) -> None:
    """Checks the flags of ``add_frames``.

    Args:
        args: Parsed arguments.
        refused: Names of arguments that cannot be combined with ``--frames``: they are None where not given.

    Raises:
        UsageError: One needs ``--frames``, or cannot be combined with it.
    """
    wrong, rule = (WITH_FRAMES, "only with") if args.frames is None else (refused, "not with")
    given = [name for name in wrong if getattr(args, name, None) is not None]
    if given:
        flags = ", ".join("--" + name.replace("_", "-") for name in given)
        raise UsageError(f"{flags}: {rule} --frames")


def add_rollout_arguments(parser: Arguments, episodes: int) -> None:
    """Declares which episodes of which policy a study runs, or which recorded observations it reads.

    Args:
        parser: Parser of the study.
        episodes: Default number per task. It is kept as ``args.default_episodes``, and ``args.episodes`` is
            None where the flag is absent, because with ``--features`` the flag may not be given.
    """
    add_checkpoint(
        parser, "policy to study (default: the bundled policy); with --features any checkpoint of a head"
    )
    add_tasks(parser)
    add_episodes(parser, None, f"episodes per task (default: {episodes})")
    parser.set_defaults(default_episodes=episodes)
    add_seed(parser, "seed of the first episode, the next ones count up; with --features: of random numbers")
    file = parser.add_argument_group("recorded observations instead of the simulator")
    add_features(file, ".npz or .safetensors as for `saccade attention`; an array `episode` groups its rows")
    add_config(file)


def check_tasks(names: Iterable[str]) -> None:
    """Checks the names of tasks; needs no simulator.

    Raises:
        InputError: One is unknown; lists those that are known.
    """
    check_known("--tasks", names, known_tasks())


def known_tasks() -> tuple[str, ...]:
    """The names of all tasks; needs no simulator."""
    return tuple(TASKS)


def indices(flag: str, given: Iterable[int] | None, count: int) -> tuple[int, ...]:
    """Distinct indices below ``count`` in increasing order; None gives all of them.

    Raises:
        InputError: One is out of range.

    Example:
        >>> indices("--blocks", (3, 0), 4), indices("--blocks", None, 4)
        ((0, 3), (0, 1, 2, 3))
    """
    if given is None:
        return tuple(range(count))
    found = tuple(sorted(set(given)))
    if found and (found[0] < 0 or found[-1] >= count):
        raise InputError(f"{flag}: given {', '.join(map(str, found))}, expected 0 to {count - 1}")
    return found


def check_known(flag: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Checks names.

    Raises:
        InputError: One is unknown; lists those that are known.
    """
    known = list(known)
    for name in given:
        if name not in known:
            raise InputError(f"{flag}: unknown name {name!r}, expected one of {', '.join(known)}")
