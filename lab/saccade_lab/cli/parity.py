"""``saccade parity``: the Rust head against the torch reference in float64, on every instruction set."""

from __future__ import annotations

import argparse
import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import saccade
from saccade._internal import flags as arguments
from saccade._internal.arrays import PRECISIONS
from saccade._internal.environment import cpu_name
from saccade._internal.flags import UsageError
from saccade._internal.hub import resolve
from saccade.cli import output
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB, require
from saccade_lab.head_inputs import HeadInputs

if TYPE_CHECKING:
    from typing import TypeAlias

    import torch
    from numpy.typing import NDArray

    Outputs: TypeAlias = tuple[NDArray[Any], NDArray[Any]]  # vl_embs, actions

HELP = "compare the Rust head with the torch reference"
EXTRAS = LAB
EPILOG = """\
The reference runs in float64. Its float32 result is shown for comparison. The exit status is 1 if an action
differs from the reference by more than --tolerance; at a precision below float32 there is no verdict.

examples:
  saccade parity                                  a small random head; a second or two
  saccade parity --checkpoint checkpoint/ --embodiment-id 31
                                                  a checkpoint, on random inputs
  saccade parity --checkpoint checkpoint/ --features step.safetensors
                                                  a checkpoint, on recorded inputs
  saccade parity --version n1.7                   a small random head of another version
  saccade parity --full                           N1.5 at full size; 3 GB of disk, 8 GB of memory
  saccade parity --full --version n1.7 --dtype bfloat16
                                                  N1.7 at full size; 3 GB of disk, over 11 GB of memory
  saccade parity --full --json
  saccade parity --checkpoint checkpoint/ --precision int8
                                                  how far int8 is from float64
"""
VERSIONS = ("n1", "n1.5", "n1.6", "n1.7", "fork", "split-arms")
DEFAULT_VERSION = "n1.5"

EXIT_DIFFERENT = 1


@dataclasses.dataclass(frozen=True)
class Deviation:
    """Largest differences from the reference in float64."""

    max_abs: float  # |given - expected|
    max_rel: float  # |given - expected| / max(1, |expected|)

    @classmethod
    def between(cls, given: NDArray[np.floating[Any]], expected: NDArray[np.float64]) -> Deviation:
        """Both of the same shape; nan if anything is."""
        difference = np.abs(given.astype(np.float64) - expected)
        return cls(
            max_abs=float(difference.max()),
            max_rel=float((difference / np.maximum(1.0, np.abs(expected))).max()),
        )


@dataclasses.dataclass(frozen=True)
class Result:
    """One engine against the reference."""

    engine: str
    vl_embs: Deviation
    actions: Deviation


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    lab_flags.add_checkpoint(parser, "directory, .safetensors file or published id (default: a random head)")
    parser.add_argument(
        "--version",
        choices=VERSIONS,
        help=f"version of the random head (default: {DEFAULT_VERSION}); the last two are a fork's",
    )
    parser.add_argument(
        "--full", action="store_true", help="a random head of full width and depth (two embodiments)"
    )
    parser.add_argument(
        "--dtype",
        choices=("float32", "bfloat16"),
        help="dtype in which the random weights are stored (default: float32)",
    )
    arguments.add_features(
        parser, "recorded inputs, .npz or .safetensors as for `saccade attention` (default: random inputs)"
    )
    arguments.add_integer(
        parser, "--embodiment-id", minimum=0, help="embodiment of random inputs (default: random ids)"
    )
    arguments.add_integer(parser, "--batch", default=1, help="rows of random inputs")
    lab_flags.add_num_vl_tokens(parser, 296, "vision-language tokens of random inputs")
    arguments.add_num_steps(parser)
    parser.add_argument(
        "--precision",
        choices=PRECISIONS,
        default="float32",
        help="precision of the Rust head (default: float32)",
    )
    arguments.add_seed(parser, "seed of random weights and inputs")
    arguments.add_num_threads(parser)
    arguments.add_number(
        parser, "--tolerance", minimum=1e-300, default=1e-5, help="largest |error| / max(1, |action|)"
    )
    arguments.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Compares, prints, and returns 1 if an engine is further from the reference than the tolerance."""
    check(args)
    require("parity")
    with ExitStack() as stack:
        source = args.checkpoint
        if source is None:
            source = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="saccade-parity-")))
            write_random(source, args)
        inputs = recorded_inputs(source, args) if args.features else random_inputs(source, args)
        outputs = {}
        for engine, run_engine in engines(source, inputs, args):
            output.note("parity", engine)
            outputs[engine] = run_engine()
        output.note("parity", f"reference in float64: {describe(inputs)}")
        expected = run_reference(source, inputs, args.num_steps, "float64")
    results = [
        Result(engine, Deviation.between(vl_embs, expected[0]), Deviation.between(actions, expected[1]))
        for engine, (vl_embs, actions) in outputs.items()
    ]
    # At a lower precision it depends on the task which error is too large.
    judged = [
        result for result in results if result.engine.startswith("rust") and args.precision == "float32"
    ]
    passed = all(result.actions.max_rel <= args.tolerance for result in judged)
    random = f"random {args.version or DEFAULT_VERSION} {'full size' if args.full else 'small'}"
    report = {
        "head": str(args.checkpoint or random),
        "precision": args.precision,
        "inputs": describe(inputs),
        "machine": cpu_name(),
        "saccade": saccade.__version__,
        "largest_action": float(np.abs(expected[1]).max()),
        "tolerance": args.tolerance,
        "passed": passed,
        "results": [dataclasses.asdict(result) for result in results],
    }
    if args.json:
        output.print_json(report, indent=1)
    else:
        print(table(report, results))
    return 0 if passed else EXIT_DIFFERENT


def check(args: argparse.Namespace) -> None:
    """Refuses arguments that contradict each other before anything long has run."""
    if args.checkpoint is not None and (args.full or args.dtype is not None or args.version is not None):
        raise UsageError("--full, --dtype and --version describe random weights: leave out --checkpoint")
    if args.checkpoint is not None:
        args.checkpoint = resolve(args.checkpoint)
        if not args.checkpoint.exists():
            raise FileNotFoundError(f"{args.checkpoint}: no such checkpoint")
    if args.features is not None and not args.features.is_file():
        raise FileNotFoundError(f"{args.features}: no such file")


def write_random(folder: Path, args: argparse.Namespace) -> None:
    """Writes a random checkpoint of the requested version and size."""
    import torch

    from saccade_lab.reference import random_weights

    version = args.version or DEFAULT_VERSION
    config = random_weights.small_config(version)
    if args.full:
        config = random_weights.sized_config(version, num_embodiments=2)
    output.note("parity", "writing random weights")
    dtype = torch.bfloat16 if args.dtype == "bfloat16" else torch.float32
    random_weights.write_checkpoint(folder, config, args.seed, dtype=dtype)


def random_inputs(source: Path, args: argparse.Namespace) -> HeadInputs:
    """Standard normal inputs that fit the checkpoint."""
    from saccade_lab.reference import random_weights

    config = head_config(source)
    if config.mask_mode == "alternate" and args.num_vl_tokens < 2:
        raise UsageError(
            "--num-vl-tokens: given 1, expected at least 2: this head reads text and images in turn"
        )
    drawn = random_weights.random_inputs(
        config, args.seed + 1, batch=args.batch, num_vl_tokens=args.num_vl_tokens
    )
    inputs = HeadInputs(**{name: tensor.numpy() for name, tensor in drawn.items()})
    if args.embodiment_id is not None:
        inputs = dataclasses.replace(inputs, embodiment_id=np.full(args.batch, args.embodiment_id))
    return inputs


def recorded_inputs(source: Path, args: argparse.Namespace) -> HeadInputs:
    """The inputs of a file; noise is drawn if there is none."""
    config = head_config(source)
    inputs = HeadInputs.from_file(args.features, config).with_noise(np.random.default_rng(args.seed), config)
    assert inputs.noise is not None
    return dataclasses.replace(
        inputs,
        backbone_features=np.asarray(inputs.backbone_features, np.float32),
        state=np.asarray(inputs.state, np.float32),
        noise=np.asarray(inputs.noise, np.float32),
    )


def head_config(source: Path) -> saccade.HeadConfig:
    """The config of the head in a checkpoint, whichever layout it has."""
    from saccade_lab.reference import loading

    return saccade.HeadConfig.from_dict(loading.described(source).head_config)


def engines(
    source: Path, inputs: HeadInputs, args: argparse.Namespace
) -> Iterator[tuple[str, Callable[[], Outputs]]]:
    """The Rust head on each instruction set, then torch in float32 for comparison.

    The Rust head comes first because its messages about bad inputs are clearer.
    """
    for isa in saccade.show_config("dicts")["available_isas"]:
        name = f"rust {isa}" + ("" if args.precision == "float32" else f" {args.precision}")
        yield name, partial(run_rust, source, inputs, args, isa)
    yield "torch float32", partial(run_reference, source, inputs, args.num_steps, "float32")


def run_reference(source: Path, inputs: HeadInputs, num_steps: int | None, dtype: str) -> Outputs:
    """``vl_embs`` and actions of the reference. Its weights are freed when this returns."""
    import torch

    from saccade_lab.reference import ActionHead

    kind: torch.dtype = getattr(torch, dtype)
    head = ActionHead.from_pretrained(source, dtype=kind)
    assert inputs.noise is not None
    with torch.no_grad():
        vl_embs = head.encode(inputs.backbone_features, drop_vl=inputs.drop_vl)
        actions = head.sample(
            vl_embs,
            inputs.state,
            inputs.embodiment_id,
            noise=inputs.noise,
            num_steps=num_steps,
            drop_vl=inputs.drop_vl,
            attention_mask=inputs.attention_mask,
            image_mask=inputs.image_mask,
        )
    return vl_embs.numpy(), actions.numpy()


def run_rust(source: Path, inputs: HeadInputs, args: argparse.Namespace, isa: str) -> Outputs:
    """``vl_embs`` and actions of the Rust head on one instruction set."""
    from saccade_lab.reference import loading

    with forced_isa(isa):
        head = saccade.ActionHead.from_pretrained(
            source,
            config=loading.described(source).head_config,
            precision=args.precision,
            num_threads=args.num_threads,
        )
        context = inputs.encode(head)
        actions = inputs.sample(head, context, num_steps=args.num_steps)
    return np.asarray(context.vl_embs), actions


@contextmanager
def forced_isa(isa: str) -> Iterator[None]:
    """Sets ``SACCADE_ISA``, which is read when a head is built, and restores it at the end."""
    before = os.environ.get("SACCADE_ISA")
    os.environ["SACCADE_ISA"] = isa
    try:
        yield
    finally:
        if before is None:
            del os.environ["SACCADE_ISA"]
        else:
            os.environ["SACCADE_ISA"] = before


def describe(inputs: HeadInputs) -> str:
    """The sizes of the inputs, in words."""
    assert inputs.noise is not None
    return (
        f"batch {len(inputs)}, {inputs.num_vl_tokens} vision-language tokens, horizon {inputs.noise.shape[1]}"
    )


def table(report: dict[str, Any], results: list[Result]) -> str:
    """The report as text."""
    lines = [
        f"head      {report['head']}",
        f"inputs    {report['inputs']}; largest |action| {report['largest_action']:.2f}",
        f"machine   {report['machine']}; saccade {report['saccade']}",
        "",
        "against the reference in float64      vl_embs                 actions",
        "engine                           max abs   max rel       max abs   max rel",
    ]
    for result in results:
        vl_embs, actions = result.vl_embs, result.actions
        lines.append(
            f"{result.engine:<30}{vl_embs.max_abs:>10.1e}{vl_embs.max_rel:>10.1e}{actions.max_abs:>14.1e}{actions.max_rel:>10.1e}"
        )
    verdict = (
        f"actions are {'within' if report['passed'] else 'ABOVE'} the tolerance of {report['tolerance']:.0e}"
    )
    if report["precision"] != "float32":
        verdict = "there is no tolerance for a precision below float32: see docs/precision.md"
    lines += ["", f"rel is |error| / max(1, |value|); {verdict}"]
    return "\n".join(lines)
