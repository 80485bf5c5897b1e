"""The `saccade` command: one file a command, imported only when that command is chosen."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import NoReturn, Protocol, cast

# A command is the module of its name in this package. Its one line of help stands here as well, so that
# `saccade --help` imports none of them; a test keeps the two equal.
COMMANDS: dict[str, str] = {
    "rollout": "drive the simulated robot with a policy and report how often it succeeds",
    "demos": "record demonstrations of the tasks with scripted experts",
    "train": "train the policy on recorded demonstrations",
    "attention": "show what the rows of the action head look at",
    "study": "measure what the future tokens do, in closed loop and inside the head",
    "bench": "time the action head beside what this machine allows",
    "parity": "compare the Rust head with the reference in torch",
    "inspect": "show what is in a checkpoint",
    "resize": "change the number of future tokens of a checkpoint",
    "convert": "write a checkpoint with other embodiments, dtype or shards",
    "quantize": "write a copy of a checkpoint with int8 weights",
}

# Which extra brings a module that a command may find missing.
EXTRAS: dict[str, str] = {
    "rich": "cli",
    "torch": "torch",
    "safetensors": "torch",
    "gymnasium": "sim",
    "imageio": "sim",
    "imageio_ffmpeg": "sim",
    "jinja2": "study",
    "joblib": "study",
    "matplotlib": "sim",
    "metaworld": "sim",
    "mujoco": "sim",
    "packaging": "sim",
    "pandas": "study",
    "PIL": "sim",
    "ray": "ray",
    "scipy": "study",
    "sklearn": "study",
    "threadpoolctl": "sim",
}

# A path that the user named and that cannot be used. Other `OSError`s are not the user's doing.
PATH_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)

EXIT_OK = 0
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as a shell reports it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE


class UsageError(Exception):
    """Arguments of a command that cannot be followed; shown as one line, without a traceback."""


class Command(Protocol):
    """What a module in this package offers."""

    HELP: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declares the command's arguments and sets `parser.epilog` to examples."""

    def run(self, args: argparse.Namespace) -> int:
        """Does the work; returns the exit status."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and whose epilog keeps its line breaks."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        """Prints one line to standard error and exits with status 2."""
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: {message} (see {self.prog} --help)\n")


def load_command(name: str) -> Command:
    """The module of a command.

    Args:
        name: a key of `COMMANDS`.

    Raises:
        KeyError: there is no such command.
    """
    if name not in COMMANDS:
        raise KeyError(name)
    module: ModuleType = importlib.import_module(f"saccade.cli.{name}")
    return cast(Command, module)


def build_parser(chosen: str | None = None) -> argparse.ArgumentParser:
    """The parser of the command line; only the chosen command's arguments are declared.

    Args:
        chosen: the command whose module is imported; `None` (or an unknown name) imports none.
    """
    from saccade import __version__

    parser = Parser(
        prog="saccade",
        description="GR00T-style action heads on CPUs: run a policy closed-loop, train one, check it.",
        epilog="examples:\n"
        "  saccade rollout --help\n"
        "  saccade rollout --tasks reach --episodes 2 --out out/rollout",
    )
    parser.add_argument("--version", action="version", version=f"saccade {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command", title="commands", parser_class=Parser)
    for name, help_line in COMMANDS.items():
        sub = commands.add_parser(
            name, help=help_line, description=help_line[0].upper() + help_line[1:] + "."
        )
        if name == chosen:
            load_command(name).add_arguments(sub)
    return parser


def describe(error: BaseException) -> str:
    """What went wrong, on one line.

    Example:
        >>> describe(FileNotFoundError(2, "No such file or directory", "policy.safetensors"))
        'policy.safetensors: No such file or directory'
        >>> describe(ValueError("first\\n  second"))
        'first; second'
    """
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    lines = [line.strip() for line in str(error).splitlines()]
    return "; ".join(line for line in lines if line) or type(error).__name__


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """How to install the module that was not found, or `None` if no extra of saccade brings it.

    Example:
        >>> missing_extra(ModuleNotFoundError("No module named 'mujoco'", name="mujoco"))
        "mujoco is not installed: pip install 'saccade[sim]'"
    """
    module = (error.name or "").partition(".")[0]
    extra = EXTRAS.get(module)
    return None if extra is None else f"{module} is not installed: pip install 'saccade[{extra}]'"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: the arguments after the program's name; `None` takes those of the process.

    Returns:
        The exit status: 0, or what the command returned; 2 for bad input, with one line on standard error;
        130 after Ctrl-C.

    Raises:
        SystemExit: from `--help`, `--version` and arguments that do not parse (status 2).
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        try:
            return dispatch(argv)
        finally:
            sys.stdout.flush()  # a closed pipe is found here, not while the interpreter shuts down
    except KeyboardInterrupt:
        print("saccade: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output is gone (`| head`): no message, and nothing more to flush at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE


def dispatch(argv: list[str]) -> int:
    """Parses `argv`, runs the chosen command and turns bad input into one line and status 2."""
    from saccade import SaccadeError

    # The program's own options take no value, so the first word that is no option is the command.
    chosen = next((word for word in argv if not word.startswith("-")), None)
    try:
        parser = build_parser(chosen)
        args = parser.parse_args(argv)
        if args.command is None:
            parser.print_help()
            return EXIT_OK
        return load_command(args.command).run(args)
    except (UsageError, SaccadeError, *PATH_ERRORS) as error:
        return refuse(describe(error))
    except MemoryError as error:
        return refuse(f"too large for this machine's memory: {error}".removesuffix(": "))
    except ModuleNotFoundError as error:
        advice = missing_extra(error)
        if advice is None:
            raise
        return refuse(advice)


def refuse(message: str) -> int:
    """Prints one line to standard error; returns the status of bad input."""
    print(f"saccade: {message}", file=sys.stderr)
    return EXIT_BAD_INPUT
