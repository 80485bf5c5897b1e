"""Closed loop: observe, compute a chunk, execute its first actions, observe again."""

import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade_lab.sim.environment import TaskEnvironment
from saccade_lab.sim.policy import Interventions, Policy
from saccade_lab.sim.tasks import TASKS, find_task

PARTS = ("render", "backbone", "encode", "sample")


@dataclass
class Episode:
    """One episode and its outcome.

    Attributes:
        task: The task that was judged.
        seed: Seed of layout, wording and noise.
        instruction: The instruction that the policy got.
        success: Whether the task was done within its ``max_steps``.
        steps: Control steps until success, or until the end.
        chunks: Number of chunks that the policy computed.
        milliseconds: Mean time per chunk over the episode, by part of ``PARTS``.
        video: Path of its video relative to the result file, if one was written.
    """

    task: str
    seed: int
    instruction: str
    success: bool = False
    steps: int = 0
    chunks: int = 0
    milliseconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    video: str | None = None


def instruction_for(task: str, seed: int, instruction_from: str | None) -> str:
    """The instruction of an episode; with ``instruction_from``, that of another task."""
    return find_task(instruction_from or task).instruction(seed)


def rng_seed(task: str, seed: int) -> tuple[int, int]:
    """What the generator of an episode's noise is made from."""
    return list(TASKS).index(task), seed


def run_episode(
    environment: TaskEnvironment,
    policy: Policy,
    seed: int,
    *,
    instruction_from: str | None = None,
    intervention: Interventions | Callable[[int, int], Interventions] = None,
    on_step: Callable[[TaskEnvironment, Episode], None] = lambda environment, episode: None,
    on_action: Callable[[Mapping[str, Any], Float32Array, int, int], None] | None = None,
) -> Episode:
    """Runs one episode to its first success or to the task's ``max_steps``.

    Args:
        environment: An environment with the cameras and image size of the policy, see ``environment_for``.
        policy: Policy that computes the chunks.
        seed: Seed of layout, wording and noise, which are the same with every engine.
        instruction_from: A task whose instruction the policy gets instead (a control: it should then fail).
        intervention: A change inside the head at every chunk; or a function that returns it, called with the
            index of the chunk and the seed.
        on_step: Called after the first observation and after every control step, for videos.
        on_action: Called before every control step with what is seen, the action as the policy gave it, the
            index of its chunk and its place there, for recordings. What is seen is then drawn at every step.
    """
    task = environment.task
    environment.restart(seed)
    environment.instruction = instruction_for(task.name, seed, instruction_from)
    rng = np.random.default_rng(rng_seed(task.name, seed))
    episode = Episode(task.name, seed, environment.instruction)
    total = dict.fromkeys(PARTS, 0.0)
    while episode.steps < task.max_steps and not episode.success:
        start = time.perf_counter()
        observation = environment.observe()
        total["render"] += 1e3 * (time.perf_counter() - start)
        change = intervention(episode.chunks, seed) if callable(intervention) else intervention
        chunk = policy.act(observation, noise=policy.noise(rng), intervention=change)
        for part, spent in chunk.milliseconds.items():
            total[part] += spent
        episode.chunks += 1
        if episode.steps == 0:
            on_step(environment, episode)
        count = min(policy.config.execute_steps, task.max_steps - episode.steps)
        for place, action in enumerate(chunk.actions[:count]):
            if on_action is not None:
                seen = environment.observe() if place else observation
                on_action(seen, chunk.answer[place], episode.chunks - 1, place)
            episode.success = environment.advance(action).success
            episode.steps += 1
            on_step(environment, episode)
            if episode.success:
                break
    episode.milliseconds = {part: total[part] / episode.chunks for part in PARTS}
    return episode


def environment_for(
    policy: Policy, task: str, *, render_mode: str | None = None, blanked: Collection[str] = ()
) -> TaskEnvironment:
    """The task with the policy's cameras and image size; images of the cameras in ``blanked`` are black."""
    return TaskEnvironment(
        task,
        image_size=policy.config.image_size,
        cameras=policy.config.cameras,
        render_mode=render_mode,
        blanked=blanked,
    )
