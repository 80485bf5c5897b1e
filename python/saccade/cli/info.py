"""`saccade info`: what a bug report needs to say about this installation and this machine."""

from __future__ import annotations

import argparse

from saccade._internal import flags as arguments
from saccade._internal.environment import show_config
from saccade.cli import EXIT_OK, output

HELP = "say what a bug report needs: version, CPU, packages"
EPILOG = """\
The same as saccade.show_config() in Python. Nothing in it names a person or a path.

examples:
  saccade info
  saccade info --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    arguments.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Prints it."""
    if args.json:
        output.print_json(show_config("dicts"), indent=1)
    else:
        show_config()
    return EXIT_OK
