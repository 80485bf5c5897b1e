"""Closed loop in LIBERO: look, compute a chunk, execute its first actions, look again."""

from __future__ import annotations

import time
from collections.abc import Callable

from saccade_lab.libero.environment import LiberoEnvironment
from saccade_lab.libero.episode import Episode, Key, Noise
from saccade_lab.libero.policy import LiberoPolicy
from saccade_lab.libero.starts import Starts


def run_episode(
    starts: Starts,
    policy: LiberoPolicy,
    key: Key,
    noise: Noise,
    on_step: Callable[[LiberoEnvironment, Episode], None] = lambda environment, episode: None,
) -> Episode:
    """Runs one episode to its first success or to the protocol's limit.

    Args:
        starts: The environment of the task, with the protocol's frames.
        policy: The policy.
        key: Which episode.
        noise: Seeds of the chunks.
        on_step: Called after the first observation and after every control step, for videos. What it draws
            is not in the time of the episode, and changes nothing else. The last observation is always drawn.

    Raises:
        InputError, ShapeError, DtypeError: As ``LiberoPolicy.act``; or the policy's actions are not finite.
    """
    environment, episode = starts.environment, Episode(*key)
    limit = policy.protocol.limit(episode.suite)
    begun = time.perf_counter()
    starts.begin(episode.trial)
    episode.seconds["reset"] = time.perf_counter() - begun
    while True:
        begun = time.perf_counter()
        seen = environment.observe()
        episode.seconds["draw"] += time.perf_counter() - begun
        on_step(environment, episode)  # it finds the pictures drawn
        if episode.success or episode.steps >= limit:
            return episode
        chunk = policy.act(seen, seed=noise.of(episode))
        for part, spent in chunk.seconds.items():
            episode.seconds[part] += spent
        episode.chunks += 1
        count = min(policy.execute_steps, limit - episode.steps)
        for place, action in enumerate(chunk.actions[:count]):
            if place:
                on_step(environment, episode)
            begun = time.perf_counter()
            episode.success = environment.advance(action).success
            episode.seconds["physics"] += time.perf_counter() - begun
            episode.steps += 1
            if episode.success:
                break
