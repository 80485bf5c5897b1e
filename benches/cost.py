"""The cost model: the time that a call of a head is expected to take on a machine.

    python -m benches.cost --version n1.5     measured and expected times for other N, T_vl, steps, samples

The floor of a part is the longer of two times: its multiply-adds at the CPU's peak rate in the arithmetic of
the part, and reading its weights at the memory's bandwidth. The expected time divides the floor by the share
of it that the kernels reach, as measured on a Zen 5, and on Xeons with AMX and without.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from benches.work import ATTENTION, Work, Works, encode_work, sample_work
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade_lab.cli import bench
from saccade_lab.timing import Call, Machine, arithmetic_of, by_turns, works_of

#: Bytes of a weight, or of a cached key or value, in memory. A float32 head keeps weights that are stored as
#: bfloat16 in bfloat16. Floors that reading sets are then too high, which may happen where only action rows
#: are computed.
ELEMENT_BYTES = {"float32": 4, "bfloat16": 2, "int8": 1}

#: What :func:`main` varies, one size at a time.
VARIED: dict[str, tuple[int, ...]] = {
    "num_future_tokens": (0, 32, 64),
    "num_vl_tokens": (64, 296, 559, 822),
    "num_steps": (1, 2, 4, 8),
    "num_samples": (1, 4, 8),
    "future_refresh": (1, 2, 4),
}


@dataclass(frozen=True)
class Efficiency:
    """The share of its floor that each kind of part reaches, and the time of everything else.

    Attributes:
        few_rows: Linear layers over up to 96 rows, whose weights come from memory.
        many_rows: Linear layers over more rows.
        attention: Scores, softmax and the weighted sum of values.
        rest: Time of everything else (norms, packing, copies, activations, waking threads), relative to the
            time of these three.
    """

    few_rows: float
    many_rows: float
    attention: float
    rest: float


@dataclass(frozen=True)
class Measured:
    """What one CPU reaches.

    Attributes:
        cpu: For sentences: "efficiency as on ...".
        efficiency: By precision of the head.
    """

    cpu: str
    efficiency: Mapping[str, Efficiency]


#: By `saccade bench --version n1.5 --profile --num-threads 2` on 2 cores (AVX-512 with its bfloat16 and int8
#: dot products; 248, 468, 1000 GMAC/s, 47 GB/s), T_vl 296, medians of 5, float32 of 3. The record
#: `benches/peers/results/zen-5.json` is within 15 % of the expected times, with AVX2 too.
ZEN_5 = Measured(
    "a Zen 5 with AVX-512",
    {
        "float32": Efficiency(few_rows=0.91, many_rows=0.92, attention=0.45, rest=0.015),
        "bfloat16": Efficiency(few_rows=0.965, many_rows=0.99, attention=0.42, rest=0.02),
        "int8": Efficiency(few_rows=0.83, many_rows=0.89, attention=0.51, rest=0.03),
    },
)

#: Measured on 2 cores of a Xeon without AMX, whose record is no longer in the repository. The rows with AVX2
#: of `benches/peers/results/genuineintel-family-6-model-167.json` are within 15 % of the expected times.
XEON = Measured(
    "a Xeon without AMX",
    {
        "float32": Efficiency(few_rows=0.82, many_rows=0.85, attention=0.46, rest=0.01),
        "bfloat16": Efficiency(few_rows=0.81, many_rows=0.83, attention=0.47, rest=0.015),
        "int8": Efficiency(few_rows=0.76, many_rows=0.85, attention=0.485, rest=0.04),
    },
)
#: Beginnings of the names of families that count as that Xeon where AMX is not used.
XEONS = ("Sapphire Rapids", "Emerald Rapids", "Granite Rapids", "GenuineIntel")

#: From `benches/peers/results/genuineintel-family-6-model-167.json`: 2 cores, T_vl 296, 71, 48 and 39 % of
#: the floor of the whole head. The record has the times of `encode` (many rows) and `sample` (few rows) but
#: no parts, so attention has the share of many rows in its arithmetic, and the rest is in all shares.
XEON_AMX = Measured(
    "a Xeon with AMX",
    {
        "float32": Efficiency(few_rows=0.67, many_rows=0.75, attention=0.75, rest=0.0),
        "bfloat16": Efficiency(few_rows=0.66, many_rows=0.22, attention=0.22, rest=0.0),
        "int8": Efficiency(few_rows=0.52, many_rows=0.19, attention=0.22, rest=0.0),
    },
)


def measured_like(machine: Machine) -> Measured:
    """The measured CPU that is nearest to a machine. Those that were not measured count as a Zen 5."""
    if machine.isa == "amx":
        return XEON_AMX
    return XEON if machine.family.startswith(XEONS) else ZEN_5


def floor_of(machine: Machine, precision: str, part: str, work: Work) -> float:
    """The least time of one part of a call, in seconds."""
    arithmetic = arithmetic_of(part, precision)
    return machine.floor(arithmetic, work.multiply_adds, work.elements * ELEMENT_BYTES[arithmetic])


def floors(machine: Machine, precision: str, works: Works) -> dict[str, float]:
    """The least time of every part of a call, in seconds."""
    return {part: floor_of(machine, precision, part, work) for part, work in works.items()}


def predict(config: HeadConfig, call: Call, precision: str, machine: Machine) -> dict[str, float]:
    """Seconds that `encode` and `sample` are expected to take.

    Args:
        config: Config of the head.
        call: Its sizes.
        precision: Precision of the head.
        machine: The machine that it runs on.

    Returns:
        `{"encode": seconds, "sample": seconds}`.
    """
    reached = measured_like(machine).efficiency[precision]
    works = {"encode": encode_work(config, call), "sample": sample_work(config, call)}
    return {
        name: (1 + reached.rest)
        * sum(
            floor_of(machine, precision, part, work) / share(reached, part, work)
            for part, work in parts.items()
        )
        for name, parts in works.items()
    }


def share(reached: Efficiency, part: str, work: Work) -> float:
    """The share of its floor that a part reaches."""
    if part in ATTENTION:
        return reached.attention
    rows = work.multiply_adds / work.elements  # the mean over its products, weighted by their weights
    return reached.few_rows if rows <= 96 else reached.many_rows


def compared(
    heads: Mapping[str, ActionHead], call: Call, machine: Machine, rounds: int
) -> list[dict[str, Any]]:
    """Median and expected times; one size is changed at a time."""
    records = []
    for varied, values in VARIED.items():
        for value in values:
            bench.note(f"{varied} {value}")
            changed = replace(call, **{varied: value})
            calls: dict[tuple[str, str], Callable[[], Any]] = {}
            for precision, head in heads.items():
                works = works_of(head, changed)
                calls |= {(precision, name): works[name] for name in ("encode", "sample")}
            for (precision, name), seconds in by_turns(calls, rounds).items():
                expected = predict(heads[precision].config, changed, precision, machine)[name]
                records.append(
                    {
                        "varied": varied,
                        "value": value,
                        "precision": precision,
                        "call": name,
                        "seconds": statistics.median(seconds),
                        "expected_seconds": expected,
                    }
                )
    return records


def table(records: list[dict[str, Any]]) -> list[str]:
    """Measured and expected times, as text."""
    lines = [
        "one size changed at a time, ms",
        f"{'':<24}{'precision':<12}{'call':<8}{'measured':>10}{'expected':>10}{'ratio':>8}",
    ]
    for record in records:
        name = f"{record['varied']} {record['value']}"
        seconds, expected = 1e3 * record["seconds"], 1e3 * record["expected_seconds"]
        lines.append(
            f"{name:<24}{record['precision']:<12}{record['call']:<8}"
            f"{seconds:>10.2f}{expected:>10.2f}{seconds / expected:>8.2f}"
        )
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Measures and prints; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benches.cost", description="Tests the cost model.")
    bench.add_head_arguments(parser)
    args = parser.parse_args(arguments)
    heads, name, call = bench.prepared(args)
    machine = bench.measured(heads)
    print(f"{name}; efficiency as on {measured_like(machine).cpu}")
    print("\n".join(table(compared(heads, call, machine, args.rounds))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
