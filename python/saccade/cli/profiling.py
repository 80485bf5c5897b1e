"""`saccade act --profile`: where the time from frames to a chunk goes, over repeated calls."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import saccade._saccade as _saccade
from saccade.cli.output import Section
from saccade.policy.encoding import encode_observations
from saccade.policy.preparing import prepare_inputs
from saccade.policy.reading import read_observations
from saccade.policy.sampling import Sampling, sample_from, start_of_batch
from saccade.policy.units import restore_units

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

#: Calls that are timed: at least so many, and until so many seconds are spent.
CALLS, SECONDS = 5, 2.0

#: The parts in the order of a call, and what each does. Those of `ARITHMETIC` are the model's own work.
PARTS = {
    "read": "checking the observation, in Python",
    "start": "normalising the state, noise",
    "prepare": "resizing images, making tokens",
    "backbone and encode": "products, attention and norms, until the head's keys and values",
    "around them": "crossing to Rust and back, checks, copies",
    "sample": "products, attention and norms of denoising",
    "around it": "crossing to Rust and back, checks, copies",
    "units": "the robot's units, by name",
}
ARITHMETIC = ("backbone and encode", "sample")


@dataclass(frozen=True)
class CallProfile:
    """One call of :meth:`saccade.Policy.act`, in parts."""

    milliseconds: dict[str, float]
    """Of each of `PARTS`. They add up to the call."""
    kernels: dict[str, float]
    """Of the arithmetic, by the parts of the model."""

    @property
    def total(self) -> float:
        """Milliseconds of the call."""
        return sum(self.milliseconds.values())

    @property
    def not_arithmetic(self) -> float:
        """The share of the call that is not the model's own work."""
        return 1.0 - sum(self.milliseconds[part] for part in ARITHMETIC) / self.total


def profile(policy: Policy, observation: Mapping[str, Any], seed: int, num_steps: int | None) -> CallProfile:
    """The fastest of repeated equal calls, after one that claims memory.

    What other programs delay would count as crossing and copies: waiting for a processor is no arithmetic.
    """
    one_call(policy, observation, seed, num_steps)
    calls: list[CallProfile] = []
    until = time.perf_counter() + SECONDS
    while len(calls) < CALLS or time.perf_counter() < until:
        calls.append(one_call(policy, observation, seed, num_steps))
    return min(calls, key=lambda call: call.total)


def one_call(policy: Policy, observation: Mapping[str, Any], seed: int, num_steps: int | None) -> CallProfile:
    """What :meth:`saccade.Policy.act` does, timed in parts.

    Preparation is inside the engine's one call. It is timed on its own beforehand.
    """
    processor, backbone = policy._require_backbone()
    prepared = read_observations(observation, policy.requirements)
    started = time.perf_counter()
    prepare_inputs(prepared, processor)
    times = [time.perf_counter()]
    preparing = times[0] - started
    batch = read_observations(observation, policy.requirements)
    times.append(time.perf_counter())
    options = Sampling(seed=seed, num_steps=num_steps)
    start = start_of_batch(batch, options, policy.head, policy.normalizer)
    times.append(time.perf_counter())
    with _saccade.profile() as of_encode:
        context = encode_observations(batch, processor, backbone, policy.head)
    times.append(time.perf_counter())
    with _saccade.profile() as of_sample:
        actions = sample_from(start, context, policy.head, policy.embodiment_id)
    times.append(time.perf_counter())
    restore_units(actions, batch, policy.normalizer)
    times.append(time.perf_counter())
    read, begin, encode, sample, units = (after - before for before, after in itertools.pairwise(times))
    counted = [of_encode.counters(), of_sample.counters()]
    encoding, sampling = (sum(seconds for _, seconds, *_ in one.values()) for one in counted)
    prepare = min(preparing, encode - encoding)
    seconds = {
        "read": read,
        "start": begin,
        "prepare": prepare,
        "backbone and encode": encoding,
        "around them": encode - encoding - prepare,
        "sample": sampling,
        "around it": sample - sampling,
        "units": units,
    }
    kernels = {part: sum(one[part][1] for one in counted) for part in counted[0]}
    return CallProfile(
        {part: 1e3 * seconds[part] for part in PARTS},
        {part: 1e3 * spent for part, spent in kernels.items() if spent > 0},
    )


def tables(found: CallProfile) -> list[Section]:
    """The parts of the call, and those of its arithmetic."""
    rows = [
        [part, f"{found.milliseconds[part]:,.2f}", f"{found.milliseconds[part] / found.total:.1%}", what]
        for part, what in PARTS.items()
    ]
    rows.append(["all", f"{found.total:,.2f}", "100.0%", f"{found.not_arithmetic:.1%} is not arithmetic"])
    arithmetic = sum(found.kernels.values())
    kernels = [
        [part, f"{spent:,.2f}", f"{spent / arithmetic:.1%}"]
        for part, spent in sorted(found.kernels.items(), key=lambda item: -item[1])
    ]
    return [
        Section("The fastest call, once memory is there", ["", ">ms", ">share", ""], rows),
        Section("Its arithmetic", ["", ">ms", ">share"], kernels),
    ]
