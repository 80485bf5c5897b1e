"""Success of a trained policy in closed loop, in float32, int8 and int4 on the same episodes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import saccade
from benches.int4.accuracy import Note, Trained
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.sim.settings import CONFIG_FILE, SimulationConfig

#: Seeds of episodes begin here. Recordings that weights are rounded for are of the first ones.
FIRST_SEED = 10_000


def measure(model: Trained, folders: dict[str, Path], episodes: int, jobs: int, note: Note) -> dict[str, Any]:
    """Runs the same episodes at each precision, backbone and head.

    Args:
        model: A policy of the simulator.
        folders: Its copies in four bits, by name.
        episodes: Number of episodes, an equal number of each task.
        jobs: Processes.

    Returns:
        What `Trained.about` says, and `success`: by name of the precision of each episode, in the same order.
    """
    arms: dict[str, tuple[Path, str]] = {name: (model.checkpoint, name) for name in ("float32", "int8")}
    arms |= {name: (folder, "int4") for name, folder in folders.items()}
    tasks = model.tasks
    seeds = range(FIRST_SEED, FIRST_SEED + episodes // len(tasks))
    calls = [(*arm, task, seed) for arm in arms.values() for task in tasks for seed in _parts(seeds)]
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        found = iter(pool.imap(_successes, calls))
        of_arms: dict[str, list[bool]] = {}
        for name in arms:
            parts = [next(found) for _ in tasks for _ in _parts(seeds)]
            of_arms[name] = [success for part in parts for success in part]
            note(f"{model.name}: {name} {sum(of_arms[name])} of {len(of_arms[name])}")
    return {**model.about(), "success": of_arms}


def _parts(seeds: range, size: int = 20) -> Iterable[range]:
    """The seeds that one process runs before it looks for others."""
    return [seeds[start : start + size] for start in range(0, len(seeds), size)]


def _successes(call: tuple[Path, str, str, range]) -> list[bool]:
    """Whether the episodes of one task succeed."""
    folder, precision, task, seeds = call
    whole = saccade.Policy.from_pretrained(folder, precision=precision, num_threads=1)
    policy = Policy(whole, SimulationConfig.from_file(folder / CONFIG_FILE), folder)
    environment = environment_for(policy, task)
    try:
        return [bool(run_episode(environment, policy, seed).success) for seed in seeds]
    finally:
        environment.close()
