"""Times an action head, and computes the least time that its work can take on this machine."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import saccade._saccade as _saccade
from saccade.head.config import HeadConfig
from saccade.head.context import Context
from saccade.head.head import ActionHead
from saccade.head.intervention import Intervention
from saccade_lab.head_inputs import HeadInputs

#: The timed calls: encoding an observation, sampling a chunk from its context, and both.
WORKS = ("encode", "sample", "both")

#: The parts that an int8 or int4 head computes in bfloat16, a hundredth of the work.
NOT_INT8 = ("attention", "embodiment", "output")


@dataclass(frozen=True)
class Machine:
    """The measured peak rates of a CPU.

    Attributes:
        isa: The instruction set.
        num_threads: Threads that the rates are for.
        macs_per_second: Multiply-adds per second, by arithmetic.
        read_bytes_per_second: Bandwidth of reading memory, with the fastest number of streams.
        clock_hz: Clock rate, if it is known.
        read_by_streams: Bandwidth by the number of streams that each thread reads.
        family: Name of the CPU's family, such as ``Zen 5``; ``unknown family``, or the architecture where
            there is no CPUID.
        kernels: Names of the kernels of linear layers, by arithmetic, such as ``avx512-vnni-int8``.
    """

    isa: str
    num_threads: int
    macs_per_second: Mapping[str, float]
    read_bytes_per_second: float
    clock_hz: float | None = None
    read_by_streams: Mapping[int, float] = field(default_factory=dict)
    family: str = ""
    kernels: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def measured(cls, isa: str, num_threads: int) -> Machine:
        """Measures this machine; takes about a second."""
        peaks = _saccade.measure_peaks(num_threads)
        return cls(
            isa,
            num_threads,
            peaks["macs_per_second"][isa],
            peaks["read_bytes_per_second"],
            peaks["clock_hz"],
            peaks["read_bytes_per_second_by_streams"],
            _saccade.cpu_report()[0].partition(" (")[0],
            peaks["kernels"][isa],
        )

    def floor(self, arithmetic: str, multiply_adds: float, num_bytes: float) -> float:
        """The least time of some work in seconds: its multiply-adds, or reading its bytes, if that is longer.

        Args:
            arithmetic: A key of ``macs_per_second``.
            multiply_adds: Number of multiply-adds.
            num_bytes: Bytes that are read from memory.
        """
        return max(
            multiply_adds / self.macs_per_second[arithmetic],
            num_bytes / self.read_bytes_per_second,
        )

    def limit(self, arithmetic: str, multiply_adds: float, num_bytes: float) -> str:
        """What sets :meth:`floor`: ``"arithmetic"`` or ``"memory"``."""
        computing = multiply_adds / self.macs_per_second[arithmetic]
        return "arithmetic" if computing >= num_bytes / self.read_bytes_per_second else "memory"


@dataclass(frozen=True)
class Call:
    """The sizes of one call of a head: encode an observation, then sample from it.

    Attributes:
        num_vl_tokens: T_vl.
        num_steps: Euler steps.
        batch: Observations.
        num_samples: Chunks of each observation.
        future_refresh: As in :meth:`saccade.ActionHead.sample`; 1 for None.
        num_future_tokens: N, which an intervention may change.
        num_image_tokens: How many of the T_vl tokens are image tokens, for heads whose blocks attend to
            either text or images; None for half of them. The number does not change the work if as many
            blocks attend to text as to images.
    """

    num_vl_tokens: int
    num_steps: int
    batch: int = 1
    num_samples: int = 1
    future_refresh: int = 1
    num_future_tokens: int = 32
    num_image_tokens: int | None = None

    @classmethod
    def of(
        cls,
        config: HeadConfig,
        num_vl_tokens: int,
        num_steps: int | None = None,
        *,
        batch: int = 1,
        num_samples: int = 1,
        future_refresh: int = 1,
        num_future_tokens: int | None = None,
        num_image_tokens: int | None = None,
    ) -> Call:
        """A call; steps and future tokens default to those of the config."""
        return cls(
            num_vl_tokens,
            config.num_steps if num_steps is None else num_steps,
            batch,
            num_samples,
            future_refresh,
            config.num_future_tokens if num_future_tokens is None else num_future_tokens,
            num_image_tokens,
        )

    @property
    def image_tokens(self) -> int:
        """The number of image tokens, which come first."""
        return self.num_vl_tokens // 2 if self.num_image_tokens is None else self.num_image_tokens


@dataclass(frozen=True)
class Counter:
    """What one part did in a run: its calls, their time, multiply-adds and bytes of weights read.

    ``kernel`` is the kernel of its linear layers; empty for other parts.
    """

    calls: int
    seconds: float
    multiply_adds: int
    num_bytes: int
    kernel: str = ""

    def floor(self, machine: Machine, arithmetic: str) -> float:
        """The least time of the part on a machine, in seconds."""
        return machine.floor(arithmetic, self.multiply_adds, self.num_bytes)


def arithmetic_of(part: str, precision: str) -> str:
    """The arithmetic of a part in a head of this precision."""
    return "bfloat16" if precision in ("int8", "int4") and part in NOT_INT8 else precision


def works_of(head: ActionHead, call: Call) -> dict[str, Callable[[], Any]]:
    """The calls of :data:`WORKS` on random observations; each has been made once."""
    config = head.config
    rng = np.random.default_rng(0)
    drawn = HeadInputs.random(config, call.num_vl_tokens, rng, head.embodiment_ids[0])
    images = np.arange(call.num_vl_tokens)[None] < call.image_tokens
    observation = replace(drawn, noise=None, image_mask=images).repeated(call.batch)
    observation = observation.with_noise(rng, config, call.num_samples)
    interventions = []
    if call.num_future_tokens != config.num_future_tokens:
        tokens = rng.standard_normal((call.num_future_tokens, config.width), np.float32)
        interventions = [Intervention(future_tokens=tokens)]

    def encode() -> Context:
        return observation.encode(head)

    def sample(context: Context) -> Any:
        return observation.sample(
            head,
            context,
            num_steps=call.num_steps,
            future_refresh=call.future_refresh,
            intervention=interventions,
        )

    context = encode()
    sample(context)
    return {"encode": encode, "sample": lambda: sample(context), "both": lambda: sample(encode())}


def by_turns(
    works: Mapping[Any, Callable[[], Any]], rounds: int, note: Callable[[int], None] | None = None
) -> dict[Any, list[float]]:
    """Seconds of each call in each round.

    A round makes every call once, in an order that rotates, so that a drift of the machine's clock affects
    all of them.

    Args:
        works: The calls by name.
        rounds: Number of rounds.
        note: Called with the number of rounds done, after each of them.
    """
    names = list(works)
    seconds: dict[Any, list[float]] = {name: [] for name in names}
    for index in range(rounds):
        turn = index % len(names)
        for name in names[turn:] + names[:turn]:
            start = time.perf_counter()
            works[name]()
            seconds[name].append(time.perf_counter() - start)
        if note is not None:
            note(index + 1)
    return seconds


def profiled(work: Callable[[], Any]) -> tuple[float, dict[str, Counter]]:
    """Seconds of one run of `work`, and the counters of the parts that were called."""
    with _saccade.profile() as profile:
        start = time.perf_counter()
        work()
        seconds = time.perf_counter() - start
    kernels = profile.kernels()
    counters = {
        part: Counter(*counted, kernels.get(part, "")) for part, counted in profile.counters().items()
    }
    return seconds, {part: counter for part, counter in counters.items() if counter.calls}


def quartiles(values: Iterable[float]) -> tuple[float, float, float]:
    """First quartile, median, third quartile."""
    held = list(values)
    if len(held) == 1:
        return held[0], held[0], held[0]
    first, median, third = statistics.quantiles(held, n=4, method="inclusive")
    return first, median, third
