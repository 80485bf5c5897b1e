"""Writes a random whole checkpoint in NVIDIA's layout: backbone, head, statistics, tokenizer. NumPy only.

    python -m saccade_lab.random_checkpoint OUT                    N1.5 at its published size, 4.8 GB
    python -m saccade_lab.random_checkpoint OUT --small            a few MB
    python -m saccade_lab.random_checkpoint OUT --version n1.7
    python -m saccade_lab.random_checkpoint OUT --robot libero     for `saccade libero`

Everything that loads the published checkpoint loads this one, so installation, memory and speed can be tried
before it is downloaded. Its actions mean nothing. Weights are scaled so that activations stay of order one;
``--outliers`` plants channels as large as trained models have. A tensor is drawn and written in blocks, so
memory stays below 0.2 GB.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from saccade.errors import InputError
from saccade_lab.published import RELEASED
from saccade_lab.random_checkpoint.robots import ROBOTS
from saccade_lab.random_checkpoint.whole import small_backbone, small_head, write


def main(arguments: list[str] | None = None) -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m saccade_lab.random_checkpoint",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="where to write; must not exist or be empty")
    parser.add_argument("--version", choices=RELEASED, default="n1.5", help="default: n1.5")
    parser.add_argument("--small", action="store_true", help="a few MB instead of the published size")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything (default 0)")
    parser.add_argument("--head-dtype", choices=("BF16", "F32"), default="BF16", help="default: BF16")
    parser.add_argument("--robot", choices=ROBOTS, default="arm", help="default: arm")
    parser.add_argument("--outliers", action="store_true", help="plant outlier channels in the backbone")
    args = parser.parse_args(arguments)
    try:
        write(
            args.folder,
            args.version,
            backbone=small_backbone(args.version) if args.small else None,
            head=small_head(args.version) if args.small else None,
            seed=args.seed,
            head_dtype=args.head_dtype,
            outliers=args.outliers,
            robot=args.robot,
        )
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        return 1
    files = sorted(path for path in args.folder.rglob("*") if path.is_file())
    for path in files:
        print(f"{path.stat().st_size:>13,} {path.relative_to(args.folder)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
