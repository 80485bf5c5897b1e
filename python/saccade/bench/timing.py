"""Timing pieces of work by turns, and profiles of one."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import saccade
from saccade import _saccade

#: What a user waits for: an observation, a chunk from one that is held, and both.
PIECES = ("encode", "sample", "both")


@dataclass(frozen=True)
class Counter:
    """What was counted of one part."""

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
    """Calls of a head on a random observation: those of `PIECES`, warmed up.

    The first tokens are those of images, half of them unless a number is given.
    """
    config = head.config
    rng = np.random.default_rng(0)
    features = rng.standard_normal((1, num_vl_tokens, config.context_dim), np.float32)
    images = num_vl_tokens // 2 if num_image_tokens is None else num_image_tokens
    image_mask = np.arange(num_vl_tokens)[None] < images
    state = rng.standard_normal((1, config.state_history, config.state_dim), np.float32)
    leading = (1,) if num_samples is None else (1, num_samples)
    noise = rng.standard_normal((*leading, config.action_horizon, config.encoder_action_dim), np.float32)
    changes = []
    if num_future_tokens is not None and num_future_tokens != config.num_future_tokens:
        tokens = rng.standard_normal((num_future_tokens, config.width), np.float32)
        changes = [saccade.Intervention(future_tokens=tokens)]

    def encode() -> saccade.Context:
        return head.encode(features, image_mask=image_mask)

    context = encode()

    def sample(observed: saccade.Context) -> Any:
        return head.sample(
            observed,
            state,
            head.embodiment_ids[0],
            noise=noise,
            num_steps=num_steps,
            num_samples=num_samples,
            future_refresh=future_refresh,
            intervention=changes,
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

    A round does every one of them once, in an order that rotates, so that a drift of the machine's clock
    meets all of them.

    Args:
        works: by any name.
        rounds: of them.
        note: is told the number of each round that is done.
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
    """Seconds of one run of `work`, and what its parts did, those that did something."""
    _saccade.start_profile()
    start = time.perf_counter()
    try:
        work()
    finally:
        seconds = time.perf_counter() - start
        counters = {part: Counter(*counted) for part, counted in _saccade.take_profile().items()}
    return seconds, {part: counter for part, counter in counters.items() if counter.calls}


def quartiles(values: Iterable[float]) -> tuple[float, float, float]:
    """First quartile, median, third quartile."""
    held = list(values)
    if len(held) == 1:
        return held[0], held[0], held[0]
    first, median, third = statistics.quantiles(held, n=4, method="inclusive")
    return first, median, third
