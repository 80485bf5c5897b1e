"""`saccade verify`: checks all of a checkpoint that can be checked, runs it, and prints a report to send."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from saccade._internal import extras
from saccade._internal import flags as arguments
from saccade._internal.environment import show_config
from saccade._internal.flags import UsageError, add_data_config, add_overrides
from saccade.cli import EXIT_OK, LAB, output
from saccade.cli.output import Section, plain
from saccade.cli.recorded import extension

if TYPE_CHECKING:
    from saccade.checkpoints.trial import Run
    from saccade.checkpoints.verification import Tensors, Verification
    from saccade.checkpoints.whole import RobotFindings

HELP = "check a checkpoint, run it, print a report to send"
EPILOG = """\
Reads every tensor once: name, shape, type, NaN and infinity. Says which robots can be used, and why others
are refused. Then computes one chunk at each precision from the same random frames and noise, one precision
after another, and compares with float32. Without a backbone, or if the policy is refused, the head alone
runs on random features. --reference, which needs the lab, also computes it in torch, in float32.

What it prints is the text for the issue form "I ran it on a published checkpoint". It names no folder above
the checkpoint, and your home is ~; --json has whole paths. Exit status: 0 passed; 1 something is wrong, or
the whole policy was not run; 2 there is no such checkpoint, or an argument is wrong.

examples:
  saccade verify GR00T-N1.5-3B/ --data-config fourier_gr1_arms_only
  saccade verify GR00T-N1.5-3B/ --embodiment gr1 --tokenizer tokenizer.json --reference
  saccade verify my-policy/ --json
"""
EXIT_FAILED = 1
VERDICTS = {
    "passed": "passed: nothing is wrong that can be seen here",
    "failed": "FAILED: see the problems",
    "incomplete": "incomplete: the whole policy was not run; say what it asks for",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    arguments.add_checkpoint_argument(parser)
    arguments.add_preprocessing(parser)
    add_data_config(parser)
    add_overrides(parser)
    parser.add_argument(
        "--reference", action="store_true", help="also compare with the torch reference (needs the lab)"
    )
    arguments.add_seed(parser, "seed of frames and noise")
    arguments.add_num_threads(parser, "threads (default: the physical cores)")
    arguments.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Verifies, and prints the report."""
    reference = None
    if args.reference:
        reference = extension("reference")
        if reference is None:
            raise UsageError(
                f"--reference: needs {LAB}, which is not installed. Install with: "
                f"{extras.install_lab('study')}"
            )
    from saccade.checkpoints.verification import verify

    found = verify(
        args.checkpoint,
        **arguments.loading_options(args),
        seed=args.seed,
        reference=reference,
        progress=lambda text: output.note("verify", text),
    )
    if args.json:
        machine = show_config("dicts")
        fields = {"verdict": found.verdict, **dataclasses.asdict(found)}
        output.print_json({**fields, "peak_memory": peak_memory(), "machine": machine}, indent=1)
    else:
        print("\n".join(report(found)))
    return EXIT_OK if found.verdict == "passed" else EXIT_FAILED


def report(found: Verification) -> list[str]:
    """The lines of the report."""
    machine = show_config("dicts")
    name = found.published or Path(found.source).resolve().name
    what = "not recognised" if found.version is None else f"GR00T {found.version.upper()}, {found.layout}"
    lines = [
        f"saccade     {build_of(machine)}",
        f"machine     {machine['cpu']}; {machine['isa']}; {machine['num_threads']} threads",
    ]
    lines += listed("tensors", [part(name, tensors) for name, tensors in found.tensors.items()])
    lines += listed("robots", [robot(one) for one in found.robots] or ["no statistics"])
    robot_of = "" if found.robot is None else f", as {found.robot}"
    ran = {
        "policy": f"the whole policy{robot_of}",
        "head": f"the head alone, as embodiment {found.robot}, on random features",
    }
    lines += listed("run", [ran[found.part] if found.part else "nothing"])
    if found.refused is not None:
        lines += listed("refused", [f"the whole policy: {found.refused}"])
    lines += ["", plain(table(found.runs)), ""] if found.runs else []
    compared = ["not compared; --reference compares a whole policy, with the lab and torch"]
    if found.reference is not None:
        compared = [f"{key}: {value:.1e}" for key, value in found.reference.items()]
    lines += listed("reference", compared)
    if peak := peak_memory():
        lines += listed("memory", [f"{peak / 1e9:.1f} GB at most, of the whole process"])
    lines += listed("problems", found.problems or ["none"])
    lines.append(f"verdict     {VERDICTS[found.verdict]}")
    return [f"checkpoint  {name}: {what}", *(without_folder(line, Path(found.source)) for line in lines)]


def without_folder(text: str, checkpoint: Path) -> str:
    """A text that names files of a checkpoint by its own name, without the folders above it; home is ``~``.

    Example:
        >>> without_folder("/home/me/weights/policy/config.json: broken", Path("/home/me/weights/policy"))
        'policy/config.json: broken'
    """
    for path in (checkpoint.resolve(), checkpoint):
        if path.parent != Path():
            text = text.replace(str(path), path.name)
    try:
        home = Path.home()  # of other files, such as a tokenizer that was given
    except RuntimeError:  # nobody's
        return text
    return text if home.parent == home else text.replace(f"{home}{os.sep}", f"~{os.sep}")


def build_of(machine: dict[str, object]) -> str:
    """Version, library, Python and system."""
    library = f"library {machine['library']}"
    return f"{machine['saccade']} ({library}); Python {machine['python']}; {machine['system']}"


def listed(name: str, values: list[str]) -> list[str]:
    """A line for each value, the first with the name."""
    return [f"{name if index == 0 else '':<12}{value}" for index, value in enumerate(values)]


def part(name: str, tensors: Tensors) -> str:
    """What one part has."""
    dtypes = ", ".join(f"{count} {dtype}" for dtype, count in sorted(tensors.dtypes.items()))
    text = f"{name} {tensors.count}: {tensors.parameters / 1e6:,.1f} million values, {dtypes}"
    return text if name != "neither" else f"{text}; not read"


def robot(one: RobotFindings) -> str:
    """A robot, and what an observation of it must contain, or why it is refused."""
    name = one.embodiment or "one without a tag"
    if one.problem is not None:
        return f"{name}: refused: {' '.join(one.problem.split())}"
    assert one.needs is not None
    text = f"{name}: {one.needs}; actions {', '.join(f'{key} ({size})' for key, size in one.actions)}"
    named = "" if one.data_config is None else f"; data config {one.data_config}"
    return f"{text}{named}" + ("" if one.warning is None else f"; warning: {' '.join(one.warning.split())}")


def table(runs: list[Run]) -> Section:
    """A row for each precision."""
    rows = []
    for one in runs:
        if one.nbytes is None or one.load_seconds is None or one.milliseconds is None:
            rows.append([one.name, "", "", "", one.problem or ""])
            continue
        apart = "-"
        if one.difference is not None:
            of_range = one.difference.of_range
            apart = ", ".join(
                f"{key} {largest:.1e} ({of_range[key]:.2%})"
                for key, largest in one.difference.largest.items()
            )
        rows.append(
            [
                one.name,
                f"{one.nbytes / 1e6:,.1f}",
                f"{one.load_seconds:.1f}",
                f"{one.milliseconds:,.1f}",
                one.problem or apart,
            ]
        )
    columns = ["precision", ">MB", ">s to load", ">ms", "largest difference from float32 (of the range)"]
    return Section("One chunk, same frames and noise; times are rough", columns, rows)


def peak_memory() -> int | None:
    """The most memory that this process had, in bytes; None where the system does not say."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
