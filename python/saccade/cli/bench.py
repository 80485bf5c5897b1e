"""`saccade bench`: times the action head and compares it with the limits of this machine."""

from __future__ import annotations

import argparse
import contextlib
import importlib.resources
import statistics
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import saccade
from saccade._internal import flags as arguments
from saccade._internal.extras import SACCADE
from saccade._internal.flags import UsageError
from saccade.bench import heads, roofline
from saccade.bench.cost import (
    PRECISIONS,
    Machine,
    arithmetic,
    floor,
    floors,
    limit,
    measured_like,
    predict,
)
from saccade.bench.timing import Counter, by_turns, pieces, profiled, quartiles
from saccade.bench.work import Call, Works, encode_work, sample_work, total
from saccade.checkpoints.hub import resolve
from saccade.cli import EXIT_OK, _output

HELP = "time the action head and compare it with the limits of this machine"
EPILOG = """\
The floor of a part is the longer of two times: its multiply-adds at the peak rate of their arithmetic, and
reading its weights at the bandwidth of memory. Both peaks are measured in the same run.

examples:
  saccade bench                                  the bundled policy at every precision
  saccade bench --checkpoint checkpoint/ --num-vl-tokens 559
                                                 a checkpoint with two camera views
  saccade bench --version n1.5 --profile         random weights at N1.5's size, time by part
  saccade bench --version n1.5 --cost-model      measured and expected times for other N, T_vl, steps, samples
  saccade bench --version n1.5 --roofline        which part is bound by multiply-adds, and which by memory
  saccade bench --precisions int8 --future-refresh 4 --json
"""
#: What `--cost-model` varies, one size at a time.
VARIED: dict[str, tuple[int, ...]] = {
    "num_future_tokens": (0, 32, 64),
    "num_vl_tokens": (64, 296, 559, 822),
    "num_steps": (1, 2, 4, 8),
    "num_samples": (1, 4, 8),
    "future_refresh": (1, 2, 4),
}
DEFAULT_VL_TOKENS = 296  # one camera view of N1.5
INSTRUCTION = "open the drawer"  # of the prompt whose tokens are counted
FRAME_SIZE = 224  # of cameras whose size the checkpoint does not say

note = partial(_output.note, "bench")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    arguments.add_checkpoint(
        parser, "directory, .safetensors file or published id (default: the bundled policy)"
    )
    parser.add_argument(
        "--version",
        choices=heads.SIZES,
        help="random weights at the size of this version instead (n1.5: 1.5 GB of disk, n1.6 2.2, n1.7 2.6)",
    )
    arguments.add_list(
        parser,
        "--precisions",
        default=PRECISIONS,
        help=f"precisions, of {', '.join(PRECISIONS)} (default: all)",
    )
    arguments.add_num_threads(parser)
    arguments.add_num_vl_tokens(
        parser,
        None,
        f"vision-language tokens (default: a prompt's, else {DEFAULT_VL_TOKENS})",
    )
    arguments.add_num_steps(parser)
    arguments.add_integer(parser, "--num-samples", default=1, help="chunks per observation")
    arguments.add_integer(parser, "--future-refresh", default=1, help="as in ActionHead.sample; 1 is exact")
    arguments.add_integer(parser, "--rounds", default=7, help="measurements of each time")
    parser.add_argument("--profile", action="store_true", help="time by part, with the part's floor")
    parser.add_argument(
        "--roofline", action="store_true", help="what each part reaches of its limits, as a picture in text"
    )
    parser.add_argument(
        "--figure",
        type=Path,
        metavar="FILE",
        help="the same as an image, whose format its name tells (needs matplotlib)",
    )
    parser.add_argument(
        "--cost-model", action="store_true", help="measured times and those that the cost model expects"
    )
    arguments.add_json(parser, "print JSON instead of tables")


def run(args: argparse.Namespace) -> int:
    """Measures and prints."""
    check(args)
    with ExitStack() as stack:
        source, name = stack.enter_context(head_source(args))
        loaded = {}
        for precision in args.precisions:
            note(f"loading {name} in {precision}")
            loaded[precision] = saccade.ActionHead.from_pretrained(
                source, precision=precision, num_threads=args.num_threads
            )
        report = measure(loaded, name, args, args.num_vl_tokens or default_vl_tokens(source))
    if args.json:
        _output.print_json(report, indent=1)
    else:
        print(tables(report))
    return EXIT_OK


def check(args: argparse.Namespace) -> None:
    """Refuses arguments that contradict each other before anything long has run."""
    if args.figure is not None:
        SACCADE.require("matplotlib")
        if not args.figure.parent.is_dir():
            raise FileNotFoundError(f"{args.figure.parent}: no such directory")
    if args.checkpoint is not None and args.version is not None:
        raise UsageError("--version describes random weights: leave out --checkpoint")
    arguments.check_known("--precisions", args.precisions, PRECISIONS)
    if args.checkpoint is not None:
        args.checkpoint = resolve(args.checkpoint)
        if not args.checkpoint.exists():
            raise FileNotFoundError(f"{args.checkpoint}: no such checkpoint")


def measure(
    loaded: dict[str, saccade.ActionHead], name: str, args: argparse.Namespace, num_vl_tokens: int
) -> dict[str, Any]:
    """All that the arguments ask for, as a dict for JSON."""
    head = next(iter(loaded.values()))
    call = Call.of(
        head.config,
        num_vl_tokens,
        args.num_steps,
        num_samples=args.num_samples,
        future_refresh=args.future_refresh,
    )
    note("measuring the machine's peak rates")
    machine = Machine.measured(head.isa, head.num_threads)
    report = {
        "saccade": saccade.__version__,
        "head": name,
        "machine": asdict(machine),
        "efficiency_of": measured_like(machine).cpu,
        "call": asdict(call),
        "rounds": args.rounds,
        "results": timed(loaded, call, machine, args.rounds),
    }
    if args.profile or args.roofline or args.figure:
        report["profile"] = [
            profile(loaded[precision], precision, piece, call, machine, args.rounds)
            for precision in loaded
            for piece in ("encode", "sample")
        ]
    if args.roofline or args.figure:
        shown = rooflines(machine, report["profile"])
        report["roofline"] = {title: [asdict(point) for point in parts] for title, parts in shown.items()}
        if args.figure:
            roofline.write_figure(machine, shown, args.figure)
            note(f"wrote {args.figure}")
    if args.cost_model:
        report["model"] = modelled(loaded, call, machine, args.rounds)
    return report


def rooflines(machine: Machine, profiles: list[dict[str, Any]]) -> dict[str, list[roofline.Point]]:
    """The points of each profile, by its precision and piece."""
    return {
        f"{one['precision']} {one['piece']}": roofline.points(machine, one["precision"], one["parts"])
        for one in profiles
    }


@contextlib.contextmanager
def head_source(args: argparse.Namespace) -> Iterator[tuple[Path, str]]:
    """The checkpoint to load, and its name in the report."""
    if args.checkpoint is not None:
        yield args.checkpoint, str(args.checkpoint)
    elif args.version is not None:
        with tempfile.TemporaryDirectory(prefix="saccade-bench-") as folder:
            note("writing random weights")
            heads.write(Path(folder), heads.sized(args.version))
            yield Path(folder), f"random weights, size {args.version}"
    else:
        with importlib.resources.as_file(saccade.demo_checkpoint()) as demo:
            yield demo, "the bundled policy"


def default_vl_tokens(source: Path) -> int:
    """T_vl of a prompt with a frame of each camera, if the checkpoint is whole and of one robot."""
    from saccade.checkpoints.whole import robots_of
    from saccade.errors import SaccadeError
    from saccade.processor import Processor

    robots = robots_of(source, state_history=1) if source.is_dir() else []
    needs = robots[0].needs if len(robots) == 1 else None
    cameras = None if needs is None else needs.cameras
    if cameras is None:
        return DEFAULT_VL_TOKENS
    sizes = [(camera.height or FRAME_SIZE, camera.width or FRAME_SIZE) for camera in cameras]
    try:
        inputs = Processor.from_pretrained(source)(
            [np.zeros((*size, 3), np.uint8) for size in sizes], INSTRUCTION
        )
    except (SaccadeError, FileNotFoundError):
        return DEFAULT_VL_TOKENS
    return int(inputs.input_ids.shape[1])


def options(call: Call) -> dict[str, int | None]:
    """The call as keyword arguments of `pieces`."""
    return {
        "num_steps": call.num_steps,
        "num_samples": call.num_samples,
        "future_refresh": call.future_refresh,
        "num_future_tokens": call.num_future_tokens,
        "num_image_tokens": call.num_image_tokens,
    }


def works_of(head: saccade.ActionHead, call: Call) -> dict[str, list[Works]]:
    """The work of each of `PIECES`."""
    encode, sample = encode_work(head.config, call), sample_work(head.config, call)
    return {"encode": [encode], "sample": [sample], "both": [encode, sample]}


def timed(
    loaded: dict[str, saccade.ActionHead], call: Call, machine: Machine, rounds: int
) -> list[dict[str, Any]]:
    """Times every piece of work in every precision, in turn."""
    calls: dict[tuple[str, str], Callable[[], Any]] = {}
    for precision, head in loaded.items():
        for piece, work in pieces(head, call.num_vl_tokens, **options(call)).items():
            calls[precision, piece] = work
    seconds = by_turns(calls, rounds, lambda done: note(f"round {done} of {rounds}"))
    records = []
    for (precision, piece), values in seconds.items():
        head = loaded[precision]
        works = works_of(head, call)[piece]
        least = sum(sum(floors(machine, precision, each).values()) for each in works)
        expected = predict(head.config, call, precision, machine)
        median = statistics.median(values)
        records.append(
            {
                "precision": precision,
                "piece": piece,
                "seconds": values,
                "quartiles": list(quartiles(values)),
                "multiply_adds": sum(total(each).multiply_adds for each in works),
                "floor_seconds": least,
                "share": least / median,
                "expected_seconds": sum(expected.values()) if piece == "both" else expected[piece],
            }
        )
    return records


def profile(
    head: saccade.ActionHead, precision: str, piece: str, call: Call, machine: Machine, rounds: int
) -> dict[str, Any]:
    """The time of each part in the run of median length."""
    note(f"profile of {piece} in {precision}")
    work = pieces(head, call.num_vl_tokens, **options(call))[piece]
    runs = sorted((profiled(work) for _ in range(rounds)), key=lambda one: one[0])
    seconds, counters = runs[len(runs) // 2]

    def part(name: str, counter: Counter) -> dict[str, Any]:
        least = floor(machine, arithmetic(name, precision), counter.multiply_adds, counter.num_bytes)
        return {
            "part": name,
            "calls": counter.calls,
            "seconds": counter.seconds,
            "multiply_adds": counter.multiply_adds,
            "bytes": counter.num_bytes,
            "floor_seconds": least,
            "limit": limit(machine, arithmetic(name, precision), counter.multiply_adds, counter.num_bytes),
            "share": least / counter.seconds if counter.multiply_adds else None,
        }

    return {
        "precision": precision,
        "piece": piece,
        "seconds": seconds,
        "parts": [part(name, counter) for name, counter in counters.items()],
        "other_seconds": seconds - sum(counter.seconds for counter in counters.values()),
    }


def modelled(
    loaded: dict[str, saccade.ActionHead], call: Call, machine: Machine, rounds: int
) -> list[dict[str, Any]]:
    """Median times and those that the cost model expects; one size is changed at a time."""
    records = []
    for varied, values in VARIED.items():
        for value in values:
            note(f"{varied} {value}")
            changed = replace(call, **{varied: value})
            calls: dict[tuple[str, str], Callable[[], Any]] = {}
            for precision, head in loaded.items():
                made = pieces(head, changed.num_vl_tokens, **options(changed))
                calls |= {(precision, piece): made[piece] for piece in ("encode", "sample")}
            for (precision, piece), seconds in by_turns(calls, rounds).items():
                expected = predict(loaded[precision].config, changed, precision, machine)[piece]
                median = statistics.median(seconds)
                records.append(
                    {
                        "varied": varied,
                        "value": value,
                        "precision": precision,
                        "piece": piece,
                        "seconds": median,
                        "expected_seconds": expected,
                        "ratio": median / expected,
                    }
                )
    return records


def tables(report: dict[str, Any]) -> str:
    """The report as text; times in milliseconds."""
    machine, call = report["machine"], report["call"]
    peaks = ", ".join(f"{name} {rate / 1e9:.0f}" for name, rate in machine["macs_per_second"].items())
    lines = [
        f"head      {report['head']}",
        f"call      T_vl {call['num_vl_tokens']}, N {call['num_future_tokens']}, {call['num_steps']} steps, "
        f"{call['num_samples']} samples, future_refresh {call['future_refresh']}",
        f"machine   {machine['isa']}, {machine['num_threads']} threads; peak GMAC/s {peaks}; "
        f"read {machine['read_bytes_per_second'] / 1e9:.1f} GB/s ({reading(machine)}); "
        f"saccade {report['saccade']}",
        f"model     expected times, efficiency as on {report['efficiency_of']}",
        "",
        f"median (quartiles) of {report['rounds']} rounds, ms",
        f"{'':<20}{'time':>9}{'quartiles':>20}{'GMAC':>9}{'floor':>9}{'of it':>8}{'model':>9}",
    ]
    for record in report["results"]:
        low, median, high = (1e3 * value for value in record["quartiles"])
        expected, least = 1e3 * record["expected_seconds"], 1e3 * record["floor_seconds"]
        name, gmac = f"{record['precision']} {record['piece']}", record["multiply_adds"] / 1e9
        spread = f"({low:.2f}, {high:.2f})"
        lines.append(
            f"{name:<20}{median:>9.2f}{spread:>20}{gmac:>9.3f}{least:>9.2f}{record['share']:>8.0%}{expected:>9.2f}"
        )
    for one in report.get("profile", []):
        lines += profile_table(one)
    for title, parts in report.get("roofline", {}).items():
        lines += ["", f"{title}, roofline", ""]
        lines += roofline.text(Machine(**machine), [roofline.Point(**point) for point in parts])
    if "model" in report:
        lines += model_table(report["model"])
    return "\n".join(lines)


def reading(machine: dict[str, Any]) -> str:
    """The bandwidth by the number of streams, as text."""
    rates = machine["read_by_streams"].items()
    return ", ".join(f"{rate / 1e9:.1f} as {streams}" for streams, rate in rates) + " streams"


def profile_table(one: dict[str, Any]) -> list[str]:
    """The times of one piece of work by part, as text."""
    whole = one["seconds"]
    lines = [
        "",
        f"{one['precision']} {one['piece']}, by part",
        f"{'':<20}{'calls':>7}{'ms':>10}{'of all':>8}{'GMAC':>9}{'MB read':>10}{'floor':>9}"
        f"{'of it':>8}  limit",
    ]
    for part in one["parts"]:
        seconds, least = part["seconds"], 1e3 * part["floor_seconds"]
        gmac, megabytes = part["multiply_adds"] / 1e9, part["bytes"] / 1e6
        reached = "" if part["share"] is None else f"{part['share']:.0%}"
        bound = "" if part["share"] is None else f"  {part['limit']}"
        lines.append(
            f"{part['part']:<20}{part['calls']:>7}{1e3 * seconds:>10.3f}{seconds / whole:>8.1%}"
            f"{gmac:>9.3f}{megabytes:>10.1f}{least:>9.3f}{reached:>8}{bound}"
        )
    other = one["other_seconds"]
    lines.append(f"{'other':<20}{'':>7}{1e3 * other:>10.3f}{other / whole:>8.1%}")
    lines.append(f"{'all':<20}{'':>7}{1e3 * whole:>10.3f}")
    return lines


def model_table(records: list[dict[str, Any]]) -> list[str]:
    """Measured and expected times, as text."""
    lines = [
        "",
        "one size changed at a time, ms",
        f"{'':<24}{'precision':<12}{'piece':<8}{'measured':>10}{'model':>10}{'ratio':>8}",
    ]
    for record in records:
        name = f"{record['varied']} {record['value']}"
        seconds, expected = 1e3 * record["seconds"], 1e3 * record["expected_seconds"]
        lines.append(
            f"{name:<24}{record['precision']:<12}{record['piece']:<8}"
            f"{seconds:>10.2f}{expected:>10.2f}{record['ratio']:>8.2f}"
        )
    return lines
