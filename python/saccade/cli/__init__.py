"""The `saccade` command: one file per command, imported only when that command is chosen.

Exit status: 0, or what the command returned (`parity` returns 1 for a difference); 2 with one line on
standard error for bad input, missing packages, and paths or streams that cannot be used; 130 after Ctrl-C and
143 after SIGTERM, both of which also end the processes that a command started; 141 if the reader of standard
output went away, as a shell reports for a program that SIGPIPE ended.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import importlib.metadata
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from typing import NoReturn, Protocol, runtime_checkable

from saccade._internal import extras
from saccade._internal.flags import UsageError
from saccade._saccade import __version__
from saccade.cli import output
from saccade.errors import SaccadeError

# A command is the module of its name in this package. Its line of help is repeated here, so that
# `saccade --help` imports none of them; a test compares the two.
COMMANDS: dict[str, str] = {
    "demo": "run the bundled policy on recorded images: try this first",
    "info": "say what a bug report needs: version, CPU, packages",
    "act": "run a whole checkpoint on images and an instruction",
    "serve": "serve a whole checkpoint to robots over the network",
    "inspect": "show what a checkpoint contains",
    "verify": "check a checkpoint, run it, print a report to send",
    "evaluate": "compare a checkpoint's actions with recorded ones",
    "certify": "check here what `saccade evaluate --certify` recorded",
    "diagnose": "say which inputs a checkpoint uses",
    "convert": "write a checkpoint with other robots, dtype or files",
    "resize": "write a checkpoint with another number of future tokens",
    "quantize": "write a checkpoint with int8 or int4 weights",
}
# The commands of saccade-vla-lab, found by its entry points. They are listed here, so that the help and the
# message that says what to install need no other package.
LAB_COMMANDS: dict[str, str] = {
    "rollout": "run a policy on the simulated robot, count successes",
    "demos": "record demonstrations of the tasks with scripted experts",
    "train": "train a policy on recorded demonstrations",
    "attention": "show what the rows of the action head attend to",
    "study": "measure what the parts of an action head contribute",
    "parity": "compare the Rust head with the torch reference",
    "libero": "run a policy on LIBERO by a released protocol",
    "bench": "time the head beside the limits of this machine",
}
#: The headings of `saccade --help`, and the commands under each.
GROUPS: dict[str, tuple[str, ...]] = {
    "start": ("demo", "info"),
    "run": ("act", "serve"),
    "examine": ("inspect", "verify", "evaluate", "certify", "diagnose"),
    "rewrite": ("convert", "resize", "quantize"),
    "lab": tuple(LAB_COMMANDS),
}
#: The extra of the lab that a command needs; for the others `sim` is enough.
LAB_EXTRAS = {"train": "study", "study": "study", "parity": "study", "libero": "libero"}
LAB = "saccade-vla-lab"
ENTRY_POINTS = "saccade.commands"

# The optional packages that each command needs, checked once its arguments have been: a message then names
# all that are missing. Commands without an entry need NumPy only.
NEEDS: dict[str, tuple[str, ...]] = {
    "act --image": ("PIL",),
    "serve": ("zmq", "msgpack"),
    "evaluate": ("pyarrow", "av"),
    "certify": ("pyarrow", "av"),
    "diagnose": ("pyarrow", "av"),
    "inspect --precision-check": ("PIL",),
    "quantize --calibrate": ("PIL",),
}

# Failures of a path that the user named. Python raises these without an error number in places of our own.
PATH_ERRORS = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)
# Failures of a write, which do not know the file's name.
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)

EXIT_OK = 0
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as a shell reports it
EXIT_BROKEN_PIPE = 141  # 128 + SIGPIPE
EXIT_TERMINATED = 143  # 128 + SIGTERM


@runtime_checkable
class Command(Protocol):
    """The interface of a command's module.

    A command of another distribution also has `EXTRAS`, its table of optional packages
    (:class:`saccade._internal.extras.Extras`).
    """

    HELP: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declares the command's arguments and sets `parser.epilog`, which ends with examples."""

    def run(self, args: argparse.Namespace) -> int:
        """Checks the arguments, then the optional packages (`require`), then works.

        Returns:
            The exit status.
        """


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and whose epilog keeps its line breaks."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def error(self, message: str) -> NoReturn:
        """Prints one line to standard error and exits with status 2."""
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: {message} (see {self.prog} --help)\n")


class TopParser(Parser):
    """The parser of the program itself, whose help fits a screen of 80 columns and 24 lines."""

    def format_help(self) -> str:
        """One line for each command, in groups."""
        lines = ["usage: saccade COMMAND ...     or: saccade COMMAND --help, saccade --version", ""]
        for group, names in GROUPS.items():
            for index, name in enumerate(names):
                heading = group if index == 0 else ""
                lines.append(f"{heading:<8} {name:<10} {COMMANDS.get(name) or LAB_COMMANDS[name]}")
        return "\n".join([*lines, ""])


def load_command(name: str) -> Command:
    """The module of a command; a `UsageError` for one of the lab, if that is not installed."""
    if name in COMMANDS:
        module = importlib.import_module(f"saccade.cli.{name}")
    elif name in LAB_COMMANDS:
        # Entry points of other distributions are not asked: a name has one meaning.
        try:
            (entry,) = importlib.metadata.distribution(LAB).entry_points.select(group=ENTRY_POINTS, name=name)
        except (importlib.metadata.PackageNotFoundError, ValueError):
            install = extras.install_lab(LAB_EXTRAS.get(name, "sim"))
            raise UsageError(
                f"{name}: needs {LAB}, which is not installed. Install with: {install}"
            ) from None
        module = entry.load()
    else:
        raise KeyError(name)
    if not isinstance(module, Command):
        raise TypeError(f"{module.__name__}: expected HELP, add_arguments and run")
    return module


def build_parser(chosen: str | None = None) -> argparse.ArgumentParser:
    """The parser of the command line, with the arguments of the chosen command; no other is imported."""
    parser = TopParser(prog="saccade")
    parser.add_argument("--version", action="version", version=f"saccade {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="command", parser_class=Parser)
    for name, help_line in {**COMMANDS, **LAB_COMMANDS}.items():
        sub = commands.add_parser(
            name, help=help_line, description=help_line[0].upper() + help_line[1:] + "."
        )
        if name == chosen:
            load_command(name).add_arguments(sub)
    return parser


def describe(error: BaseException) -> str:
    r"""What went wrong, on one line.

    Example:
        >>> describe(FileNotFoundError(2, "No such file or directory", "policy.safetensors"))
        'policy.safetensors: No such file or directory'
        >>> describe(ValueError("first\n  second"))
        'first; second'
    """
    if isinstance(error, OSError) and error.strerror:
        return (
            error.strerror if error.filename is None else f"{os.fsdecode(error.filename)}: {error.strerror}"
        )
    lines = [line.strip() for line in str(error).splitlines()]
    return "; ".join(line for line in lines if line) or type(error).__name__


def require(command: str) -> None:
    """Checks that the optional packages of a command are installed; `MissingExtraError` names the others."""
    extras.SACCADE.require(*NEEDS[command])


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        argv: The arguments after the program's name; None takes those of the process.

    Returns:
        The exit status, see the module.

    Raises:
        SystemExit: From `--help`, `--version` and arguments that do not parse (status 2).
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        output.prepare_streams()
        try:
            with terminable(), plain_warnings():
                return dispatch(argv)
        finally:
            output.flush()  # finds a closed pipe or a full disk here, not while the interpreter ends
    except KeyboardInterrupt:
        print("saccade: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        output.discard_output()
        return EXIT_BROKEN_PIPE
    except output.OutputError as error:
        output.discard_output()
        return refuse(str(error))


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM ends the block as an exception does, so that processes which it started end, too.

    Its usual effect is to end this process alone. Nothing changes where SIGTERM has another effect already,
    and in threads other than the main one, which cannot set it.
    """

    def stop(number: int, frame: object) -> NoReturn:
        sys.exit(EXIT_TERMINATED)

    usual = signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if not usual or threading.current_thread() is not threading.main_thread():
        yield
        return
    signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def plain_warnings() -> Iterator[None]:
    """Warnings of this package are one line each, without the place in the code."""
    usual = warnings.formatwarning

    def plain(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
    ) -> str:
        if issubclass(category, UserWarning):
            return f"saccade: warning: {message}\n"
        return usual(message, category, filename, lineno, line)

    warnings.formatwarning = plain
    try:
        yield
    finally:
        warnings.formatwarning = usual


def dispatch(argv: list[str]) -> int:
    """Parses `argv`, runs the chosen command and turns bad input into one line and status 2."""
    # The program's own options take no value, so the first word that is no option is the command.
    chosen = next((word for word in argv if not word.startswith("-")), None)
    table = extras.SACCADE
    try:
        parser = build_parser(chosen)
        args = parser.parse_args(argv)
        if args.command is None:
            parser.print_help()
            return EXIT_OK
        command = load_command(args.command)
        table = getattr(command, "EXTRAS", table)
        return command.run(args)
    except (UsageError, SaccadeError, *PATH_ERRORS) as error:
        return refuse(describe(error))
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.filename is None:
            output.flush()  # raises if the error is that of standard output
            if error.errno not in DISK_ERRORS:
                raise
        return refuse(describe(error))
    except MemoryError as error:
        return refuse(f"too large for this machine's memory: {error}".removesuffix(": "))
    except ModuleNotFoundError as error:
        missing = table.explain(error)
        if missing is None:
            raise
        return refuse(describe(missing))


def refuse(message: str) -> int:
    """Prints one line to standard error, if that can be written; returns the status of bad input."""
    with contextlib.suppress(OSError):
        print(f"saccade: {message}", file=sys.stderr)
    return EXIT_BAD_INPUT
