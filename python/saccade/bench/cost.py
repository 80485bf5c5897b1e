"""What a call must take at least on this machine, and what it is expected to take.

The floor of a part is the longer of two times: its multiply-adds at the CPU's peak in the arithmetic that it
runs in, and its weights at the rate at which memory can be read. The cost model divides the peak by how much
of it the kernels reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from saccade import _saccade
from saccade.bench.work import ATTENTION, Call, Work, Works, encode_work, sample_work
from saccade.config import HeadConfig

PRECISIONS = ("float32", "bfloat16", "int8")

#: Bytes of a weight, or of a held key or value, in memory. A float32 head keeps weights that are stored as
#: bfloat16 so: floors are then too high where reading sets them, as it may where only action rows run.
ELEMENT_BYTES = {"float32": 4, "bfloat16": 2, "int8": 1}

#: What an int8 head runs in bfloat16: a hundredth of the work.
NOT_INT8 = (*ATTENTION, "embodiment", "output")


@dataclass(frozen=True)
class Machine:
    """What a CPU can do at most, as measured on it.

    Attributes:
        isa: the instruction set.
        num_threads: that all rates are for.
        macs_per_second: multiply-adds, by arithmetic.
        read_bytes_per_second: from memory.
        clock_hz: cycles a second, if that is known.
    """

    isa: str
    num_threads: int
    macs_per_second: Mapping[str, float]
    read_bytes_per_second: float
    clock_hz: float | None = None

    @classmethod
    def measured(cls, isa: str, num_threads: int) -> Machine:
        """This machine now; takes about a second."""
        peaks = _saccade.measure_peaks(num_threads)
        return cls(
            isa,
            num_threads,
            peaks["macs_per_second"][isa],
            peaks["read_bytes_per_second"],
            peaks["clock_hz"],
        )


@dataclass(frozen=True)
class Efficiency:
    """Which share of its floor each kind of part reaches, and what comes on top.

    Attributes:
        few_rows: linear layers over up to 96 rows, whose weights come from memory.
        many_rows: linear layers over more.
        attention: scores, softmax and the sum of values.
        rest: time of everything else (norms, packing, copies, activations, waking threads) as a share of
            these three together.
    """

    few_rows: float
    many_rows: float
    attention: float
    rest: float


#: Measured by `saccade bench --size n1.5 --profile --threads 2` on a 2-core Zen 4 (AVX-512, its bfloat16 and
#: int8 dot products; 114, 227, 450 GMAC/s, 32 GB/s), T_vl 296, medians of 5; good to some 10 % there.
EFFICIENCY = {
    "float32": Efficiency(few_rows=0.88, many_rows=0.86, attention=0.45, rest=0.02),
    "bfloat16": Efficiency(few_rows=0.88, many_rows=0.88, attention=0.45, rest=0.04),
    "int8": Efficiency(few_rows=0.84, many_rows=0.88, attention=0.45, rest=0.07),
}


def arithmetic(part: str, precision: str) -> str:
    """The arithmetic that a part runs in at this precision of the head."""
    return "bfloat16" if precision == "int8" and part in NOT_INT8 else precision


def floor(machine: Machine, runs_in: str, multiply_adds: float, num_bytes: float) -> float:
    """Seconds below which this work cannot be done."""
    return max(
        multiply_adds / machine.macs_per_second[runs_in],
        num_bytes / machine.read_bytes_per_second,
    )


def floor_of(machine: Machine, precision: str, part: str, work: Work) -> float:
    """`floor` of one part of the head."""
    runs_in = arithmetic(part, precision)
    return floor(machine, runs_in, work.multiply_adds, work.elements * ELEMENT_BYTES[runs_in])


def floors(machine: Machine, precision: str, works: Works) -> dict[str, float]:
    """By part, in seconds."""
    return {part: floor_of(machine, precision, part, work) for part, work in works.items()}


def predict(config: HeadConfig, call: Call, precision: str, machine: Machine) -> dict[str, float]:
    """Seconds that `encode` and `sample` are expected to take.

    Args:
        config: the head's.
        call: what is asked of it.
        precision: its.
        machine: where it runs, measured there.

    Returns:
        `{"encode": seconds, "sample": seconds}`.
    """
    reached = EFFICIENCY[precision]
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
    """Which share of its floor a part reaches."""
    if part in ATTENTION:
        return reached.attention
    rows = work.multiply_adds / work.elements  # the mean over its products, weighted by their weights
    return reached.few_rows if rows <= 96 else reached.many_rows
