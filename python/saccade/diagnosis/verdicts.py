"""Verdicts from measured effects, by the rules of ``docs/diagnose.md``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, TypeAlias

import numpy as np

from saccade._internal.bootstrap import Estimate, bootstrap_ratio
from saccade.diagnosis.changes import Kind
from saccade.diagnosis.effects import Measured

VerdictName: TypeAlias = Literal["used", "barely used", "ignored", "undecided"]

FEWEST_EPISODES = 5
USED, IGNORED = 0.20, 0.05  # of what another observation changes
REMOVED = 0.20  # that a removal may change of an ignored input
DEAF = 0.01  # of what another noise changes, by another observation


class Rule(IntEnum):
    """The rules of ``docs/diagnose.md`` by their numbers; the first that holds decides."""

    FEW_EPISODES = 1
    DEAF = 2
    NO_CHANGE = 3
    NO_MAIN_CHANGE = 4
    USED = 5
    IGNORED = 6
    BARELY_USED = 7
    UNDECIDED = 8


@dataclass(frozen=True)
class Effect:
    """What a change does to the actions.

    Attributes:
        kind: ``"main"``, ``"natural"`` or ``"removal"``; None for what is no change of an input.
        share: As a share of what another observation changes, with its 95 % interval over episodes.
        of_noise: As a share of what another noise changes.
        units: Mean absolute change of each key, in the robot's units.
        episodes: Number of episodes in which it is possible.
        largest: Episode and step at which it is largest.
    """

    kind: Kind | None
    share: Estimate
    of_noise: Estimate
    units: Mapping[str, float]
    episodes: int
    largest: tuple[int, int]


@dataclass(frozen=True)
class Verdict:
    """Whether a policy uses an input.

    Attributes:
        name: ``"used"``, ``"barely used"``, ``"ignored"`` or ``"undecided"``.
        effect: Effect of the main change as a share of what another observation changes; without a main
            change, the largest of the others; NaN if no change is possible.
        low, high: Its 95 % interval.
        changes: All changes of the input, by name.
        rule: Number of the rule of ``docs/diagnose.md`` that decided.
    """

    name: VerdictName
    effect: float
    low: float
    high: float
    changes: Mapping[str, Effect]
    rule: int


def effect_of(
    measured: Sequence[Measured], name: str, whole: str, noise: str, keys: Sequence[str], kind: Kind | None
) -> Effect | None:
    """The effect of a name over all episodes that have it; None if none has."""
    rows = []
    for one in measured:
        names = one.names.tolist()
        if name in names:
            place = names.index(name)
            squares, units = one.squares[:, place], one.units[:, place]
            for index in np.flatnonzero(~np.isnan(squares)):
                scales = [
                    one.squares[index, names.index(other)] if other in names else math.nan
                    for other in (whole, noise)
                ]
                rows.append(
                    (one.episode, int(one.steps[index]), float(squares[index]), *scales, units[index])
                )
    if not rows:
        return None
    episodes = [row[0] for row in rows]
    largest = max(rows, key=lambda row: row[2])
    return Effect(
        kind=kind,
        share=_share([row[2] for row in rows], [row[3] for row in rows], episodes),
        of_noise=_share([row[2] for row in rows], [row[4] for row in rows], episodes),
        units={key: float(np.mean([row[5][place] for row in rows])) for place, key in enumerate(keys)},
        episodes=len(set(episodes)),
        largest=(largest[0], largest[1]),
    )


def _share(parts: Sequence[float], wholes: Sequence[float], episodes: Sequence[int]) -> Estimate:
    """The root of the ratio of two sums, with its interval over episodes; NaN if the whole is nothing."""
    if any(math.isnan(whole) for whole in wholes):
        return Estimate(math.nan, math.nan, math.nan)
    found = bootstrap_ratio(parts, wholes, episodes)
    return Estimate(*(math.sqrt(value) for value in (found.value, found.low, found.high)))


def decided(changes: Mapping[str, Effect], observation: Effect | None) -> tuple[VerdictName, Rule]:
    """The verdict on an input, and the rule that decided.

    Args:
        changes: Its changes by name.
        observation: The effect of another observation.
    """
    possible = possible_of(changes)
    if observation is None or observation.episodes < FEWEST_EPISODES:
        return "undecided", Rule.FEW_EPISODES
    if observation.of_noise.high < DEAF:
        return "ignored", Rule.DEAF
    if not possible:
        return "undecided", Rule.NO_CHANGE
    main = [one.share for one in possible.values() if one.kind == "main"]
    if not main:
        has_none = all(one.share.high < IGNORED for one in possible.values())
        return ("ignored" if has_none else "undecided"), Rule.NO_MAIN_CHANGE
    if main[0].low > USED:
        return "used", Rule.USED
    limits = {"main": IGNORED, "natural": IGNORED, "removal": REMOVED}
    if all(one.share.high < limits[str(one.kind)] for one in possible.values()):
        return "ignored", Rule.IGNORED
    if main[0].high < USED and any(one.share.low > IGNORED for one in possible.values()):
        return "barely used", Rule.BARELY_USED
    return "undecided", Rule.UNDECIDED


def possible_of(changes: Mapping[str, Effect]) -> dict[str, Effect]:
    """The changes that enough episodes allow."""
    return {name: one for name, one in changes.items() if one.episodes >= FEWEST_EPISODES}


def verdict_of(changes: Mapping[str, Effect], observation: Effect | None) -> Verdict:
    """The verdict on an input, and the effect that it rests on."""
    shown = (possible_of(changes) or changes).values()
    main = [one for one in shown if one.kind == "main"]
    others = sorted(shown, key=lambda one: one.share.value, reverse=True)
    nothing = Estimate(math.nan, math.nan, math.nan)
    effect = next((one.share for one in (*main, *others)), nothing)
    name, rule = decided(changes, observation)
    return Verdict(name, effect.value, effect.low, effect.high, dict(changes), int(rule))
