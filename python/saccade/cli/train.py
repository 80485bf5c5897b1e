"""`saccade train`: trains the policy on recorded demonstrations."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, UsageError

if TYPE_CHECKING:
    from saccade.sim.train import TrainingSettings

HELP = "train the policy on recorded demonstrations"

EPILOG = """\
Writes config.json and model.safetensors (the policy, for `saccade rollout --checkpoint OUT`), loss.png,
history.json and training.pt about once a minute. Stopped at any time, the same command goes on where it was
and ends with the same weights as an uninterrupted run. The defaults are those of the shipped policy.

examples:
  saccade train --demos out/demos --out out/policy
  saccade train --demos out/demos --out out/n0 --num-future-tokens 0
  saccade train --demos out/demos --out out/quick --steps 2000 --threads 2
"""

# Option, the setting it sets, its smallest value, and what it is.
INTEGERS = (
    ("steps", 1, "optimiser steps"),
    ("batch_size", 1, "observations per step"),
    ("seed", 0, "of weights, order and noise"),
    ("num_future_tokens", 0, "learned query tokens N"),
    ("patch_size", 2, "pixels along each side of an image token's patch"),
    ("vl_num_layers", 0, "blocks of the head's VL self-attention"),
    ("width", 8, "of backbone and head"),
    ("num_layers", 1, "blocks of the head"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments; every setting left out keeps the shipped policy's value."""
    parser.epilog = EPILOG
    parser.add_argument("--demos", type=Path, required=True, help="directory written by `saccade demos`")
    parser.add_argument("--out", type=Path, required=True, help="directory of the run")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default: 1)")
    for name, _, what in INTEGERS:
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, help=what)
    parser.add_argument("--learning-rate", type=float, help="of AdamW after the warm-up")


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then trains."""
    import torch
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar

    from saccade.sim import train
    from saccade.sim.demos import recorded_tasks
    from saccade.sim.files import writable_directory

    settings = training_settings(args)
    recorded_tasks(args.demos)
    writable_directory(args.out)
    torch.set_num_threads(args.threads)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("reading", total=settings.steps)

        def on_step(now: train.Progress) -> None:
            held_out = "" if now.validation_loss is None else f", held out {now.validation_loss:.3f}"
            progress.update(bar, completed=now.step, description=f"loss {now.loss:.3f}{held_out}")

        try:
            train.train(args.demos, args.out, settings, on_step)
        except KeyboardInterrupt:
            progress.stop()
            print(f"stopped; the same command goes on from {args.out / train.STATE_FILE}")
            return EXIT_INTERRUPTED
    print(f"policy in {args.out}; try it: saccade rollout --checkpoint {args.out}")
    return EXIT_OK


def training_settings(args: argparse.Namespace) -> TrainingSettings:
    """The settings, checked."""
    from saccade.sim.train import TrainingSettings

    for name, smallest, _ in (*INTEGERS, ("threads", 1, "")):
        value = getattr(args, name)
        if value is not None and value < smallest:
            raise UsageError(f"--{name.replace('_', '-')}: given {value}, expected at least {smallest}")
    if args.learning_rate is not None and not 0 < args.learning_rate < 1:
        raise UsageError(f"--learning-rate: given {args.learning_rate}, expected above 0 and below 1")
    names = [name for name, _, _ in INTEGERS] + ["learning_rate"]
    chosen = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return dataclasses.replace(TrainingSettings(), **chosen)
