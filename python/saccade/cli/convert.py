"""`saccade convert`: a copy of a checkpoint with other embodiments, another type, or other files."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re

from saccade.cli import EXIT_OK, UsageError
from saccade.cli._copying import add_copy_arguments, copying, left_behind

HELP = "write a checkpoint with other embodiments, dtype or shards"

EPILOG = """\
What is not asked to change is copied bit for bit: tensors, config.json, and what lies beside the weights,
such as statistics, processors and tokenizers. The copy appears under its name when all of it is written.

Embodiments that are left out become zero and stay in place: ids keep their numbers, and every program that
read SOURCE reads the copy. On file systems with holes the zeros take no room (du says what is taken).
A narrower dtype rounds; by how much is reported.

examples:
  saccade convert GR00T-N1.5-3B/ --out GR00T-N1.5-3B-bf16 --dtype bfloat16
  saccade convert GR00T-N1.5-3B/ --out one-robot --embodiment-ids 31 --head-only
  saccade convert my-finetune/ --out my-finetune-shards --max-shard-size 2GB --json
"""

UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    parser.add_argument(
        "--embodiment-ids", type=int, nargs="+", metavar="ID", help="keep only these (default: all)"
    )
    parser.add_argument(
        "--dtype",
        choices=("float32", "bfloat16", "float16"),
        help="of all floating point tensors (default: what each is)",
    )
    parser.add_argument(
        "--max-shard-size",
        metavar="SIZE",
        help="close a file before it grows larger, such as 5GB (default: one file of one, 5GB of several)",
    )
    parser.add_argument("--head-only", action="store_true", help="leave out tensors outside the head")


def run(args: argparse.Namespace) -> int:
    """Writes the copy and reports what is in it."""
    from saccade.checkpoints import convert

    max_shard_bytes = None if args.max_shard_size is None else size(args.max_shard_size)
    with copying("converting") as progress:
        report = convert(
            args.source,
            args.out,
            config=args.config,
            embodiment_ids=args.embodiment_ids,
            dtype=args.dtype,
            max_shard_bytes=max_shard_bytes,
            head_only=args.head_only,
            force=args.force,
            progress=progress,
        )
    if args.json:
        print(json.dumps(dataclasses.asdict(report), default=str))
        return EXIT_OK
    files = f"{len(report.files)} file{'s' if len(report.files) > 1 else ''}"
    beside = f"{len(report.carried)} file{'' if len(report.carried) == 1 else 's'}"
    print(
        f"{args.out}: {files}, {report.bytes_before / 1e6:.1f} MB are {report.bytes_after / 1e6:.1f} MB; "
        f"{report.num_converted} tensors converted, {report.num_dropped} left out; "
        f"{beside} beside the weights carried over"
    )
    if report.embodiment_ids is not None:
        kept = ", ".join(map(str, report.embodiment_ids))
        print(f"embodiments {kept} kept; {report.zeroed_bytes / 1e6:.1f} MB of the others are zero")
    if report.num_rounded:
        print(
            f"rounded: {report.num_rounded} numbers, by at most {report.largest_error:.3g} (in "
            f"{report.largest_error_in}), {report.largest_relative_error:.3g} of a number's size"
        )
    elif args.dtype is not None:
        print("nothing was rounded: each number is what it was")
    left_behind(report)
    return EXIT_OK


def size(text: str) -> int:
    """Bytes of a size such as `5GB` or `500 MiB`.

    Raises:
        UsageError: it is none.

    Example:
        >>> size("1.5GB")
        1500000000
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) *([a-z]*)", text.strip(), re.IGNORECASE)
    if found is None or found[2].upper() not in UNITS or float(found[1]) <= 0:
        raise UsageError(f"--max-shard-size: expected a size such as 5GB or 500MiB, got {text}")
    return max(1, round(float(found[1]) * UNITS[found[2].upper()]))
