"""`saccade train`: trains the policy on recorded demonstrations."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, UsageError

if TYPE_CHECKING:
    from saccade.sim.train import TrainingSettings

HELP = "train the policy on recorded demonstrations"

EPILOG = """\
Writes config.json and model.safetensors (the policy, for `saccade rollout --checkpoint OUT`), settings.json,
history.json, loss.png and training.pt about once a minute. Stopped at any time, the same command goes on
where it was and ends with the same weights as an uninterrupted run. The shipped policy was trained by the
first two examples, one after the other.

examples:
  saccade train --demos out/demos --out out/first
  saccade train --demos out/demos --start-from out/first --absent-share 0.1 --steps 1200 \\
    --learning-rate 3e-4 --ema-decay 0.99 --seed 1 --out out/policy
  saccade train --demos out/demos --out out/n0 --num-future-tokens 0
  saccade train --demos out/demos --out out/aligned --alignment-weight 0.2
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

# The same for numbers that are not whole, with what they must be below.
NUMBERS = (
    ("learning_rate", 1e-9, 1, "of AdamW after the warm-up"),
    ("ema_decay", 0.0, 1, "of the averaged weights, which are the ones that are kept"),
    (
        "absent_share",
        0.0,
        1,
        "share of frames told a task whose object is not there, and shown to stand still",
    ),
    (
        "alignment_weight",
        0.0,
        math.inf,
        "of the loss that pulls the future tokens' rows towards what is seen one horizon later (FLARE: 0.2)",
    ),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments; every setting left out keeps the shipped policy's value."""
    parser.epilog = EPILOG
    parser.add_argument("--demos", type=Path, required=True, help="directory written by `saccade demos`")
    parser.add_argument("--out", type=Path, required=True, help="directory of the run")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch (default: 1)")
    for name, _, what in INTEGERS:
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, help=what)
    for name, *_, what in NUMBERS:
        parser.add_argument(f"--{name.replace('_', '-')}", type=float, help=what)
    parser.add_argument(
        "--start-from", type=Path, metavar="DIR", help="policy to start from (default: random weights)"
    )


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

    from saccade._files import writable_directory
    from saccade.sim import train
    from saccade.sim.demos import recorded_tasks

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
            train.train(args.demos, args.out, settings, on_step, start=args.start_from)
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
    for name, lowest, limit, _ in NUMBERS:
        value = getattr(args, name)
        if value is not None and not lowest <= value < limit:
            expected = (
                f"{lowest:g} to below {limit:g}" if limit < math.inf else f"a number from {lowest:g} on"
            )
            raise UsageError(f"--{name.replace('_', '-')}: given {value}, expected {expected}")
    if args.start_from is not None and not (args.start_from / "model.safetensors").is_file():
        raise FileNotFoundError(f"{args.start_from}: no policy there")
    names = [name for name, *_ in (*INTEGERS, *NUMBERS)]
    chosen = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return dataclasses.replace(TrainingSettings(), **chosen)
