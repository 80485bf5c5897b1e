"""`saccade inspect --precision-check`: compares the precisions of a whole checkpoint on images."""

from __future__ import annotations

import argparse
import dataclasses
from typing import TYPE_CHECKING

from saccade._internal.flags import LOADING, UsageError, loading_options
from saccade.cli import EXIT_OK, output, require
from saccade.cli.output import Section, show

if TYPE_CHECKING:
    from saccade.checkpoints.precisions import Difference, PrecisionCheck

#: The arguments that need `--precision-check`; None where they are not given.
ARGUMENTS = ("instruction", "state", "seed", *(name for name in LOADING if name != "data_config"))


def run(args: argparse.Namespace) -> int:
    """Compares, prints and recommends."""
    if args.config is not None:
        raise UsageError("--config: not with --precision-check")
    require("inspect --precision-check")
    from saccade.checkpoints.precisions import check_precisions

    with output.progress_bar("comparing", transient=True) as update:
        found = check_precisions(
            args.checkpoint,
            args.precision_check,
            reference=args.reference,
            instruction=args.instruction,
            state=args.state,
            **loading_options(args),
            seed=args.seed or 0,
            progress=update,
        )
    if args.json:
        output.print_json(dataclasses.asdict(found), indent=1)
        return EXIT_OK
    show([overview(found), by_key(found)])
    close = f"actions differ by at most {found.tolerance:.0%} of their range"
    if found.recommended is None:
        print(f"recommended: none of these, since there is none whose {close}")
    else:
        print(f"recommended: {found.recommended}, the smallest whose {close}")
    if found.is_quantized and found.reference is None:
        print(
            "The weights of this checkpoint are rounded already, and what that has changed is in none of "
            "these differences. --reference CHECKPOINT compares with what it was made from."
        )
    return EXIT_OK


def overview(found: PrecisionCheck) -> Section:
    """A row for each precision."""
    rows = [
        [
            one.name,
            f"{one.features:.1e}",
            of_range(one.actions),
            f"{one.nbytes / 1e6:,.1f}",
            f"{one.milliseconds:,.1f}",
        ]
        for one in found.precisions
    ]
    rows.append(["float32, other noise", "-", of_range(found.other_noise), "-", "-"])
    count = f"{found.observations} observations, {found.samples} chunks of each, same noise"
    of = "" if found.reference is None else f" of {found.reference}"
    columns = ["", ">error of features", ">largest of an action, of its range", ">MB", ">ms"]
    return Section(f"Difference from float32{of}: {count}", columns, rows)


def by_key(found: PrecisionCheck) -> Section:
    """The largest differences in the robot's units, a row for each key of the action."""
    # float32 differs from itself by nothing.
    compared = found.precisions[1:] if found.reference is None else found.precisions
    differences = [*(one.actions for one in compared), found.other_noise]
    rows = [
        [key, *(f"{one.largest[key]:.2e} ({one.of_range[key]:.2%})" for one in differences)]
        for key in found.other_noise.largest
    ]
    names = [*(one.name for one in compared), "float32, other noise"]
    return Section(
        "Largest difference of an action in the robot's units (of its range)",
        ["", *(f">{name}" for name in names)],
        rows,
    )


def of_range(found: Difference) -> str:
    """The largest difference, relative to the range."""
    return f"{found.worst:.2%}"
