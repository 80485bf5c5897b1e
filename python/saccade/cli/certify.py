"""`saccade certify`: checks on this machine what `saccade evaluate --certify` recorded on another."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from saccade._internal import flags as arguments
from saccade.cli import EXIT_OK, output, require
from saccade.cli.output import Section, show

HELP = "check here what `saccade evaluate --certify` recorded"
EPILOG = """\
Compares the hashes of checkpoint and recordings, computes the certified observations again, and compares the
actions: bit for bit on the instruction set and version of the certificate, else within what rounding allows.
Exit status 1 if anything differs.

examples:
  saccade certify certificate.json
  saccade certify certificate.json --checkpoint my-policy/ --recordings my-recordings/ --json
"""

EXIT_DIFFERS = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    parser.add_argument("certificate", type=Path, metavar="FILE", help="the certificate")
    parser.add_argument(
        "--checkpoint", type=Path, metavar="CHECKPOINT", help="default: the path in the certificate"
    )
    parser.add_argument("--recordings", metavar="DATASET", help="default: the path in the certificate")
    arguments.add_num_threads(parser, "threads (default: the physical cores)")
    arguments.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Computes, compares and prints."""
    require("certify")
    from saccade.evaluation.certificate import Certificate, check
    from saccade.evaluation.source import Source

    certificate = Certificate.from_file(args.certificate)
    source = Source.of(
        args.checkpoint or certificate.checkpoint["path"],
        args.recordings or certificate.recordings["path"],
        {**certificate.options, "num_threads": args.num_threads},
    )
    with output.progress_bar("certify", transient=True):
        found = check(certificate, source)
    holds = all(one.holds for one in found)
    if args.json:
        output.print_json({"holds": holds, "findings": [asdict(one) for one in found]}, indent=2)
    else:
        rows = [[one.name, one.certified, one.found, "yes" if one.holds else "NO"] for one in found]
        show([Section(str(args.certificate), ["", "certified", "here", "holds"], rows)])
    return EXIT_OK if holds else EXIT_DIFFERS
