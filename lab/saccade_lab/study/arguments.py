"""Creates the source of a study from its arguments."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from typing import TYPE_CHECKING

from saccade._internal.hub import resolve
from saccade.errors import InputError
from saccade_lab.files import data_config_text, path_text
from saccade_lab.flags import check_frames, check_tasks
from saccade_lab.parallel.arguments import workers_of
from saccade_lab.study.pictures import PictureSource
from saccade_lab.study.recording import Recording
from saccade_lab.study.source import Source

if TYPE_CHECKING:
    from saccade_lab.study.simulator import Simulator


def source_of(args: argparse.Namespace, *refused: str) -> Source:
    """Creates the source from parsed arguments.

    Args:
        args: As ``saccade_lab.flags.add_rollout_arguments`` declares them, and for studies that take
            pictures ``add_frames``. ``on_observation`` is that of ``PictureSource``.
        refused: Options of the study that cannot be used with recorded observations.

    Raises:
        InputError: An argument is wrong, or cannot be combined with another one.
        FileNotFoundError, CheckpointError: There is no checkpoint, or it does not fit.
        GraphicsError: The simulator is needed and cannot draw here.
    """
    if "frames" in args:
        check_frames(args, "features", "config", "tasks", "episodes", *refused)
        if args.frames is not None:
            return pictures_of(args)
    if args.features is not None:
        return recording_of(args, *refused)
    if args.config is not None:
        raise InputError("--config: only with --features; a policy of the simulator has its own")
    return simulator_of(args)


def simulator_of(args: argparse.Namespace) -> Simulator:
    """Creates a simulator from parsed arguments, for studies that need one; raises as ``source_of``."""
    if args.features is not None:
        raise InputError(
            "--features: this study needs the simulator; only cuts, patching, gradients, n-runtime and fast "
            "take a file of features"
        )
    from saccade_lab.sim import graphics
    from saccade_lab.sim.tasks import check_evaluation_seeds

    episodes = args.default_episodes if args.episodes is None else args.episodes
    seeds = check_evaluation_seeds(args.seed, episodes)
    check_tasks(args.tasks or ())
    graphics.check()  # before MuJoCo is imported, which ends in a traceback without OpenGL
    from saccade_lab.study.simulator import simulator

    return simulator(args.checkpoint, args.tasks, seeds, getattr(args, "engine", None) or "rust")


def recording_of(args: argparse.Namespace, *refused: str) -> Recording:
    """Creates a recording from parsed arguments, and reads it; arguments and errors as ``source_of``."""
    given = [name for name in ("tasks", "episodes", *refused) if getattr(args, name) is not None]
    if given:
        flags = ", ".join("--" + name.replace("_", "-") for name in given)
        raise InputError(
            f"{flags}: not with --features, whose observations are measured as they are, without a simulator"
        )
    found = Recording(
        checkpoint=checkpoint_of(args),
        file=path_text(args.features),
        config_file=None if args.config is None else path_text(args.config),
        seed=args.seed,
        # The bits do not depend on it. One process may use all cores; several share them.
        num_threads=None if workers_of(args).alone else 1,
    )
    found.head()
    _ = found.all
    return found


def pictures_of(args: argparse.Namespace) -> PictureSource:
    """Creates a source of pictures from parsed arguments, and looks at them; errors as ``source_of``."""
    found = PictureSource(
        checkpoint=str(resolve(checkpoint_of(args))),
        frames=path_text(args.frames),
        instruction=args.instruction,
        state=None if args.state is None else path_text(args.state),
        other_frames=None if getattr(args, "other_frames", None) is None else path_text(args.other_frames),
        other_instruction=getattr(args, "other_instruction", None),
        embodiment=args.embodiment,
        precision=args.precision or "float32",
        preprocessing=args.preprocessing,
        tokenizer=None if args.tokenizer is None else path_text(args.tokenizer),
        data_config=data_config_text(args.data_config),
        action_horizon=args.action_horizon,
        processor_options=None if args.processor_options is None else json.dumps(args.processor_options),
        seed=args.seed,
        num_threads=None if workers_of(args).alone else 1,
    )
    # The backbone takes seconds for an observation. Equal sources share what it found; a function stays here.
    _ = replace(found, on_observation=getattr(args, "on_observation", None)).all
    return found


def checkpoint_of(args: argparse.Namespace) -> str:
    """The checkpoint that was given, or the bundled one."""
    if args.checkpoint is None:
        from saccade_lab.sim.policy import DEMO_CHECKPOINT

        return str(DEMO_CHECKPOINT)
    return path_text(args.checkpoint)
