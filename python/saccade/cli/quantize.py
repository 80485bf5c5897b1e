"""`saccade quantize`: a copy of a checkpoint with int8 weights."""

from __future__ import annotations

import argparse
import dataclasses
import json

from saccade.cli import EXIT_OK
from saccade.cli._copying import add_copy_arguments, copying, left_behind

HELP = "write a copy of a checkpoint with int8 weights"

EPILOG = """\
The weights of the attention and feed-forward layers of all blocks become int8, X.weight, beside a float32
scale for each output, X.weight_scale. All other tensors are copied bit for bit, those outside the head too
unless --head-only, and so is what lies beside the weights, such as statistics and processors.
ActionHead.load(DIR, precision="int8") then gives the same bits as SOURCE at int8; other precisions load it
too, with the weights that the integers stand for. docs/precision.md says what int8 costs.

examples:
  saccade quantize GR00T-N1.5-3B/ --out GR00T-N1.5-3B-int8
  saccade quantize GR00T-N1.5-3B/ --out head-int8 --head-only --json
  saccade quantize policy.safetensors --config config.json --out policy-int8 --force
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    parser.add_argument("--head-only", action="store_true", help="leave out tensors outside the head")


def run(args: argparse.Namespace) -> int:
    """Writes the copy and reports what is in it."""
    from saccade.checkpoints import quantize

    with copying("quantizing") as progress:
        report = quantize(
            args.source,
            args.out,
            config=args.config,
            head_only=args.head_only,
            force=args.force,
            progress=progress,
        )
    if args.json:
        print(json.dumps(dataclasses.asdict(report), default=str))
        return EXIT_OK
    before, after = (size / 1e6 for size in (report.head_bytes_before, report.head_bytes_after))
    print(
        f"{args.out}: {report.num_quantized} weights in int8, {report.num_copied} tensors copied, "
        f"{report.num_dropped} left out; the head's {before:.1f} MB are {after:.1f} MB"
    )
    left_behind(report)
    return EXIT_OK
