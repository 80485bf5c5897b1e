"""The time of a call in int8 and int4, by turns in one process."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import saccade
from benches.int4.accuracy import Note
from saccade.policy.reading import read_observations

#: Rounds of a call in int8 and one in int4, after one that is not counted.
ROUNDS = 15
PRECISIONS = ("int8", "int4")


def measure(work: Path, threads: int, note: Note) -> dict[str, Any]:
    """Times the checkpoints that `size.measure` wrote.

    Returns:
        Seconds of each round by part and precision: `backbone and encode`, from images to the context of the
        head, and `sample`, a chunk from a held context.
    """
    policies = {
        name: saccade.Policy.from_pretrained(work / name, precision=name, num_threads=threads)
        for name in PRECISIONS
    }
    observation = policies["int8"].example_observation(seed=0)
    state = read_observations(observation, policies["int8"].requirements).state
    found: dict[str, Any] = {
        part: {name: [] for name in PRECISIONS} for part in ("backbone and encode", "sample")
    }
    for turn in range(ROUNDS + 1):
        # Who comes second finds the caches as the other one left them.
        for name in PRECISIONS if turn % 2 else PRECISIONS[::-1]:
            start = time.perf_counter()
            context = policies[name].encode(observation)
            encoded = time.perf_counter()
            policies[name].sample(context, state, seed=0)
            end = time.perf_counter()
            if turn:
                found["backbone and encode"][name].append(encoded - start)
                found["sample"][name].append(end - encoded)
    note(f"time: {found}")
    return found
