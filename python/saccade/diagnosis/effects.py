"""Measures what the changes of one episode's observations do to the actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.diagnosis.changes import Change, Neighbours, changed
from saccade.diagnosis.plan import Plan, steps_of
from saccade.evaluation.prediction import BATCH, SAMPLES, horizon_of, noise_of
from saccade.evaluation.recordings import Recordings, length_of, observation_at
from saccade.head.context import Context
from saccade.head.intervention import ROW_GROUPS, Intervention
from saccade.observations import ParsedObservation

if TYPE_CHECKING:
    from saccade.policy.encoding import PolicyContext
    from saccade.policy.policy import Policy

Numbers = npt.NDArray[np.float64]

#: What is measured besides changes of inputs: other noise, the partner's whole observation, cut edges.
NOISE, OBSERVATION = "another noise", "another observation"
TEXT, IMAGES = "text", "images"


@dataclass(frozen=True, eq=False)
class Measured:
    """The effects in one episode.

    Attributes:
        episode: Its place in the data set.
        steps: The observed steps, ``(observations,)``.
        names: Name of each effect, ``(effects,)``: ``"input|change|kind"``, or ``"|name|"`` of others.
        squares: Mean squared change of the normalised actions, ``(observations, effects)``; NaN where the
            change is not possible.
        units: Mean absolute change of each key in the robot's units, ``(observations, effects, keys)``.
        seconds: How long it took.
    """

    episode: int
    steps: npt.NDArray[np.int64]
    names: npt.NDArray[np.str_]
    squares: Numbers
    units: Numbers
    seconds: float


def measure_episode(
    policy: Policy, data: Recordings, episode: int, plan: Plan, clock: Callable[[], float]
) -> Measured:
    """Changes the inputs of an episode's observations, one at a time.

    Raises:
        SaccadeError: An observation does not fit the policy; the message names episode and step.
    """
    start = clock()
    length = length_of(data, episode)
    steps = steps_of(length)
    first = observation_at(policy, data, episode, 0)
    partner = plan.partners.get(episode)
    found: list[dict[str, tuple[float, Numbers]]] = []
    for step in steps:
        other = None
        if partner is not None:
            theirs = length_of(data, partner)
            other = observation_at(policy, data, partner, min(theirs - 1, step * theirs // length))
        rng = np.random.default_rng((plan.seed, episode, step, 1))
        near = Neighbours(first, other, plan.instructions, np.asarray(plan.spread, np.float32), rng)
        observation = observation_at(policy, data, episode, step)
        found.append(_effects(policy, observation, near, noise_of(policy, plan.seed, episode, step)))
    names = list(dict.fromkeys(name for one in found for name in one))
    nothing = (np.nan, np.full(len(policy.normalizer.action_slices), np.nan))
    return Measured(
        episode=episode,
        steps=np.array(steps),
        names=np.array(names),
        squares=np.array([[one.get(name, nothing)[0] for name in names] for one in found]),
        units=np.array([[one.get(name, nothing)[1] for name in names] for one in found]),
        seconds=clock() - start,
    )


def name_of(change: Change) -> str:
    """The name of an effect."""
    return f"{change.input}|{change.name}|{change.kind}"


def _effects(
    policy: Policy, observation: ParsedObservation, near: Neighbours, noise: Float32Array
) -> dict[str, tuple[float, Numbers]]:
    """The effects on one observation, by name: the square, and the units of each key."""
    answers = _Answers(policy, observation, noise)
    partner = [] if near.partner is None else [near.partner]
    both = policy.encode([observation, *partner])
    actions = answers.of(both.context, [observation, *partner])
    base = actions[0]
    found = {f"|{NOISE}|": answers.effect(base[:1], base[1:])}
    if partner:
        found[f"|{OBSERVATION}|"] = answers.effect(base, actions[1])
    variants = list(changed(observation, near))
    possible = [(change, one) for change, one in variants if one is not None]
    # The state is no input of the backbone: what is known of the frames and words holds.
    of_state = [(change, one) for change, one in possible if change.input == "state"]
    others = [(change, one) for change, one in possible if change.input != "state"]
    for first in range(0, len(others), BATCH):
        batch = others[first : first + BATCH]
        context = policy.encode([one for _, one in batch], previous=both)
        for (change, _), one in zip(
            batch, answers.of(context.context, [one for _, one in batch]), strict=True
        ):
            found[name_of(change)] = answers.effect(base, one)
    alone = policy.encode(observation, previous=both)
    for change, variant in of_state:
        found[name_of(change)] = answers.effect(base, answers.of(alone.context, [variant])[0])
    for name, cut in _cuts(alone, policy.head.config.num_future_tokens):
        found[f"|{name}|"] = answers.effect(base, answers.of(alone.context, [observation], cut)[0])
    # Every effect has a place, also one that is not possible here.
    order = [f"|{NOISE}|", f"|{OBSERVATION}|", *(name_of(change) for change, _ in variants)]
    nothing = (np.nan, np.full(len(policy.normalizer.action_slices), np.nan))
    return {**{name: found.get(name, nothing) for name in order}, **found}


class _Answers:
    """Samples actions of changed observations from the same noise, and compares them."""

    def __init__(self, policy: Policy, observation: ParsedObservation, noise: Float32Array) -> None:
        self.policy = policy
        self.state = observation.state
        self.noise = noise
        self.horizon = horizon_of(policy)

    def of(
        self, context: Context, given: Sequence[ParsedObservation], cut: Intervention | None = None
    ) -> list[Float32Array]:
        """Normalised actions ``(2, horizon, head_width)`` of each observation of a context."""
        policy = self.policy
        state = policy.normalizer.state(np.concatenate([one.state for one in given]))
        actions = policy.head.sample(
            context,
            state,
            policy.embodiment_id,
            noise=np.repeat(self.noise[None], len(given), axis=0),
            num_samples=SAMPLES,
            intervention=cut,
        )
        return list(np.asarray(actions)[:, :, : self.horizon])

    def effect(self, one: Float32Array, other: Float32Array) -> tuple[float, Numbers]:
        """The mean squared difference of normalised actions; by key the mean absolute one, in units."""
        width = self.policy.normalizer.head_action_width
        apart = one[..., :width].astype(np.float64) - other[..., :width]
        units = [
            np.asarray(self.policy.normalizer.actions(part[None], self.state), np.float64)[0]
            for part in (one, other)
        ]
        keys = self.policy.normalizer.action_slices.values()
        by_key = [np.mean(np.abs(units[0][..., where] - units[1][..., where])) for where in keys]
        return float(np.mean(apart**2)), np.array(by_key)


def _cuts(context: PolicyContext, num_future_tokens: int) -> list[tuple[str, Intervention]]:
    """The edges from text tokens and from image tokens to all rows of the head."""
    if context.context.image_mask is None:
        return []
    is_image = np.asarray(context.context.image_mask)[0]
    readers = [name for name in ROW_GROUPS if name != "future" or num_future_tokens]
    found = []
    for name, chosen in ((TEXT, ~is_image), (IMAGES, is_image)):
        places = tuple(int(place) for place in np.flatnonzero(chosen))
        if places:
            cut = [(reader, ("vl", places)) for reader in readers]
            found.append((name, Intervention(cut=cut)))
    return found
