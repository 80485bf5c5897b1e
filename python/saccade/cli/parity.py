"""`saccade parity`: the Rust head beside the torch reference in float64, on every instruction set."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import saccade
from saccade.cli import UsageError
from saccade.hub import resolve

if TYPE_CHECKING:
    from typing import TypeAlias

    import torch
    from numpy.typing import NDArray

    Outputs: TypeAlias = tuple[NDArray[Any], NDArray[Any]]  # vl_embs, actions

HELP = "compare the Rust head with the reference in torch"
EPILOG = """examples:
  saccade parity                                  a small random head, a second or two
  saccade parity checkpoint/ --embodiment-id 31   a checkpoint, on random inputs
  saccade parity checkpoint/ --inputs step.safetensors
                                                  on recorded features, state, embodiment_id and noise
  saccade parity --version n1.7                   a small random head of another version
  saccade parity --full                           N1.5's full size; 3 GB of disk, 8 GB of memory
  saccade parity --full --version n1.7 --bf16     N1.7's; 3 GB of disk, more than 11 GB of memory
  saccade parity --full --json                    as a program reads it
  saccade parity checkpoint/ --precision int8     how far int8 is from float64; no verdict
"""
INPUTS = ("backbone_features", "state", "embodiment_id", "noise")
MASKS = ("attention_mask", "image_mask")  # beside them where the head reads text and images in turn
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
    parser.add_argument(
        "checkpoint", nargs="?", type=Path, help="directory or .safetensors file; default: a random head"
    )
    parser.add_argument(
        "--full", action="store_true", help="a random head of the full width and depth (two embodiments)"
    )
    parser.add_argument(
        "--version", choices=VERSIONS, help="of the random head (default n1.5); the last two are a fork's"
    )
    parser.add_argument("--bf16", action="store_true", help="store the random weights in bfloat16")
    parser.add_argument(
        "--inputs",
        type=Path,
        help="safetensors file with " + ", ".join((*INPUTS, *MASKS)) + " (or _in.NAME), masks where needed",
    )
    parser.add_argument("--embodiment-id", type=int, help="for random inputs; default: random ids")
    parser.add_argument("--batch", type=int, default=1, help="rows of random inputs (default 1)")
    parser.add_argument(
        "--vl-tokens", type=int, default=296, help="vision-language tokens of random inputs (default 296)"
    )
    parser.add_argument("--num-steps", type=int, help="Euler steps (default: the checkpoint's)")
    parser.add_argument(
        "--precision",
        choices=("float32", "bfloat16", "int8"),
        default="float32",
        help="of the Rust head (default float32); the tolerance is for float32",
    )
    parser.add_argument("--seed", type=int, default=0, help="of random weights and inputs (default 0)")
    parser.add_argument("--threads", type=int, help="threads of the Rust head (default: the physical cores)")
    parser.add_argument(
        "--tolerance",
        type=float,
        default=1e-5,
        help="exit status 1 above this max |error| / max(1, |action|) (default 1e-5)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def run(args: argparse.Namespace) -> int:
    """Compares, prints, and returns 1 if an engine is further from the reference than the tolerance."""
    check(args)
    with ExitStack() as stack:
        source = args.checkpoint
        if source is None:
            source = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="saccade-parity-")))
            write_random(source, args)
        inputs = read_inputs(args.inputs) if args.inputs else random_inputs(source, args)
        outputs = {}
        for engine, run_engine in engines(
            source, inputs, args
        ):  # the Rust head first: it refuses bad inputs in plain words
            note(engine)
            outputs[engine] = run_engine()
        note(f"reference in float64: {describe(inputs)}")
        expected = run_reference(source, inputs, args.num_steps, "float64")
    results = [
        Result(engine, Deviation.between(vl_embs, expected[0]), Deviation.between(actions, expected[1]))
        for engine, (vl_embs, actions) in outputs.items()
    ]
    rust = [result for result in results if result.engine.startswith("rust")]
    # How far is too far for a lower precision, the task decides.
    judged = rust if args.precision == "float32" else []
    passed = all(result.actions.max_rel <= args.tolerance for result in judged)
    random = f"random {args.version or DEFAULT_VERSION} {'full size' if args.full else 'small'}"
    report = {
        "head": str(args.checkpoint or random),
        "precision": args.precision,
        "inputs": describe(inputs),
        "machine": cpu_model(),
        "saccade": saccade.__version__,
        "largest_action": float(np.abs(expected[1]).max()),
        "tolerance": args.tolerance,
        "passed": passed,
        "results": [dataclasses.asdict(result) for result in results],
    }
    print(json.dumps(report, indent=1) if args.json else table(report, results))
    return 0 if passed else EXIT_DIFFERENT


def check(args: argparse.Namespace) -> None:
    """Refuses arguments that contradict each other before anything long has run."""
    if args.checkpoint is not None and (args.full or args.bf16 or args.version is not None):
        raise UsageError("--full, --bf16 and --version are about random weights: leave out the checkpoint")
    if args.checkpoint is not None:
        args.checkpoint = resolve(args.checkpoint)
        if not args.checkpoint.exists():
            raise FileNotFoundError(f"{args.checkpoint}: no such checkpoint")
    if args.inputs is not None and not args.inputs.is_file():
        raise FileNotFoundError(f"{args.inputs}: no such file")
    for name in ("batch", "vl_tokens", "num_steps", "threads"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise UsageError(f"--{name.replace('_', '-')} is {value}, expected at least 1")
    if not args.tolerance > 0:
        raise UsageError(f"--tolerance is {args.tolerance}, expected more than 0")


def write_random(folder: Path, args: argparse.Namespace) -> None:
    """A random checkpoint of the size asked for."""
    import torch

    from saccade.reference import random_weights

    version = args.version or DEFAULT_VERSION
    config = random_weights.small_config(version)
    if args.full:
        config = random_weights.sized_config(version, num_embodiments=2)
    note("writing random weights")
    random_weights.write_checkpoint(
        folder, config, args.seed, dtype=torch.bfloat16 if args.bf16 else torch.float32
    )


def random_inputs(source: Path, args: argparse.Namespace) -> dict[str, NDArray[Any]]:
    """Standard normal inputs that fit the checkpoint."""
    from saccade.reference import loading, random_weights

    config = saccade.HeadConfig.from_dict(loading.described(source).head_config)
    if config.mask_mode == "alternate" and args.vl_tokens < 2:
        raise UsageError("--vl-tokens is 1, expected at least 2: this head reads text and images in turn")
    drawn = random_weights.random_inputs(
        config, args.seed + 1, batch=args.batch, num_vl_tokens=args.vl_tokens
    )
    inputs = {name: tensor.numpy() for name, tensor in drawn.items()}
    if args.embodiment_id is not None:
        inputs["embodiment_id"] = np.full(args.batch, args.embodiment_id)
    return inputs


def read_inputs(path: Path) -> dict[str, NDArray[Any]]:
    """Recorded inputs, under their names or with `_in.` before them, with the masks that are there.

    Raises:
        UsageError: one is missing.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        tensors = load_file(path)
    except SafetensorError as error:
        raise UsageError(f"{path}: {error}") from None
    inputs = {}
    for name in INPUTS:
        tensor = tensors.get(name, tensors.get(f"_in.{name}"))
        if tensor is None:
            raise UsageError(f"{path}: no tensor {name}, expected " + ", ".join(INPUTS))
        inputs[name] = (tensor.long() if name == "embodiment_id" else tensor.float()).numpy()
    for name in MASKS:
        mask = tensors.get(name, tensors.get(f"_in.{name}"))
        if mask is not None:
            inputs[name] = mask.numpy()
    return inputs


def engines(
    source: Path, inputs: dict[str, NDArray[Any]], args: argparse.Namespace
) -> Iterator[tuple[str, Callable[[], Outputs]]]:
    """The Rust head on each instruction set, then torch in float32 as a yardstick."""
    for isa in saccade.show_config("dicts")["available_isas"]:
        name = f"rust {isa}" + ("" if args.precision == "float32" else f" {args.precision}")
        yield name, partial(run_rust, source, inputs, args, isa)
    yield "torch float32", partial(run_reference, source, inputs, args.num_steps, "float32")


def run_reference(
    source: Path, inputs: dict[str, NDArray[Any]], num_steps: int | None, dtype: str
) -> Outputs:
    """`vl_embs` and actions of the reference; its weights are gone when this returns."""
    import torch

    from saccade.reference import ActionHead

    kind: torch.dtype = getattr(torch, dtype)
    head = ActionHead.load(source, dtype=kind)
    with torch.no_grad():
        vl_embs = head.encode(inputs["backbone_features"])
        rest: dict[str, Any] = {name: array for name, array in inputs.items() if name != "backbone_features"}
        actions = head.sample(vl_embs, **rest, num_steps=num_steps)
    return vl_embs.numpy(), actions.numpy()


def run_rust(source: Path, inputs: dict[str, NDArray[Any]], args: argparse.Namespace, isa: str) -> Outputs:
    """`vl_embs` and actions of the Rust head on one instruction set."""
    from saccade.reference import loading

    with forced_isa(isa):
        head = saccade.ActionHead.load(
            source,
            config=loading.described(source).head_config,
            precision=args.precision,
            num_threads=args.threads,
        )
        masks: dict[str, Any] = {name: inputs[name] for name in MASKS if name in inputs}
        context = head.encode(inputs["backbone_features"], **masks)
        actions = head.sample(
            context, inputs["state"], inputs["embodiment_id"], noise=inputs["noise"], num_steps=args.num_steps
        )
    return np.asarray(context.vl_embs), np.asarray(actions)


@contextmanager
def forced_isa(isa: str) -> Iterator[None]:
    """Sets `SACCADE_ISA`, which is read when a head is built, and puts back what was there."""
    before = os.environ.get("SACCADE_ISA")
    os.environ["SACCADE_ISA"] = isa
    try:
        yield
    finally:
        if before is None:
            del os.environ["SACCADE_ISA"]
        else:
            os.environ["SACCADE_ISA"] = before


def describe(inputs: dict[str, NDArray[Any]]) -> str:
    """The sizes of the inputs, in words."""
    batch, num_vl_tokens, _ = inputs["backbone_features"].shape
    return f"batch {batch}, {num_vl_tokens} vision-language tokens, horizon {inputs['noise'].shape[1]}"


def cpu_model() -> str:
    """The processor's name as the system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )


def note(message: str) -> None:
    """Progress, beside the result."""
    print(f"parity: {message} ...", file=sys.stderr, flush=True)


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
        verdict = "no tolerance is set for a precision below float32: see docs/precision.md"
    lines += ["", f"rel is |error| / max(1, |value|); {verdict}"]
    return "\n".join(lines)
