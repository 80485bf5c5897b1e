"""The flags that commands and studies share: each has one name, one meaning and one way to be read.

A command that needs a checkpoint takes it as its first argument, one that has a default takes
``--checkpoint``. A list takes commas, spaces or both. A number outside its range is refused while the
arguments are parsed, before anything is imported, loaded or written.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from saccade._internal.arrays import LOADING_OPTIONS, PRECISIONS
from saccade._internal.small_files import read_json

#: A parser, or a group of its arguments.
Arguments: TypeAlias = argparse._ActionsContainer


class UsageError(Exception):
    """Arguments that a command cannot follow; printed as one line, without a traceback."""


def number_in(
    flag: str, kind: type[int] | type[float], minimum: float, below: float = math.inf
) -> Callable[[str], float]:
    """A reader of numbers for argparse that refuses those outside ``minimum <= number < below``.

    It raises :class:`UsageError` when the argument is parsed, with the flag, the number and the range.
    """

    def read(word: str) -> float:
        number = kind(word)
        if minimum <= number < below:  # never if it is NaN
            return number
        if below < math.inf:
            expected = f"{minimum:g} to below {below:g}"
        else:
            expected = "a finite number" if number == math.inf else f"at least {minimum:g}"
        raise UsageError(f"{flag}: given {number}, expected {expected}")

    read.__name__ = kind.__name__  # for argparse's own message on a word that is no number
    return read


class StoreList(argparse.Action):
    """Stores the items of a list as a tuple, in the order given, each once.

    `item` converts a word and raises `ValueError` if it is no number; `minimum` is the smallest number. A
    list that is empty or has other items is a :class:`UsageError` when the argument is parsed.
    """

    def __init__(
        self, *args: Any, item: Callable[[str], Any] = str, minimum: float | None = None, **kwargs: Any
    ) -> None:
        super().__init__(*args, **kwargs)
        self.item, self.minimum = item, minimum

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """See argparse."""
        items = []
        for word in split_list(values):
            try:
                items.append(self.item(word))
            except ValueError:
                raise UsageError(f"{option_string}: given {word!r}, expected numbers") from None
        if not items:
            kind = "name" if self.item is str else "number"
            raise UsageError(f"{option_string}: expected at least one {kind}")
        if self.minimum is not None and not all(number >= self.minimum for number in items):
            given = ", ".join(map(str, items))
            raise UsageError(f"{option_string}: given {given}, expected numbers from {self.minimum:g} on")
        setattr(namespace, self.dest, tuple(dict.fromkeys(items)))


def split_list(words: Iterable[str]) -> list[str]:
    """The items of a list that is separated by commas, spaces or both.

    Example:
        >>> split_list(["reach,push", "fork"]), split_list(["reach, push"])
        (['reach', 'push', 'fork'], ['reach', 'push'])
    """
    return [item for word in words for item in re.split(r"[,\s]+", word) if item]


def add_integer(
    parser: Arguments,
    flag: str,
    *,
    minimum: int = 1,
    default: int | None = None,
    required: bool = False,
    help: str,
) -> None:
    """Declares a whole number of at least `minimum`; the help text ends with the default, if there is one."""
    parser.add_argument(
        flag,
        type=number_in(flag, int, minimum),
        default=default,
        required=required,
        metavar="N",
        help=help if default is None else f"{help} (default: {default})",
    )


def add_number(
    parser: Arguments,
    flag: str,
    *,
    minimum: float = -math.inf,
    below: float = math.inf,
    default: float | None = None,
    help: str,
) -> None:
    """Declares a number with `minimum <= number < below`; the help text ends with the default, if any."""
    parser.add_argument(
        flag,
        type=number_in(flag, float, minimum, below),
        default=default,
        metavar="X",
        help=help if default is None else f"{help} (default: {default:g})",
    )


def add_list(
    parser: Arguments,
    flag: str,
    *,
    item: Callable[[str], Any] = str,
    metavar: str = "NAME",
    minimum: float | None = None,
    default: Sequence[Any] | None = None,
    help: str,
) -> None:
    """Declares a list, see `StoreList`; `args` holds a tuple, or `default`, which `help` must state."""
    parser.add_argument(
        flag,
        action=StoreList,
        nargs="+",
        item=item,
        minimum=minimum,
        metavar=metavar,
        default=default,
        help=help,
    )


def add_checkpoint_argument(parser: Arguments) -> None:
    """Declares the checkpoint of a command that needs one."""
    parser.add_argument(
        "checkpoint",
        type=Path,
        metavar="CHECKPOINT",
        help="directory, .safetensors file or published id (downloaded with the extra hub)",
    )


def add_config(parser: Arguments) -> None:
    """Declares the head's config."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="config of the head (default: config.json in the checkpoint's directory)",
    )


def add_features(parser: Arguments, help: str) -> None:
    """Declares a file of recorded observations."""
    parser.add_argument("--features", type=Path, metavar="FILE", help=help)


def add_seed(parser: Arguments, help: str) -> None:
    """Declares the seed."""
    add_integer(parser, "--seed", minimum=0, default=0, help=help)


def add_preprocessing(parser: Arguments) -> None:
    """Declares what a whole checkpoint may not say: the robot, preprocessing and tokenizer."""
    parser.add_argument(
        "--embodiment",
        type=lambda word: int(word) if word.isdecimal() else word,
        metavar="TAG",
        help="tag or id of the robot, if there are several",
    )
    parser.add_argument(
        "--preprocessing",
        choices=("lerobot", "isaac"),
        help="how images and instruction are prepared (default: by version and layout)",
    )
    parser.add_argument(
        "--tokenizer", type=Path, metavar="PATH", help="tokenizer.json, or a directory with the tokenizer"
    )


#: What a directory of images is.
PICTURES = "an image of each camera, named after it (front.png), or folders of them, one per observation"


def add_pictures(parser: Arguments, flag: str) -> None:
    """Declares a directory of images with the given flag, an instruction and a state."""
    parser.add_argument(
        flag,
        type=Path,
        metavar="DIR",
        help=PICTURES,
    )
    add_words_and_state(parser)


def add_words_and_state(
    parser: Arguments,
    instruction: str = "instruction to the robot",
    state: str = "JSON: the robot's state in its own units, for observations without a state.json (default: "
    "the middle of its range)",
) -> None:
    """Declares the instruction and the state of observations that are images, with these help texts."""
    parser.add_argument("--instruction", metavar="TEXT", help=instruction)
    parser.add_argument("--state", type=Path, metavar="FILE", help=state)


def add_num_threads(
    parser: Arguments,
    help: str = "threads of the action head (default: the physical cores)",
    default: int | None = None,
) -> None:
    """Declares the number of threads."""
    add_integer(parser, "--num-threads", default=default, help=help)


def add_processes(parser: argparse.ArgumentParser, items: str, heading: str = "several processes") -> None:
    """Declares where a command runs; see `processes`.

    Args:
        parser: Parser of the command.
        items: What is computed at the same time, in the plural.
        heading: Title of the group of flags.
    """
    group = parser.add_argument_group(heading)
    group.add_argument(
        "--jobs",
        type=_number_of_jobs,
        metavar="N",
        help=f"{items} computed at the same time, in processes of their own; -1 for one per core; with 1 "
        "the command itself computes (default: 1; with ray -1)",
    )
    group.add_argument(
        "--backend",
        choices=("loky", "ray"),
        default="loky",
        help="processes on this machine, or on a Ray cluster (default: loky)",
    )
    group.add_argument(
        "--address",
        metavar="ADDRESS",
        help="address of the Ray cluster (default: RAY_ADDRESS, or the one that runs on this machine)",
    )


def _number_of_jobs(word: str) -> int:
    number = int(word)
    if number < 1 and number != -1:
        raise UsageError(f"--jobs: given {number}, expected at least 1, or -1 for one per core")
    return number


_number_of_jobs.__name__ = "int"  # for argparse's own message on a word that is no number


def processes(args: argparse.Namespace) -> dict[str, Any]:
    """Backend, number of jobs and address, from the flags of `add_processes`.

    Raises:
        UsageError: An address is given without Ray.
    """
    jobs = args.jobs
    if jobs is None:
        jobs = -1 if args.backend == "ray" else 1
    if args.address is not None and args.backend != "ray":
        raise UsageError(f"--address: only with --backend ray, given {args.backend}")
    return {"backend": args.backend, "jobs": jobs, "address": args.address}


def add_num_steps(parser: Arguments, help: str = "Euler steps (default: those of the checkpoint)") -> None:
    """Declares the number of Euler steps."""
    add_integer(parser, "--num-steps", help=help)


def add_out(parser: Arguments, default: str | None, help: str = "directory of the results") -> None:
    """Declares the directory to write; without a default it must be given."""
    text = help if default is None else f"{help} (default: {default})"
    path = None if default is None else Path(default)
    parser.add_argument("--out", type=Path, metavar="DIR", default=path, required=default is None, help=text)


def add_json(parser: Arguments, help: str = "print JSON instead of text") -> None:
    """Declares whether JSON is printed."""
    parser.add_argument("--json", action="store_true", help=help)


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
    try:
        if not word.lstrip().startswith("{"):
            return read_json(Path(word))
        found: dict[str, Any] = json.loads(word)
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(
            f"--processor-options: given {word!r:.100}, expected a JSON object or a file with one ({error})"
        ) from None
    return found


#: The arguments that say how a policy is loaded, but for the precision.
LOADING = (*LOADING_OPTIONS, "num_threads")


def policy_options(args: argparse.Namespace) -> dict[str, Any]:
    """Keyword arguments of `saccade.Policy.from_pretrained`, from the flags declared above."""
    precision = {"backbone": args.precision, "head": args.head_precision or args.precision}
    return {"precision": precision, **loading_options(args)}


def loading_options(args: argparse.Namespace) -> dict[str, Any]:
    """Those of `policy_options` that do not depend on the precision."""
    return {name: getattr(args, name) for name in LOADING}


def flags_given(args: argparse.Namespace, names: Iterable[str]) -> str:
    """The flags of those arguments that are given, for messages; empty if none is.

    Example:
        >>> args = argparse.Namespace(seed=0, num_threads=2, state=None)
        >>> flags_given(args, ["num_threads", "seed", "state"])
        '--num-threads, --seed'
    """
    return ", ".join("--" + name.replace("_", "-") for name in names if getattr(args, name) is not None)
