"""Timing pieces of work in turn, and profiling one of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import saccade
import saccade._saccade as _saccade
from saccade.observations.recorded import Observation

#: What a user waits for: encoding an observation, sampling a chunk from its context, and both.
PIECES = ("encode", "sample", "both")


@dataclass(frozen=True)
class Counter:
    """What one part did in a run: its calls, their time, multiply-adds and bytes of weights read."""

    calls: int
    seconds: float
    multiply_adds: int
    num_bytes: int


def pieces(
    head: saccade.ActionHead,
    num_vl_tokens: int,
    *,
    num_steps: int | None = None,
    num_samples: int | None = None,
    future_refresh: int | None = None,
    num_future_tokens: int | None = None,
    num_image_tokens: int | None = None,
) -> dict[str, Callable[[], Any]]:
    """Calls of a head on a random observation: those of `PIECES`, each called once before it is returned.

    The first tokens are image tokens: half of them, unless `num_image_tokens` is given.
    """
    config = head.config
    rng = np.random.default_rng(0)
    drawn = Observation.random(config, num_vl_tokens, rng, head.embodiment_ids[0])
    images = num_vl_tokens // 2 if num_image_tokens is None else num_image_tokens
    observation = replace(drawn, noise=None, image_mask=np.arange(num_vl_tokens)[None] < images)
    observation = observation.with_noise(rng, config, num_samples)
    changes = []
    if num_future_tokens is not None and num_future_tokens != config.num_future_tokens:
        tokens = rng.standard_normal((num_future_tokens, config.width), np.float32)
        changes = [saccade.Intervention(future_tokens=tokens)]

    def encode() -> saccade.Context:
        return observation.encode(head)

    context = encode()

    def sample(context: saccade.Context) -> Any:
        return observation.sample(
            head, context, num_steps=num_steps, future_refresh=future_refresh, intervention=changes
        )

    sample(context)
    return {
        "encode": encode,
        "sample": lambda: sample(context),
        "both": lambda: sample(encode()),
    }


def by_turns(
    works: Mapping[Any, Callable[[], Any]], rounds: int, note: Callable[[int], None] | None = None
) -> dict[Any, list[float]]:
    """Seconds of each piece of work in each round.

    A round does every piece once, in an order that rotates, so that a drift of the machine's clock affects
    all of them.

    Args:
        works: the pieces by name.
        rounds: how often each is done.
        note: called with the number of rounds done, after each of them.
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
    counters = {part: Counter(*counted) for part, counted in profile.counters().items()}
    return seconds, {part: counter for part, counter in counters.items() if counter.calls}


def quartiles(values: Iterable[float]) -> tuple[float, float, float]:
    """First quartile, median, third quartile."""
    held = list(values)
    if len(held) == 1:
        return held[0], held[0], held[0]
    first, median, third = statistics.quantiles(held, n=4, method="inclusive")
    return first, median, third
