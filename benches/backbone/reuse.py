"""How much of a step is saved if the frame of a view has not changed: two views, head included."""

from __future__ import annotations

import copy
import multiprocessing
from pathlib import Path
from typing import Any

import numpy as np

from benches.backbone import setup
from saccade_lab.timing import by_turns

#: The pieces, and which views of the next observation are new.
PIECES: dict[str, tuple[int, ...] | None] = {
    "full step": None,
    "first view unchanged": (1,),
    "second view unchanged": (0,),
    "nothing changed": (),
}

#: The share of a full step that is to be reached.
GOALS = {"first view unchanged": 0.66, "second view unchanged": 0.90}


def measure(folder: Path, precision: str, threads: int, rounds: int) -> dict[str, Any]:
    """Seconds of each piece in each round, and whether reuse gives the same bits; in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_measure, (folder, precision, threads, rounds))


def _measure(folder: Path, precision: str, threads: int, rounds: int) -> dict[str, Any]:
    import saccade

    policy = saccade.Policy.from_pretrained(folder, precision=precision, num_threads=threads)
    before, other = (with_words(policy.example_observation(seed=seed)) for seed in (0, 1))
    held = policy.encode(before)
    names = sorted(before["video"])
    if len(names) != 2:
        raise SystemExit(f"benches.backbone: expected a robot with two cameras, got {names}")
    works = {}
    same = {}
    for piece, new in PIECES.items():
        after = copy.deepcopy(before)
        for view in (0, 1) if new is None else new:
            after["video"][names[view]] = other["video"][names[view]]
        previous = None if new is None else held

        def step(after: Any = after, previous: Any = previous) -> Any:
            return policy.sample(policy.encode(after, previous=previous), after, seed=0)

        def plain(after: Any = after) -> Any:
            return policy.sample(policy.encode(after), after, seed=0)

        works[piece] = step
        same[piece] = all(np.array_equal(a, b) for a, b in zip(leaves(step()), leaves(plain()), strict=True))
    return {"seconds": by_turns(works, rounds), "same_bits": same}


def with_words(observation: dict[str, Any]) -> dict[str, Any]:
    """The observation with the usual instruction instead of its own."""

    def changed(value: Any) -> Any:
        if isinstance(value, str):
            return setup.INSTRUCTION_TEXT
        if isinstance(value, dict):
            return {key: changed(each) for key, each in value.items()}
        return [changed(each) for each in value] if isinstance(value, list) else value

    return {**observation, "language": changed(observation["language"])}


def leaves(actions: Any) -> list[Any]:
    """The arrays of an answer."""
    return [actions[key] for key in sorted(actions)] if isinstance(actions, dict) else [actions]
