"""`saccade convert`: writes a checkpoint with other embodiments, dtype or shards, or a merged adapter."""

from __future__ import annotations

import argparse
import re

from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError
from saccade.cli.copying import add_copy_arguments, copy, print_report

HELP = "write a checkpoint with other robots, dtype or files"

EPILOG = """\
Everything else is copied bit for bit: tensors, config.json, and other files of the checkpoint such as
statistics, processors and tokenizers. The copy appears under its name once it is complete.

The weights of embodiments that are left out become zero and stay in place: ids keep their numbers, and every
program that reads CHECKPOINT reads the copy. On file systems with sparse files the zeros take no space (see
du). A narrower dtype rounds; the report says by how much.

--adapter merges a LoRA adapter that PEFT saved into CHECKPOINT, its base: W + scaling * B A, and the modules
that were trained whole. The adapter's own statistics, processors and (lerobot's) config.json take the place
of the base's. With --dtype the base is converted first, as if PEFT merged into a model of that dtype. What is
not plain addition (DoRA, biases) is refused.

examples:
  saccade convert GR00T-N1.5-3B/ --adapter my-lora/ --out merged
  saccade convert GR00T-N1.5-3B/ --out GR00T-N1.5-3B-bf16 --dtype bfloat16
  saccade convert GR00T-N1.5-3B/ --out two-robots --embodiment-ids 24,31 --head-only
  saccade convert my-finetune/ --out my-finetune-shards --max-shard-size 2GB --json
"""

UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    parser.add_argument(
        "--adapter", metavar="DIR", help="LoRA adapter to merge: a directory or a published id"
    )
    arguments.add_list(
        parser, "--embodiment-ids", item=int, metavar="ID", help="embodiments to keep (default: all)"
    )
    parser.add_argument(
        "--dtype",
        choices=("float32", "bfloat16", "float16"),
        help="dtype of all floating point tensors (default: unchanged)",
    )
    parser.add_argument(
        "--max-shard-size",
        metavar="SIZE",
        help="largest file, such as 5GB (default: one file if the source is one file, else 5GB)",
    )
    parser.add_argument("--head-only", action="store_true", help="leave out the tensors outside the head")


def run(args: argparse.Namespace) -> int:
    """Writes the copy and reports what it contains."""
    from saccade.checkpoints import convert

    report = copy(
        convert,
        "converting",
        args,
        adapter=args.adapter,
        embodiment_ids=None if args.embodiment_ids is None else list(args.embodiment_ids),
        dtype=args.dtype,
        max_shard_bytes=None if args.max_shard_size is None else size(args.max_shard_size),
        head_only=args.head_only,
    )
    files = f"{len(report.files)} file{'s' if len(report.files) > 1 else ''}"
    others = f"{len(report.carried)} other file{'' if len(report.carried) == 1 else 's'}"
    lines = [
        f"{args.out}: {files}, {report.bytes_after / 1e6:.1f} MB (was {report.bytes_before / 1e6:.1f} MB); "
        f"{report.num_converted} tensors converted, {report.num_dropped} left out; {others} copied"
    ]
    if args.adapter is not None:
        lines.append(
            f"merged {args.adapter}: added to {report.num_merged} weights, "
            f"replaced {report.num_replaced} tensors"
        )
    if report.embodiment_ids is not None:
        kept = ", ".join(map(str, report.embodiment_ids))
        lines.append(f"kept embodiments {kept}; {report.zeroed_bytes / 1e6:.1f} MB of the others are zero")
    if report.num_rounded:
        lines.append(
            f"rounded {report.num_rounded} numbers: largest error {report.largest_error:.3g} (in "
            f"{report.largest_error_in}), largest relative error {report.largest_relative_error:.3g}"
        )
    elif args.dtype is not None:
        lines.append("nothing was rounded: every number kept its value")
    return print_report(args, report, lines)


def size(text: str) -> int:
    """The bytes of a size such as `5GB` or `500 MiB`.

    Raises:
        UsageError: `text` is not a size.

    Example:
        >>> size("1.5GB")
        1500000000
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) *([a-z]*)", text.strip(), re.IGNORECASE)
    if found is None or found[2].upper() not in UNITS or float(found[1]) <= 0:
        raise UsageError(f"--max-shard-size: expected a size such as 5GB or 500MiB, got {text}")
    return max(1, round(float(found[1]) * UNITS[found[2].upper()]))
