"""`saccade certify`: checks on this machine what `saccade evaluate --certify` recorded on another."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade.cli import EXIT_OK, output, require
from saccade.cli.output import Section, show

if TYPE_CHECKING:
    from saccade.evaluation.certificate import Certificate

HELP = "check here what `saccade evaluate --certify` recorded"
EPILOG = """\
Compares the hashes of checkpoint, recordings, tokenizer and data config, computes the certified observations
again, and compares the actions: bit for bit with the version, build, instruction set and dot products of the
certificate, else within what rounding allows. Exit status 1 if anything differs.

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
    parser.add_argument("--tokenizer", type=Path, metavar="PATH", help="default: the path in the certificate")
    parser.add_argument("--data-config", metavar="NAME|FILE", help="default: the path in the certificate")
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
        {**certificate.options, **_files(args, certificate), "num_threads": args.num_threads},
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


def _files(args: argparse.Namespace, certificate: Certificate) -> dict[str, Any]:
    """The tokenizer and the data config of the flags, or those of the certificate if they are here.

    Raises:
        FileNotFoundError: The certificate's is not.
    """
    from saccade.evaluation.source import OPTION_FILES

    found = {}
    for name in OPTION_FILES:
        certified = certificate.options.get(name)
        found[name] = getattr(args, name) or certified
        is_here = (
            not isinstance(certified, str) or not Path(certified).is_absolute() or Path(certified).exists()
        )
        if getattr(args, name) is None and not is_here:
            flag = "--" + name.replace("_", "-")
            raise FileNotFoundError(
                f"{args.certificate}: {name}: {certified}: no such path here: pass {flag}"
            )
    return found
