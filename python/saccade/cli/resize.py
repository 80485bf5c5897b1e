"""`saccade resize`: writes a checkpoint with another number of future tokens."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from saccade._internal import flags as arguments
from saccade.cli.copying import add_copy_arguments, copy, print_report

if TYPE_CHECKING:
    from saccade.checkpoints import ResizeReport
    from saccade.checkpoints.comparison import ActionChanges

HELP = "write a checkpoint with another number of future tokens"

EPILOG = """\
To add tokens, tokens are copied. A key of saccade in config.json subtracts ln of the number of copies from
the logits of their keys, so that actions in saccade are unchanged except for rounding. Other programs ignore
that key and give the copies more weight; the report says how far their actions move. To remove tokens,
similar tokens are merged. Everything else is copied bit for bit. docs/checkpoint-tools.md
says what is exact and what is not.

examples:
  saccade resize GR00T-N1.5-3B/ --num-future-tokens 64 --out GR00T-N1.5-3B-64
  saccade resize my-finetune/ --num-future-tokens 64 --perturbation 0.1 --seed 1 --out start-of-training
  saccade resize my-finetune/ --num-future-tokens 8 --features observations.npz --out my-finetune-8 --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    arguments.add_integer(
        parser,
        "--num-future-tokens",
        minimum=0,
        required=True,
        help="number of future tokens of the new checkpoint",
    )
    arguments.add_number(
        parser,
        "--perturbation",
        minimum=0,
        default=0.0,
        help="add noise of X times the tokens' root mean square to the copies, so that training can "
        "distinguish them",
    )
    arguments.add_seed(parser, "seed of that noise and of random observations")
    arguments.add_features(
        parser,
        "observations to compare actions on, .npz or .safetensors as for `saccade attention` (default: "
        "random ones)",
    )


def run(args: argparse.Namespace) -> int:
    """Writes the copy and reports what it contains and how far actions move."""
    from saccade.checkpoints import describe, resize
    from saccade.checkpoints.comparison import action_changes
    from saccade.head.input_files import checked, read_arrays

    if args.features is not None:  # refused before anything is written
        features = Path(args.features)
        config = describe(args.checkpoint, args.config).config
        checked(read_arrays(features), config, str(features))
    sizes = {"num_future_tokens": args.num_future_tokens, "perturbation": args.perturbation}
    report = copy(resize, "resizing", args, seed=args.seed, **sizes)
    changes = action_changes(
        args.checkpoint, args.out, config=args.config, features=args.features, seed=args.seed
    )
    return print_report(args, report, described(args, report, changes), actions=asdict(changes))


def described(args: argparse.Namespace, report: ResizeReport, changes: ActionChanges) -> list[str]:
    """What was written, and how far actions move."""
    if report.num_after < report.num_before:
        merged = sum(len(group) > 1 for group in report.sources)
        how = f"{merged} of them merged from several"
    elif report.num_after > report.num_before:
        how = f"{report.num_after - report.num_before} of them copies"
    else:
        how = "unchanged"
    lines = [f"{args.out}: {report.num_after} future tokens (was {report.num_before}), {how}"]
    if report.perturbation_rms:
        lines.append(f"added noise with root mean square {report.perturbation_rms:.3g} to the copies")
    if report.is_widened:
        lines.append("the tokens are float32 now, because their dtype cannot represent the new values")
    observations = "random observations" if args.features is None else f"observations of {args.features}"
    lines.append(
        f"change of actions on {changes.observations} {observations}, in float32 (root mean square of "
        f"actions {changes.actions_rms:.3g}; mean change from other noise {changes.of_other_noise.mean:.3g}):"
    )
    for where, change in (("saccade", changes.in_saccade), ("other programs", changes.in_other_programs)):
        lines.append(f"  in {where:14}  mean {change.mean:.3g}, largest {change.largest:.3g}")
    if report.is_exact:
        lines.append("the difference in saccade is floating-point rounding")
    return lines
