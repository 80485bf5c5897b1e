"""Recordings in memory, for what takes a data set: made up, or made by a policy itself."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

import saccade
from saccade import Policy

#: Instructions of the bundled policy.
TOLD = ("reach the green ball", "push the red block to the goal", "open the drawer")


@dataclass(frozen=True)
class Episode:
    """An episode of so many steps."""

    steps: range


@dataclass
class Recorded:
    """Recordings in memory; ``seen[episode][step]`` and ``done[key][episode]``."""

    seen: Sequence[Sequence[Mapping[str, Any]]]
    done: Mapping[str, Sequence[npt.NDArray[Any]]]
    asked: list[tuple[int, int]] = field(default_factory=list)

    @property
    def episodes(self) -> Sequence[Episode]:
        return [Episode(range(len(one))) for one in self.seen]

    def __len__(self) -> int:
        return len(self.seen)

    def observation(self, episode: int, step: int, form: str = "isaac") -> Mapping[str, Any]:
        assert form == "isaac"
        self.asked.append((episode, step))
        return self.seen[episode][step]

    def actions(self, episode: int, step: int, horizon: int) -> Mapping[str, npt.NDArray[Any]]:
        """As a data set: the last action is repeated beyond the end."""
        found = {}
        for key, episodes in self.done.items():
            rows = episodes[episode]
            places = np.minimum(np.arange(step, step + horizon), len(rows) - 1)
            found[key] = rows[places]
        return found


@functools.cache
def demo_policy() -> Policy:
    """The bundled policy."""
    return Policy.from_pretrained(saccade.demo_checkpoint(), num_threads=1)


def made_up(
    lengths: Sequence[int], dtype: Any = np.float32, seed: int = 0, policy: Policy | None = None
) -> Recorded:
    """Random frames and actions, states that move, and a different instruction in every episode."""
    whole, rng = policy or demo_policy(), np.random.default_rng(seed)
    seen = []
    for episode, length in enumerate(lengths):
        steps = []
        for step in range(length):
            observation = whole.example_observation(int(rng.integers(1 << 20)))
            for key, value in observation["state"].items():
                observation["state"][key] = (
                    value
                    + np.float32(0.1) * rng.standard_normal(value.shape, dtype=np.float32)
                    + np.float32(0.001 * step)
                )
            observation["language"] = {key: [[TOLD[episode % len(TOLD)]]] for key in observation["language"]}
            steps.append(observation)
        seen.append(steps)
    done = {
        group.key: [rng.standard_normal((length, group.size)).astype(dtype) for length in lengths]
        for group in whole.normalizer.action_groups
    }
    return Recorded(seen, done)


def still(lengths: Sequence[int]) -> Recorded:
    """As :func:`made_up`, with a black camera, and a state that is the same everywhere."""
    data = made_up(lengths)
    state = data.seen[0][0]["state"]
    for observation in (one for episode in data.seen for one in episode):
        observation["video"]["top"] = np.zeros_like(observation["video"]["top"])
        observation["state"].update(state)
    return data


def by_the_policy(policy: Policy, lengths: Sequence[int], stride: int, seed: int) -> Recorded:
    """Observations of :func:`made_up`, with the actions that the policy predicts as ``evaluate`` does."""
    data = made_up(lengths, policy=policy)
    done: dict[str, list[npt.NDArray[Any]]] = {key: [] for key in data.done}
    for episode, length in enumerate(lengths):
        chunks = [
            policy.act(data.seen[episode][step], seed=(seed, episode, step))
            for step in range(0, length, stride)
        ]
        for key, parts in done.items():
            parts.append(np.concatenate([chunk[key][0, :stride] for chunk in chunks])[:length])
    return Recorded(data.seen, done)
