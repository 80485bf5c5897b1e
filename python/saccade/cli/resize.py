"""`saccade resize`: a copy of a checkpoint with another number of future tokens."""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

from saccade.cli import EXIT_OK
from saccade.cli._copying import add_copy_arguments, copying, left_behind

if TYPE_CHECKING:
    from saccade.checkpoints import ActionChanges, ResizeReport

HELP = "change the number of future tokens of a checkpoint"

EPILOG = """\
Going up, tokens are copied; saccade's own key in config.json takes ln of the number of copies off their
keys' logits, so that in saccade actions stay what they were but for rounding. Other programs do not know that
key: to them the copies weigh more, and the report says how far their actions move. Going down, tokens that
are alike are merged. Everything else is copied bit for bit. docs/resize.md says what is exact and what is
not.

examples:
  saccade resize GR00T-N1.5-3B/ --num-future-tokens 64 --out GR00T-N1.5-3B-64
  saccade resize my-finetune/ --num-future-tokens 64 --perturbation 0.1 --seed 1 --out start-of-training
  saccade resize my-finetune/ --num-future-tokens 8 --features looks.npz --out my-finetune-8 --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    parser.add_argument(
        "--num-future-tokens", type=int, required=True, metavar="M", help="how many the copy is to have"
    )
    parser.add_argument(
        "--perturbation",
        type=float,
        default=0.0,
        metavar="X",
        help="add noise to the copies, of X times the tokens' root mean square, so that training can tell "
        "them apart (default: 0)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="of that noise and of random observations (default: 0)"
    )
    parser.add_argument(
        "--features",
        type=Path,
        metavar="FILE",
        help="observations to compare actions on, .npz or .safetensors as for saccade attention (default: "
        "random ones)",
    )


def run(args: argparse.Namespace) -> int:
    """Writes the copy, and reports what is in it and how far actions move."""
    from saccade.checkpoints import action_changes, resize

    with copying("resizing") as progress:
        report = resize(
            args.source,
            args.out,
            num_future_tokens=args.num_future_tokens,
            perturbation=args.perturbation,
            seed=args.seed,
            config=args.config,
            force=args.force,
            progress=progress,
        )
    changes = action_changes(
        args.source, args.out, config=args.config, features=args.features, seed=args.seed
    )
    if args.json:
        both = {**dataclasses.asdict(report), "actions": dataclasses.asdict(changes)}
        print(json.dumps(both, default=str))
        return EXIT_OK
    describe(args, report, changes)
    left_behind(report)
    return EXIT_OK


def describe(args: argparse.Namespace, report: ResizeReport, changes: ActionChanges) -> None:
    """Prints what was written, and how far actions move."""
    merged = sum(len(group) > 1 for group in report.sources)
    copied = max(0, report.num_after - report.num_before)
    print(
        f"{args.out}: {report.num_before} future tokens are {report.num_after}: {copied} copies added, "
        f"{merged} merged of several"
    )
    if report.perturbation_rms:
        print(f"noise of root mean square {report.perturbation_rms:.3g} was added to the copies")
    if report.is_widened:
        print("the tokens are float32 now: the type that they had cannot hold the new ones")
    observations = "random observations" if args.features is None else f"observations of {args.features}"
    print(
        f"on {changes.observations} {observations}, in float32, an action (root mean square "
        f"{changes.actions_rms:.3g}; another noise moves it by {changes.of_other_noise.mean:.3g}) moves by"
    )
    for where, change in (("saccade", changes.in_saccade), ("other programs", changes.in_other_programs)):
        print(f"  in {where:14}  {change.mean:.3g} in the mean, {change.largest:.3g} at most")
    if report.is_exact:
        print("in saccade that is rounding: the copies are together what the tokens were")
