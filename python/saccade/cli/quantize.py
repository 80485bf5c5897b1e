"""`saccade quantize`: writes a checkpoint with int8 or int4 weights."""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError
from saccade.cli import output, require
from saccade.cli.copying import add_copy_arguments, copy, print_report

if TYPE_CHECKING:
    from saccade.checkpoints import Calibration

#: Observations of a data set that are calibrated with. Most layers are given some hundred rows by each, a few
#: times as many as they have inputs by all; the last block of N1.5's head 4096, for up to 6144 inputs.
OBSERVATIONS = 64

#: The arguments that need `--calibrate`; None where they are not given.
CALIBRATING = ("observations", "instruction", "state", "seed", *arguments.LOADING)

HELP = "write a checkpoint with int8 or int4 weights"

EPILOG = """\
The weights X.weight of the attention and feed-forward layers of all blocks become int8, or with --to int4 two
in a byte, with a float32 scale for each output in X.weight_scale: those of the head, and those of the
backbone unless --keep-backbone or --head-only is given. With --to int4 its token embeddings become int8. All
other tensors are copied bit for bit, and so are the other files of the checkpoint, such as statistics,
processors and tokenizers. Policy.from_pretrained(DIR, precision="int8") gives the same bits as loading
CHECKPOINT at int8, and so with int4 unless it is calibrated. The other precisions load it too, with the
dequantized weights. docs/precision.md says how much they change actions.

--calibrate rounds int4 weights so that the outputs of their layers change least on observations of yours
(GPTQ). The whole checkpoint is run in float32 on all of them, once for every GiB of matrices that this needs:
9 times for N1.5. It goes on with the layers that are missing in DIR.calibrating if it was interrupted.

examples:
  saccade quantize GR00T-N1.5-3B/ --out GR00T-N1.5-3B-int8
  saccade quantize GR00T-N1.5-3B/ --to int4 --out GR00T-N1.5-3B-int4
  saccade quantize my-policy/ --to int4 --calibrate my-recordings/ --out my-policy-int4
  saccade quantize GR00T-N1.5-3B/ --out head-int8 --head-only --json
  saccade quantize policy.safetensors --config config.json --out policy-int8 --force
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_copy_arguments(parser)
    parser.add_argument(
        "--to", choices=("int8", "int4"), default="int8", help="of the weights (default: int8)"
    )
    parser.add_argument("--head-only", action="store_true", help="leave out the tensors outside the head")
    parser.add_argument(
        "--keep-backbone", action="store_true", help="copy the backbone's tensors as they are"
    )
    seen = parser.add_argument_group("calibration of int4 (of a whole checkpoint)")
    seen.add_argument(
        "--calibrate",
        metavar="DATASET|DIR",
        help=f"directory or published id of a LeRobotDataset (extra: data); or {arguments.PICTURES}",
    )
    arguments.add_integer(
        seen, "--observations", help=f"of a data set, evenly over all its steps (default: {OBSERVATIONS})"
    )
    arguments.add_words_and_state(seen)
    arguments.add_preprocessing(seen)
    arguments.add_data_config(seen)
    arguments.add_overrides(seen)
    arguments.add_integer(seen, "--seed", minimum=0, help="seed of the noise (default: 0)")
    arguments.add_num_threads(seen, "threads (default: the physical cores)")


def run(args: argparse.Namespace) -> int:
    """Writes the copy and reports what it contains."""
    from saccade.checkpoints import quantize

    observations: Sequence[Any] = ()
    chosen = {"to": args.to, "head_only": args.head_only, "keep_backbone": args.keep_backbone}
    if args.calibrate is None:
        if given := arguments.flags_given(args, CALIBRATING):
            raise UsageError(f"{given}: only with --calibrate")
        report = copy(quantize, "quantizing", args, **chosen)
    else:
        if args.config is not None:
            raise UsageError("--config: not with --calibrate, which runs the checkpoint with its own")
        if args.to != "int4":
            raise UsageError(f"--calibrate: only with --to int4, given {args.to}")
        with output.progress_bar("calibrating") as update:
            seen = calibration(args, update)
            observations = seen.observations
            report = quantize(
                args.checkpoint,
                args.out,
                force=args.force,
                calibration=seen,
                progress=lambda done, total: update(done // 10**6, total // 10**6, "writing, MB"),
                **chosen,
            )
    # With int4 one of a backbone's is the token embeddings.
    has_table = args.to == "int4" and report.num_quantized_backbone > 0
    table = " and the token embeddings in int8" if has_table else ""
    lines = [
        f"{args.out}: {report.num_quantized - has_table} weights in {args.to}{table}, "
        f"{report.num_copied} tensors copied, "
        f"{report.num_dropped} left out; the head has {report.head_bytes_after / 1e6:.1f} MB "
        f"(was {report.head_bytes_before / 1e6:.1f} MB)"
    ]
    if report.num_quantized_backbone:
        before, after = (size / 1e6 for size in (report.backbone_bytes_before, report.backbone_bytes_after))
        lines.append(f"the backbone has {after:.1f} MB (was {before:.1f} MB)")
    elif report.backbone_copied is not None:
        lines.append(f"tensors outside the head were copied as they are: {report.backbone_copied}")
    if report.rounding is not None:
        before, after = (error(report.rounding, kind) for kind in ("plain", "rounded"))
        lines.append(
            f"{report.num_calibrated} weights were rounded for {len(observations)} observations; on these "
            f"the outputs of their layers differ by {after:.2%} in the median, {before:.2%} with plain "
            "rounding"
        )
    return print_report(args, report, lines)


def error(rounding: Mapping[str, Mapping[str, float]], kind: str) -> float:
    """The median over layers of the error of the outputs relative to the outputs."""
    squares = [one[kind] / one["outputs"] for one in rounding.values() if one["outputs"] > 0]
    return math.sqrt(statistics.median(squares)) if squares else 0.0


def calibration(args: argparse.Namespace, progress: output.Update) -> Calibration:
    """The policy and the observations of the arguments."""
    from saccade._internal import hub
    from saccade.checkpoints import Calibration
    from saccade.policy.policy import Policy

    is_dataset = hub.parse(args.calibrate) is not None or (Path(args.calibrate) / "meta").is_dir()
    wrong = ("instruction", "state") if is_dataset else ("observations",)
    if given := arguments.flags_given(args, wrong):
        kind = "a data set" if is_dataset else "a directory of images"
        raise UsageError(f"{given}: not with --calibrate {args.calibrate}, which is {kind}")
    if not is_dataset:
        require("quantize --calibrate")
        if args.instruction is None:
            raise UsageError("--instruction: expected what the robot is told, since --calibrate has images")
    policy = Policy.from_pretrained(args.checkpoint, **arguments.loading_options(args))
    observations: Sequence[Any]
    if is_dataset:
        from saccade.datasets import open as open_recordings
        from saccade.evaluation.recordings import SpacedObservations, fitted

        data = fitted(policy, open_recordings(args.calibrate))
        observations = SpacedObservations(policy, data, args.observations or OBSERVATIONS)
    else:
        from saccade.observations.pictures import STATE, observation_folders, read_frames

        found = read_frames(Path(args.calibrate), policy, instruction=args.instruction, state=args.state)
        folders = [] if args.state is not None else observation_folders(Path(args.calibrate), policy)
        lacking = [folder for folder in folders if not (folder / STATE).is_file()]
        if lacking:
            raise UsageError(f"--state: expected the robot's state, since {lacking[0]} has no {STATE}")
        observations = [one.observation for one in found]
    return Calibration(policy, observations, seed=args.seed or 0, progress=progress)
