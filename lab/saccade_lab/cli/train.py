"""``saccade train``: trains the policy on recorded demonstrations."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from saccade._internal import flags as arguments
from saccade.cli import EXIT_INTERRUPTED, EXIT_OK, output
from saccade_lab.extras import LAB, require
from saccade_lab.files import writable_directory

if TYPE_CHECKING:
    from saccade_lab.training.settings import TrainingSettings
    from saccade_lab.training.train import Progress

HELP = "train a policy on recorded demonstrations"
EXTRAS = LAB

EPILOG = """\
Trains a small whole checkpoint of GR00T N1.5's kind, a SigLIP, a Qwen3 and an action head, and writes it in
NVIDIA's layout for `saccade rollout --checkpoint DIR` and `saccade.Policy.from_pretrained`. DIR also receives
settings.json, history.json, loss.png and training.pt. All are written about once a minute. If the command is
interrupted, run it again: it continues where it stopped, and the weights at the end are the same as those of
an uninterrupted run. The defaults are those of the bundled policy; `make demo-policy` trains it again.
On demonstrations of LIBERO the policy is of N1.7's kind or of N1.5's, and is run by `saccade libero DIR`.

examples:
  saccade train --demos out/demos --out out/policy
  saccade train --demos out/more --start-from out/policy --learning-rate 3e-4 --out out/next
  saccade train --demos out/demos --out out/n0 --num-future-tokens 0
  saccade train --demos out/demos --out out/aligned --alignment-weight 0.2
  saccade train --demos out/demos --out out/quick --training-steps 2000 --num-threads 2
  saccade train --demos out/libero --out out/libero-policy --num-threads 2
  saccade train --demos out/libero --out out/libero-n15 --num-threads 2 --version n1.5
"""

# Flag, its smallest value, and what it is.
INTEGERS = (
    ("--training-steps", 1, "optimiser steps"),
    ("--batch-size", 1, "observations per step"),
    ("--seed", 0, "seed of weights, order and noise"),
    ("--num-future-tokens", 0, "number of learned query tokens, N"),
    ("--patch-size", 2, "pixels along each side of the patch behind an image token, even"),
    ("--vl-num-layers", 0, "blocks of the head's VL self-attention"),
    ("--width", 8, "width of language model and head"),
    ("--num-layers", 1, "blocks of the head"),
    ("--shift", 0, "pixels by which frames are shifted at random, at most"),
)

# Flag, its smallest value, what it is below, and what it is.
NUMBERS = (
    ("--learning-rate", 1e-9, 1.0, "learning rate of AdamW after the warm-up"),
    ("--ema-decay", 0.0, 1.0, "decay of the averaged weights, which are those that are saved"),
    (
        "--absent-share",
        0.0,
        1.0,
        "share of frames with the instruction of an absent object, for which the policy learns to keep still",
    ),
    (
        "--language-dropout",
        0.0,
        1.0,
        "share of frames with the released default for a missing instruction, which guidance makes use of",
    ),
    (
        "--alignment-weight",
        0.0,
        float("inf"),
        "weight of the loss that aligns the future tokens' rows with the observation one horizon later; "
        "FLARE uses 0.2",
    ),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    from saccade_lab.training.settings import LIBERO_SETTINGS

    parser.epilog = EPILOG
    parser.add_argument(
        "--demos", type=Path, required=True, metavar="DIR", help="directory written by `saccade demos`"
    )
    arguments.add_out(parser, None, "directory of the run")
    arguments.add_num_threads(parser, "threads of torch", 1)
    parser.add_argument(
        "--device", default="cpu", help="torch's name of the device, such as cuda (default: cpu)"
    )
    for flag, smallest, what in INTEGERS:
        arguments.add_integer(parser, flag, minimum=smallest, help=f"{what} ({default_of(flag)})")
    for flag, lowest, limit, what in NUMBERS:
        help = f"{what} ({default_of(flag)})"
        arguments.add_number(parser, flag, minimum=lowest, below=limit, help=help)
    parser.add_argument(
        "--dtype",
        choices=("float32", "bfloat16"),
        help="what most is computed in, on a CPU; bfloat16 is faster where the CPU multiplies it (default: "
        "float32)",
    )
    parser.add_argument(
        "--version",
        choices=("n1.5", "n1.7"),
        help="release of GR00T whose layout the checkpoint has; n1.7 only on LIBERO, where it is the default",
    )
    arguments.add_integer(
        parser,
        "--view-size",
        minimum=32,
        help="pixels along each side of a frame as the policy sees it, only on LIBERO "
        f"(default: {LIBERO_SETTINGS.view_size})",
    )
    parser.add_argument(
        "--start-from", type=Path, metavar="DIR", help="policy to start from (default: random weights)"
    )


def run(args: argparse.Namespace) -> int:
    """Checks the arguments, then trains."""
    from saccade_lab.libero.recording import is_recording, read_recordings
    from saccade_lab.sim.demos import recorded_tasks

    if args.start_from is not None and not (args.start_from / "model.safetensors").is_file():
        raise FileNotFoundError(f"{args.start_from}: no policy there")
    on_libero = is_recording(args.demos)
    if on_libero and args.start_from is not None:
        raise arguments.UsageError("--start-from: not with demonstrations of LIBERO")
    if not on_libero and (args.version == "n1.7" or args.view_size is not None):
        raise arguments.UsageError("--version n1.7, --view-size: only with demonstrations of LIBERO")
    if on_libero:
        read_recordings(args.demos)
    else:
        recorded_tasks(args.demos)
    settings = training_settings(args, on_libero=on_libero)
    require("train")
    import torch

    from saccade_lab.training import train

    writable_directory(args.out)
    torch.set_num_threads(args.num_threads)
    try:
        torch.empty(0, device=args.device)
    except (RuntimeError, AssertionError) as error:  # AssertionError: torch is built without CUDA
        reason = str(error).splitlines()[0]
        raise arguments.UsageError(f"--device: torch cannot use {args.device!r}: {reason}") from None
    try:
        with output.progress_bar("reading", settings.steps) as update:

            def on_step(now: Progress) -> None:
                held_out = "" if now.validation_loss is None else f", held out {now.validation_loss:.3f}"
                update(now.step, description=f"loss {now.loss:.3f}{held_out}")

            if on_libero:
                from saccade_lab.libero.training import train as train_on_libero

                train_on_libero(args.demos, args.out, settings, on_step, device=args.device)
            else:
                train.train(
                    args.demos, args.out, settings, on_step, start=args.start_from, device=args.device
                )
    except KeyboardInterrupt:
        print(f"stopped; the same command continues from {args.out / train.STATE_FILE}")
        return EXIT_INTERRUPTED
    tried = f"libero {args.out}" if on_libero else f"rollout --checkpoint {args.out}"
    print(f"policy in {args.out}; try it: saccade {tried}")
    return EXIT_OK


def training_settings(args: argparse.Namespace, *, on_libero: bool) -> TrainingSettings:
    """The settings that the arguments ask for.

    Args:
        args: Parsed arguments.
        on_libero: Whether the demonstrations are of LIBERO, which has other defaults.

    Raises:
        InputError: They do not fit each other.
    """
    from saccade_lab.training.settings import LIBERO_SETTINGS, TrainingSettings

    flags = [flag for flag, *_ in (*INTEGERS, *NUMBERS)] + ["--dtype", "--version", "--view-size"]
    given = {setting(flag): getattr(args, destination(flag)) for flag in flags}
    defaults = LIBERO_SETTINGS if on_libero else TrainingSettings()
    return replace(defaults, **{name: value for name, value in given.items() if value is not None})


def default_of(flag: str) -> str:
    """What the help text says of a default."""
    from saccade_lab.training.settings import LIBERO_SETTINGS, TrainingSettings

    usual, libero = (getattr(one, setting(flag)) for one in (TrainingSettings(), LIBERO_SETTINGS))
    return f"default: {usual:g}" + (f", on LIBERO {libero:g}" if libero != usual else "")


def destination(flag: str) -> str:
    """The name of a flag's value."""
    return flag.removeprefix("--").replace("-", "_")


def setting(flag: str) -> str:
    """The setting that a flag sets."""
    return "steps" if flag == "--training-steps" else destination(flag)
