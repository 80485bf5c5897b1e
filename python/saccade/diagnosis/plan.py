"""What a diagnosis compares with what: steps, partners, instructions and the spread of the state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from saccade.evaluation.recordings import Recordings, length_of, observation_at
from saccade.observations import ParsedObservation
from saccade.policy.preparing import prepare_inputs

if TYPE_CHECKING:
    from saccade.policy.policy import Policy

STEPS = 4  # observations of an episode: the middles of its quarters
MOST_EPISODES = 20  # by default, evenly spaced


@dataclass(frozen=True)
class Plan:
    """The comparisons of a diagnosis.

    Attributes:
        episodes: Places of the episodes.
        partners: The other episode of each; empty if there is only one.
        instructions: The instructions of the observations, and the number of tokens of each prompt.
        spread: Standard deviation of each number of the state over the observations.
        seed: The seed.
    """

    episodes: tuple[int, ...]
    partners: Mapping[int, int]
    instructions: Mapping[str, int]
    spread: tuple[float, ...]
    seed: int


def steps_of(length: int) -> list[int]:
    """The steps of an episode that are observed.

    Example:
        >>> steps_of(100), steps_of(2)
        ([12, 37, 62, 87], [0, 1])
    """
    return sorted({int((place + 0.5) * length / STEPS) for place in range(STEPS)})


def default_episodes(count: int) -> list[int]:
    """At most ``MOST_EPISODES`` places of ``count``, evenly spaced."""
    return sorted({int(place) for place in np.linspace(0, count - 1, min(MOST_EPISODES, count)).round()})


def partners_of(episodes: Sequence[int], seed: int) -> dict[int, int]:
    """Another episode for each, by a random order in which each has the next one."""
    if len(episodes) < 2:
        return {}
    order = np.random.default_rng(seed).permutation(episodes).tolist()
    return dict(zip(order, [*order[1:], order[0]], strict=True))


def planned(policy: Policy, data: Recordings, episodes: Sequence[int], seed: int) -> Plan:
    """Reads the observations once, for their instructions and states.

    Raises:
        SaccadeError: One does not fit the policy; the message names episode and step.
    """
    texts: dict[str, int] = {}
    states = []
    for episode in episodes:
        for step in steps_of(length_of(data, episode)):
            parsed = observation_at(policy, data, episode, step)
            states.append(parsed.state[0, -1])
            (text,) = parsed.instructions
            if text is not None and text not in texts:
                texts[text] = _num_tokens(policy, parsed)
    spread = np.std(np.stack(states).astype(np.float64), axis=0)
    return Plan(tuple(episodes), partners_of(episodes, seed), texts, tuple(spread.tolist()), seed)


def _num_tokens(policy: Policy, observation: ParsedObservation) -> int:
    """Number of tokens of the prompt of an observation; 0 if the policy has no processor."""
    if policy.processor is None:
        return 0
    (inputs,) = prepare_inputs([observation], policy.processor)
    return int(np.shape(inputs.input_ids)[1])
