"""`saccade inspect`: prints what a checkpoint contains."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError, add_data_config, add_overrides, flags_given
from saccade.cli import EXIT_OK, output, precisions
from saccade.cli.output import Section, show

if TYPE_CHECKING:
    from saccade.checkpoints.findings import Inspection, Resemblance, Spread, TokenStatistics
    from saccade.checkpoints.whole import BackboneFindings, RobotFindings

HELP = "show what a checkpoint contains"

EPILOG = """\
Reads every tensor of the head once, one at a time: about ten seconds for a published checkpoint.

A tensor counts "as initialised" if it is distributed as the released constructors draw it: uniform with
1 / sqrt(inputs) for linear layers; normal with 0.02 for the embodiments' layers, tokens and positions. The
last table lists the evidence for and against "this checkpoint was trained from a random start";
docs/checkpoint-tools.md explains when that happens.

With --precision-check it runs the whole checkpoint instead, at every precision on the same images from the
same noise, compares features and actions with float32, and recommends the smallest precision whose actions
differ by at most 1 % of their range. docs/precision.md says why. With --reference all are compared with the
float32 of that checkpoint: what a checkpoint of `saccade quantize` has lost.

examples:
  saccade inspect GR00T-N1.5-3B/
  saccade inspect nvidia/GR00T-N1.5-3B --json          downloaded, or from the cache
  saccade inspect my-fork/ --reference GR00T-N1.5-3B/  is it still the checkpoint that it started from?
  saccade inspect GR00T-N1.5-3B/ --data-config fourier_gr1_arms_only    what this data config needs
  saccade inspect my-policy/ --precision-check frames/ --instruction "open the drawer"
  saccade inspect my-int4/ --reference my-policy/ --precision-check frames/ --instruction "open the drawer"
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    arguments.add_checkpoint_argument(parser)
    arguments.add_config(parser)
    add_data_config(parser)
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="PATH",
        help="checkpoint to compare with, tensor by tensor or in actions",
    )
    arguments.add_json(parser, "print JSON instead of tables")
    seen = parser.add_argument_group("compare the precisions on images and an instruction")
    arguments.add_pictures(seen, "--precision-check")
    arguments.add_preprocessing(seen)
    add_overrides(seen)
    arguments.add_integer(seen, "--seed", minimum=0, help="seed of the noise (default: 0)")
    arguments.add_num_threads(seen, "threads (default: the physical cores)")


def run(args: argparse.Namespace) -> int:
    """Reads the checkpoint and prints what it contains, or compares its precisions."""
    if args.precision_check is not None:
        return precisions.run(args)
    if given := flags_given(args, precisions.ARGUMENTS):
        raise UsageError(f"{given}: only with --precision-check")
    from saccade.checkpoints.inspection import inspect

    with output.progress_bar("reading", in_bytes=True, transient=True) as update:
        report = inspect(
            args.checkpoint,
            config=args.config,
            reference=args.reference,
            data_config=args.data_config,
            progress=update,
        )
    if args.json:
        output.print_json(dataclasses.asdict(report), indent=1)
    else:
        show(sections(report))
    return EXIT_OK


def sections(report: Inspection) -> list[Section]:
    """All tables, top to bottom."""
    found = [checkpoint(report), sizes(report), parts(report), memory(report)]
    if report.backbone is not None:
        found.append(backbone(report.backbone))
    if report.robots:
        found.append(robots(report.robots))
        notes = robot_notes(report.robots)
        found += [] if notes is None else [notes]
    found.append(embodiments(report))
    if report.future_tokens is not None:
        found.append(future_tokens(report.future_tokens))
    if report.reference is not None:
        found.append(reference(report.reference))
    odd = [[sentence] for sentence in report.odd] or [["nothing"]]
    return [*found, Section("Unusual", [""], odd), from_noise(report.from_noise)]


def checkpoint(report: Inspection) -> Section:
    """What the checkpoint is, and the evidence for it."""
    size = sum(file.nbytes for file in report.files)
    outside = [
        f"{counts.tensors} tensors, {megabytes(counts.nbytes)} MB of {name}"
        for name, counts in report.outside.items()
    ]
    rows = [
        ["version", f"GR00T {report.version.upper()}"],
        ["layout", report.layout],
        ["files", f"{len(report.files)}, {megabytes(size)} MB"],
        ["prefix of the head", report.prefix or "none"],
        ["outside the head", "; ".join(outside) or "nothing"],
        *([["int4 weights", f"rounded {report.rounding}"]] if report.rounding else []),
        *listed("evidence", report.evidence),
    ]
    return Section(str(report.source), ["", ""], rows)


def sizes(report: Inspection) -> Section:
    """The sizes that users need."""
    config = report.config
    rows = [
        ["future tokens (N)", str(config.num_future_tokens)],
        ["actions in a chunk (T)", str(config.action_horizon)],
        ["width of an action", str(config.action_dim)],
        ["decoders", ", ".join(f"{name} {width}" for name, width in config.decoders)],
        ["width of a state", str(config.state_dim)],
        ["embodiments", str(config.num_embodiments)],
        ["blocks", f"{config.num_layers}, {config.num_heads} heads of {config.head_dim}"],
        ["blocks of VL self-attention", str(config.vl_num_layers)],
        ["width of VL tokens", str(config.context_dim)],
        ["Euler steps", str(config.num_steps)],
    ]
    if config.encoder_action_dim != config.action_dim:
        rows.insert(3, ["width of an action while denoised", str(config.encoder_action_dim)])
    if config.state_history != 1:
        rows.insert(5, ["states in a history", str(config.state_history)])
    return Section("Sizes", ["", ""], rows)


def parts(report: Inspection) -> Section:
    """Tensors, parameters and bytes by part."""
    rows = []
    for name, part in report.parts.items():
        types = ", ".join(f"{count} {dtype}" for dtype, count in part.dtypes.items())
        fresh = f"{part.as_drawn} of {part.judged}" if part.judged else "-"
        rows.append([name, str(part.tensors), f"{part.parameters:,}", megabytes(part.nbytes), types, fresh])
    tensors = sum(part.tensors for part in report.parts.values())
    nbytes = sum(part.nbytes for part in report.parts.values())
    rows.append(["head", str(tensors), f"{report.parameters:,}", megabytes(nbytes), "", ""])
    return Section("Parts", ["", ">tensors", ">parameters", ">MB", "types", ">as initialised"], rows)


def memory(report: Inspection) -> Section:
    """Memory of the loaded head at each precision."""
    rows = [
        [precision, megabytes(nbytes.all), megabytes(nbytes.one)]
        for precision, nbytes in report.memory.items()
    ]
    return Section("Memory", ["", ">MB, all embodiments", ">MB, one"], rows)


def backbone(found: BackboneFindings) -> Section:
    """The backbone: sizes, memory, and what prepares its inputs."""
    config = found.config
    if config is None:
        return Section("Backbone", ["", ""], [["not one that saccade loads", line(found.problem)]])
    vision = f"{config.vision_num_layers} layers of {config.vision_width}, {config.vision_num_heads} heads"
    words = f"{config.num_layers} layers of {config.width}, {config.num_heads} heads of {config.head_dim}"
    image = "any size" if config.image_size is None else f"{config.image_size} x {config.image_size}"
    memory = ", ".join(f"{precision} {megabytes(nbytes)}" for precision, nbytes in found.memory.items())
    return Section(
        "Backbone",
        ["", ""],
        [
            ["version", f"GR00T {config.version.upper()}"],
            ["vision tower", f"{vision}, patches of {config.patch_size}, views of {image}"],
            ["language model", f"{words}, {config.vocab_size:,} tokens"],
            ["width of features", str(config.feature_dim)],
            ["MB in memory", memory],
            ["preprocessing", found.processor or "see below"],
            *([["missing", line(found.processor_problem)]] if found.processor_problem else []),
        ],
    )


def robots(found: Sequence[RobotFindings]) -> Section:
    """What an observation of each robot must contain."""
    rows = []
    for robot in found:
        name = robot.embodiment or "the robot"
        if robot.needs is None:
            rows.append([name, "", "cannot be used, see below", "", "", ""])
            continue
        needs = robot.needs
        cameras = "not named" if needs.cameras is None else ", ".join(map(str, needs.cameras))
        rows.append(
            [
                needs.embodiment or name,
                "" if robot.embodiment_id is None else str(robot.embodiment_id),
                cameras,
                ", ".join(f"{key} {width}" for key, width in needs.state),
                "any annotation" if needs.any_annotation else ", ".join(needs.language_keys) or "not named",
                ", ".join(f"{key} {width}" for key, width in robot.actions),
            ]
        )
    columns = ["embodiment", ">id", "cameras", "state", "language", "actions"]
    return Section("Robots whose statistics are here, and what an observation contains", columns, rows)


def robot_notes(found: Sequence[RobotFindings]) -> Section | None:
    """Why robots cannot be used, and what is not known of the others; None if there is nothing to say."""
    rows = [
        [robot.embodiment or "the robot", what, line(text)]
        for robot in found
        for what, text in (("cannot be used", robot.problem), ("not certain", robot.warning))
        if text is not None
    ]
    rows += [
        [robot.embodiment or "the robot", "data config", robot.data_config]
        for robot in found
        if robot.data_config is not None
    ]
    return Section("Notes on robots", ["embodiment", "", ""], rows) if rows else None


def line(text: str | None) -> str:
    """Text on one line."""
    return " ".join((text or "").split())


def embodiments(report: Inspection) -> Section:
    """Which embodiments look trained; consecutive ids without a name and with equal findings share a row."""
    rows = []
    for _, group in groupby(report.embodiments, key=lambda one: (one.id if one.names else None, one.weights)):
        run = list(group)
        ids = str(run[0].id) if len(run) == 1 else f"{run[0].id} to {run[-1].id}"
        norms, scores = [one.norm for one in run], [one.robust_z for one in run]
        rows.append([ids, ", ".join(run[0].names), span(norms, ".2f"), span(scores, ".1f"), run[0].weights])
    title = (
        "Embodiments: norms of their layers, and the robust z-scores of these; "
        '"trained" if not distributed as initialised'
    )
    return Section(title, [">id", "name", ">norm", ">robust z", "weights"], rows)


def span(values: Sequence[float | None], form: str) -> str:
    """One number, or the smallest and the largest."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    low, high = f"{min(known):{form}}", f"{max(known):{form}}"
    return low if low == high else f"{low} to {high}"


def future_tokens(tokens: TokenStatistics) -> Section:
    """Statistics of the future tokens, next to those of a random draw."""
    drawn = tokens.drawn
    rows = [
        ["norm", spread(tokens.norm), spread(drawn.norm)],
        ["cosine of pairs", spread(tokens.cosine), spread(drawn.cosine)],
        [
            "effective rank",
            f"{tokens.effective_rank:.2f} of {tokens.count}",
            f"{drawn.effective_rank:.2f}",
        ],
        ["standard deviation", f"{tokens.std:.4f}", "0.0200"],
        ["distance from N(0, 0.02)", f"{tokens.distance:.4f}", ""],
    ]
    return Section("Future tokens: mean (smallest to largest)", ["", "these", "a random draw"], rows)


def spread(values: Spread | None) -> str:
    """Mean, minimum and maximum on one line."""
    if values is None:
        return "-"
    return f"{values.mean:.4f} ({values.min:.4f} to {values.max:.4f})"


def reference(found: Resemblance) -> Section:
    """The comparison with the reference checkpoint."""
    rows = [
        [
            name,
            f"{part.identical} of {part.compared}",
            spread(part.cosine),
            f"{part.largest_change:.3g}" if part.cosine else "-",
        ]
        for name, part in found.parts.items()
    ]
    rows += [[what, "", "different shape", ""] for what in found.different_shapes]
    modules = dict.fromkeys(name.partition(".")[0] for name in found.not_in_reference)
    rows += [[module, "", "not in the reference", ""] for module in modules]
    title = f"Compared with {found.source}: tensors, one slice per embodiment"
    return Section(title, ["", ">identical", "cosine of other weights", ">largest change"], rows)


def from_noise(found: Mapping[str, Sequence[str]]) -> Section:
    """The evidence on a random start."""
    rows = [row for side in ("for", "against", "neither") for row in listed(side, found[side])]
    return Section('Evidence on "it was trained from a random start"', ["", ""], rows or [["", "none"]])


def listed(name: str, values: Sequence[str]) -> list[list[str]]:
    """A row for each value, the first with the name."""
    return [[name if index == 0 else "", value] for index, value in enumerate(values)]


def megabytes(nbytes: int) -> str:
    """Bytes in units of 10^6, as text."""
    return f"{nbytes / 1e6:,.1f}"
