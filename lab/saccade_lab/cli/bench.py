"""`saccade bench`: times the action head and compares it with the limits of this machine."""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import saccade._saccade as _saccade
from saccade._internal import flags as arguments
from saccade._internal.arrays import PRECISIONS
from saccade._internal.flags import UsageError
from saccade._internal.hub import resolve
from saccade.checkpoints import demo_checkpoint
from saccade.checkpoints.whole import robots_of
from saccade.cli import EXIT_OK, output
from saccade.errors import SaccadeError
from saccade.head.head import ActionHead
from saccade.processor import Processor
from saccade_lab import flags as lab_flags
from saccade_lab.extras import LAB
from saccade_lab.random_checkpoint import head as random_head
from saccade_lab.timing import Call, Counter, Machine, arithmetic_of, by_turns, profiled, quartiles, works_of

EXTRAS = LAB
HELP = "time the head beside the limits of this machine"
EPILOG = """\
The floor of a part is the longer of two times: its multiply-adds at the peak rate of their arithmetic, and
reading its weights at the bandwidth of memory. Both peaks are measured in the same run.

examples:
  saccade bench                                  the bundled policy at every precision
  saccade bench --checkpoint checkpoint/ --num-vl-tokens 559
                                                 a checkpoint with two camera views
  saccade bench --version n1.5 --profile         random weights at N1.5's size, time by part
  saccade bench --precisions int8 --future-refresh 4 --json
"""
DEFAULT_VL_TOKENS = 296  # one camera view of N1.5
INSTRUCTION = "open the drawer"  # of the prompt whose tokens are counted
FRAME_SIZE = 224  # of cameras whose size the checkpoint does not say

note = partial(output.note, "bench")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    add_head_arguments(parser)
    parser.add_argument("--profile", action="store_true", help="time by part, with the part's floor")
    arguments.add_json(parser, "print JSON instead of tables")


def add_head_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares which heads are timed, at which sizes and how often; see :func:`prepared`."""
    lab_flags.add_checkpoint(
        parser, "directory, .safetensors file or published id (default: the bundled policy)"
    )
    parser.add_argument(
        "--version",
        choices=random_head.SIZES,
        help="random weights at the size of this version instead (n1.5: 1.5 GB of disk, n1.6 2.2, n1.7 2.6)",
    )
    arguments.add_list(
        parser,
        "--precisions",
        default=PRECISIONS,
        help=f"precisions, of {', '.join(PRECISIONS)} (default: all)",
    )
    arguments.add_num_threads(parser)
    lab_flags.add_num_vl_tokens(
        parser,
        None,
        f"vision-language tokens (default: a prompt's, else {DEFAULT_VL_TOKENS})",
    )
    arguments.add_num_steps(parser)
    arguments.add_integer(parser, "--num-samples", default=1, help="chunks per observation")
    arguments.add_integer(parser, "--future-refresh", default=1, help="as in ActionHead.sample; 1 is exact")
    arguments.add_integer(parser, "--rounds", default=7, help="measurements of each time")


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    heads, name, call = prepared(args)
    machine = measured(heads)
    report: dict[str, Any] = {
        "saccade": _saccade.__version__,
        "head": name,
        "machine": asdict(machine),
        "call": asdict(call),
        "rounds": args.rounds,
        "results": timed(heads, call, machine, args.rounds),
    }
    if args.profile:
        report["profile"] = profiles(heads, call, machine, args.rounds)
    if args.json:
        output.print_json(report, indent=1)
    else:
        print(tables(report))
    return EXIT_OK


def prepared(args: argparse.Namespace) -> tuple[dict[str, ActionHead], str, Call]:
    """The heads by precision, their name in the report, and the sizes of a call.

    Raises:
        UsageError: The arguments contradict each other.
        InputError: A precision is unknown.
        FileNotFoundError: There is no such checkpoint.
    """
    if args.checkpoint is not None and args.version is not None:
        raise UsageError("--version describes random weights: leave out --checkpoint")
    lab_flags.check_known("--precisions", args.precisions, PRECISIONS)
    with head_source(args) as (source, name):
        heads = {}
        for precision in args.precisions:
            note(f"loading {name} in {precision}")
            heads[precision] = ActionHead.from_pretrained(
                source, precision=precision, num_threads=args.num_threads
            )
        num_vl_tokens = args.num_vl_tokens or default_vl_tokens(source)
    sizes = {"num_samples": args.num_samples, "future_refresh": args.future_refresh}
    config = next(iter(heads.values())).config
    return heads, name, Call.of(config, num_vl_tokens, args.num_steps, **sizes)


@contextmanager
def head_source(args: argparse.Namespace) -> Iterator[tuple[Path, str]]:
    """The checkpoint to load, and its name in the report."""
    if args.checkpoint is not None:
        source = resolve(args.checkpoint)
        if not source.exists():
            raise FileNotFoundError(f"{source}: no such checkpoint")
        yield source, str(source)
    elif args.version is not None:
        with tempfile.TemporaryDirectory(prefix="saccade-bench-") as folder:
            note("writing random weights")
            random_head.write_head(Path(folder), random_head.config_of_size(args.version))
            yield Path(folder), f"random weights, size {args.version}"
    else:
        yield demo_checkpoint(), "the bundled policy"


def default_vl_tokens(source: Path) -> int:
    """T_vl of a prompt with a frame of each camera, if the checkpoint is whole and of one robot."""
    robots = robots_of(source, state_history=1) if source.is_dir() else []
    needs = robots[0].needs if len(robots) == 1 else None
    cameras = None if needs is None else needs.cameras
    if cameras is None:
        return DEFAULT_VL_TOKENS
    sizes = [(camera.height or FRAME_SIZE, camera.width or FRAME_SIZE) for camera in cameras]
    frames = [np.zeros((*size, 3), np.uint8) for size in sizes]
    try:
        inputs = Processor.from_pretrained(source)(frames, INSTRUCTION)
    except (SaccadeError, FileNotFoundError):
        return DEFAULT_VL_TOKENS
    return int(inputs.input_ids.shape[1])


def measured(heads: dict[str, ActionHead]) -> Machine:
    """This machine, with the instruction set and the threads of the heads."""
    note("measuring the machine's peak rates")
    head = next(iter(heads.values()))
    return Machine.measured(head.isa, head.num_threads)


def timed(heads: dict[str, ActionHead], call: Call, machine: Machine, rounds: int) -> list[dict[str, Any]]:
    """Times encoding, sampling and both in every precision, by turns."""
    calls: dict[tuple[str, str], Callable[[], Any]] = {}
    counted: dict[tuple[str, str], tuple[int, float]] = {}
    for precision, head in heads.items():
        works = works_of(head, call)
        calls |= {(precision, name): work for name, work in works.items()}
        (macs, least), (more_macs, more) = (
            work_and_floor(profiled(works[name])[1], precision, machine) for name in ("encode", "sample")
        )
        counted[precision, "encode"], counted[precision, "sample"] = (macs, least), (more_macs, more)
        counted[precision, "both"] = macs + more_macs, least + more
    seconds = by_turns(calls, rounds, lambda done: note(f"round {done} of {rounds}"))
    records = []
    for (precision, name), values in seconds.items():
        multiply_adds, floor = counted[precision, name]
        records.append(
            {
                "precision": precision,
                "call": name,
                "seconds": values,
                "quartiles": list(quartiles(values)),
                "multiply_adds": multiply_adds,
                "floor_seconds": floor,
                "share": floor / statistics.median(values),
            }
        )
    return records


def work_and_floor(counters: dict[str, Counter], precision: str, machine: Machine) -> tuple[int, float]:
    """The multiply-adds of a call, and the sum of the least times of its parts in seconds."""
    products = {part: counter for part, counter in counters.items() if counter.multiply_adds}
    floors = (counter.floor(machine, arithmetic_of(part, precision)) for part, counter in products.items())
    return sum(counter.multiply_adds for counter in products.values()), sum(floors)


def profiles(heads: dict[str, ActionHead], call: Call, machine: Machine, rounds: int) -> list[dict[str, Any]]:
    """The time of each part of encoding and of sampling, in the run of median length, for each precision."""
    records = []
    for precision, head in heads.items():
        works = works_of(head, call)
        for name in ("encode", "sample"):
            note(f"profile of {name} in {precision}")
            runs = sorted((profiled(works[name]) for _ in range(rounds)), key=lambda one: one[0])
            seconds, counters = runs[len(runs) // 2]
            parts = [profile_of(part, counter, precision, machine) for part, counter in counters.items()]
            other = seconds - sum(counter.seconds for counter in counters.values())
            records.append(
                {
                    "precision": precision,
                    "call": name,
                    "seconds": seconds,
                    "parts": parts,
                    "other_seconds": other,
                }
            )
    return records


def profile_of(part: str, counter: Counter, precision: str, machine: Machine) -> dict[str, Any]:
    """What one part did, its floor, and the share of the floor in its time."""
    arithmetic = arithmetic_of(part, precision)
    floor = counter.floor(machine, arithmetic)
    return {
        "part": part,
        "calls": counter.calls,
        "seconds": counter.seconds,
        "multiply_adds": counter.multiply_adds,
        "bytes": counter.num_bytes,
        "floor_seconds": floor,
        "limit": machine.limit(arithmetic, counter.multiply_adds, counter.num_bytes),
        "share": floor / counter.seconds if counter.multiply_adds else None,
        "kernel": counter.kernel,
    }


def tables(report: dict[str, Any]) -> str:
    """The report as text; times in milliseconds."""
    machine, call = report["machine"], report["call"]
    peaks = ", ".join(f"{name} {rate / 1e9:.0f}" for name, rate in machine["macs_per_second"].items())
    streams = machine["read_by_streams"].items()
    reading = ", ".join(f"{rate / 1e9:.1f} as {number}" for number, rate in streams) + " streams"
    lines = [
        f"head      {report['head']}",
        f"call      T_vl {call['num_vl_tokens']}, N {call['num_future_tokens']}, {call['num_steps']} steps, "
        f"{call['num_samples']} samples, future_refresh {call['future_refresh']}",
        f"machine   {machine['isa']}, {machine['num_threads']} threads; peak GMAC/s {peaks}; "
        f"read {machine['read_bytes_per_second'] / 1e9:.1f} GB/s ({reading}); "
        f"saccade {report['saccade']}",
        f"kernels   {', '.join(machine['kernels'].values())}",
        "",
        f"median (quartiles) of {report['rounds']} rounds, ms",
        f"{'':<20}{'time':>9}{'quartiles':>20}{'GMAC':>9}{'floor':>9}{'of it':>8}",
    ]
    for record in report["results"]:
        low, median, high = (1e3 * value for value in record["quartiles"])
        least, gmac = 1e3 * record["floor_seconds"], record["multiply_adds"] / 1e9
        name, spread = f"{record['precision']} {record['call']}", f"({low:.2f}, {high:.2f})"
        lines.append(f"{name:<20}{median:>9.2f}{spread:>20}{gmac:>9.3f}{least:>9.2f}{record['share']:>8.0%}")
    for one in report.get("profile", []):
        lines += profile_table(one)
    return "\n".join(lines)


def profile_table(one: dict[str, Any]) -> list[str]:
    """The times of encoding or of sampling by part, as text."""
    whole = one["seconds"]
    lines = [
        "",
        f"{one['precision']} {one['call']}, by part",
        f"{'':<20}{'calls':>7}{'ms':>10}{'of all':>8}{'GMAC':>9}{'MB read':>10}{'floor':>9}"
        f"{'of it':>8}  {'limit':<12}kernel",
    ]
    for part in one["parts"]:
        seconds, least = part["seconds"], 1e3 * part["floor_seconds"]
        gmac, megabytes = part["multiply_adds"] / 1e9, part["bytes"] / 1e6
        reached = "" if part["share"] is None else f"{part['share']:.0%}"
        bound = "" if part["share"] is None else f"  {part['limit']:<12}{part['kernel']}".rstrip()
        lines.append(
            f"{part['part']:<20}{part['calls']:>7}{1e3 * seconds:>10.3f}{seconds / whole:>8.1%}"
            f"{gmac:>9.3f}{megabytes:>10.1f}{least:>9.3f}{reached:>8}{bound}"
        )
    other = one["other_seconds"]
    lines.append(f"{'other':<20}{'':>7}{1e3 * other:>10.3f}{other / whole:>8.1%}")
    lines.append(f"{'all':<20}{'':>7}{1e3 * whole:>10.3f}")
    return lines
