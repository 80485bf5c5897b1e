"""The flags that commands of the lab and studies share, besides those of saccade."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from saccade._internal.arrays import PRECISIONS
from saccade._internal.flags import (
    Arguments,
    add_checkpoint,
    add_config,
    add_features,
    add_integer,
    add_list,
    add_pictures,
    add_preprocessing,
    add_seed,
    check_known,
)
from saccade_lab.sim.tasks import TASKS


def add_tasks(parser: Arguments, help: str = "tasks to run (default: all that the policy knows)") -> None:
    """Declares the names of tasks; see `check_tasks`."""
    add_list(parser, "--tasks", help=help)


def add_episodes(parser: Arguments, default: int | None, help: str = "episodes per task") -> None:
    """Declares the number of episodes of each task."""
    add_integer(parser, "--episodes", default=default, help=help)


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Declares pictures and words for a whole checkpoint; see `check_frames`."""
    seen = parser.add_argument_group("pictures and words for a whole checkpoint")
    add_pictures(seen, "--frames")
    seen.add_argument(
        "--precision", choices=PRECISIONS, help="of the backbone (default: float32, as the head always)"
    )
    add_preprocessing(seen)


def add_rollout_arguments(parser: Arguments, episodes: int) -> None:
    """Declares which episodes of which policy a study runs, or which recorded observations it reads.

    Args:
        parser: parser of the study.
        episodes: default number per task. It is kept as `args.default_episodes`, and `args.episodes` is None
            where the flag is absent, because with `--features` the flag may not be given.
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
        InputError: one is unknown; lists those that are known.
    """
    check_known("--tasks", names, known_tasks())


def known_tasks() -> tuple[str, ...]:
    """The names of all tasks; needs no simulator."""
    return tuple(TASKS)
