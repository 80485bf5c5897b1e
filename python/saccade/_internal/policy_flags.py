"""The flags of commands that load a whole checkpoint, as arguments of `saccade.Policy.from_pretrained`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from saccade._internal.arrays import PRECISIONS
from saccade._internal.flags import Arguments, UsageError, add_integer, add_preprocessing


def add_policy_options(parser: Arguments) -> None:
    """Declares how a whole checkpoint is loaded, except the number of threads."""
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        default="float32",
        help="default: float32, which is exact",
    )
    parser.add_argument("--head-precision", choices=PRECISIONS, help="of the head (default: as --precision)")
    add_preprocessing(parser)
    add_data_config(parser)
    add_overrides(parser)


def add_data_config(parser: Arguments) -> None:
    """Declares the data config, which checkpoints of N1 and N1.5 do not contain."""
    parser.add_argument(
        "--data-config",
        metavar="NAME|FILE",
        help="data config with which N1 or N1.5 was trained: its released name, or a JSON file",
    )


def add_overrides(parser: Arguments) -> None:
    """Declares what a checkpoint may say otherwise than it was trained."""
    add_integer(
        parser,
        "--action-horizon",
        help="actions in a chunk, where the checkpoint's config says another number than was trained",
    )
    parser.add_argument(
        "--processor-options",
        type=json_object,
        metavar="JSON|FILE",
        help="""settings of the processor in place of the checkpoint's: '{"letter_box_transform": true}'""",
    )


def json_object(word: str) -> dict[str, Any]:
    """The JSON object in a word, or in the file of this name.

    Raises:
        UsageError: There is none.
    """
    found: Any = None
    try:
        found = json.loads(word if word.lstrip().startswith("{") else Path(word).read_text("utf-8"))
        problem = f"got a {type(found).__name__}"
    except (OSError, ValueError) as error:
        problem = str(error)
    if not isinstance(found, dict):
        raise UsageError(
            f"--processor-options: given {word!r:.100}, expected a JSON object or a file with one ({problem})"
        )
    return found


def policy_options(args: argparse.Namespace) -> dict[str, Any]:
    """Keyword arguments of `saccade.Policy.from_pretrained`, from the flags declared above."""
    names = ("embodiment", "preprocessing", "tokenizer", "data_config", "action_horizon", "processor_options")
    precision = {"backbone": args.precision, "head": args.head_precision or args.precision}
    return {"precision": precision, **{name: getattr(args, name) for name in (*names, "num_threads")}}
