"""What the table of a sweep shows: success by policy, and differences between points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import scipy

from saccade_lab.study.statistics import CONFIDENCE, Estimate, bootstrap, tango, wilson

PLAIN = "plain"  # the arm of an unchanged policy
FEWEST_EPISODES = 10  # that a bootstrap over episodes needs


@dataclass(frozen=True)
class Varied:
    """What defines a point of a sweep.

    Attributes:
        names: Names of training settings, or of sizes of the backbone.
        label: A point as text, from their values.
    """

    names: tuple[str, ...]
    label: Callable[[Mapping[Any, Any]], str]


def between_runs(first: Sequence[float], second: Sequence[float], episodes: int) -> Estimate:
    """Difference of the mean success of two points, second minus first, over training runs.

    Student's t interval, with the same variance between runs on both sides. The variance is at least that of
    the sampled episodes, so that runs that agree by chance do not give a narrow interval.

    Args:
        first, second: Success rates of the runs.
        episodes: Episodes behind each rate.

    Returns:
        The bounds are NaN where a side has only one run, or where the variance is zero.
    """
    value = float(np.mean(second) - np.mean(first))
    if min(len(first), len(second)) < 2:
        return Estimate(value, math.nan, math.nan)
    freedom = len(first) + len(second) - 2
    variance = 0.0
    for rates in (first, second):
        mean = float(np.mean(rates))
        by_episodes = mean * (1 - mean) / episodes
        variance += (len(rates) - 1) / freedom * max(float(np.var(rates, ddof=1)), by_episodes)
    if variance == 0:  # all runs always succeeded, or never
        return Estimate(value, math.nan, math.nan)
    error = math.sqrt(variance * (1 / len(first) + 1 / len(second)))
    half = float(scipy.stats.t.ppf((1 + CONFIDENCE) / 2, freedom)) * error
    return Estimate(value, max(value - half, -1.0), min(value + half, 1.0))


def same_policies(first: pd.DataFrame, second: pd.DataFrame) -> Estimate:
    """Difference of the success of these very policies, second minus first, on the same episodes.

    The mean over the runs of a point, episode by episode; see ``mean_difference``.
    """
    one, other = (rows.groupby(["task", "seed"])["success"].mean() for rows in (first, second))
    difference = (other - one).dropna()
    return mean_difference(difference.to_numpy(), list(difference.index))


def mean_difference(differences: npt.NDArray[np.float64], episodes: Sequence[Any]) -> Estimate:
    """The mean of differences of success, with a bootstrap interval over episodes.

    Where few episodes differ the bootstrap interval is too narrow, and where none differs it has zero width.
    The result is therefore the union with Tango's interval for the same gains and losses. With fewer than
    ``FEWEST_EPISODES`` episodes the bounds are NaN.

    Args:
        differences: ``(observations,)``, in -1..1.
        episodes: The episode of each.
    """
    count = len(set(episodes))
    if count < FEWEST_EPISODES:
        return Estimate(float(np.mean(differences)) if count else math.nan, math.nan, math.nan)
    drawn = bootstrap(differences, episodes)
    # An episode counts once, however many policies ran it, so gains and losses may be fractions.
    by_episode = pd.Series(differences).groupby([str(episode) for episode in episodes]).mean()
    scored = tango(by_episode.clip(lower=0).sum(), -by_episode.clip(upper=0).sum(), count)
    return Estimate(drawn.value, min(drawn.low, scored.low), max(drawn.high, scored.high))


def point_order(plain: pd.DataFrame, varied: Varied) -> list[str]:
    """The points' labels in the order of their values."""
    return list(dict.fromkeys(plain.sort_values(list(varied.names))["point"]))


def policies_of(rows: pd.DataFrame) -> list[str]:
    """The names of the policies, ordered by training seed."""
    return list(dict.fromkeys(rows.sort_values("training_seed")["policy"]))


def wilson_of(rows: pd.DataFrame) -> Estimate:
    """The success rate of one policy's episodes."""
    return wilson(int(rows["success"].sum()), len(rows))


def run_rates(rows: pd.DataFrame) -> list[float]:
    """The success rate of each of a point's runs."""
    return [float(rows.loc[rows["policy"] == name, "success"].mean()) for name in policies_of(rows)]


def compared(plain: pd.DataFrame, varied: Varied) -> list[tuple[str, str]]:
    """Pairs of points that differ in one respect."""
    values = plain.drop_duplicates("point").sort_values(list(varied.names))
    points = [(str(row["point"]), [row[name] for name in varied.names]) for row in values.to_dict("records")]
    return [
        (first, second)
        for (first, one), (second, other) in itertools.combinations(points, 2)
        if sum(a != b for a, b in zip(one, other, strict=True)) == 1
    ]


def differences(plain: pd.DataFrame, varied: Varied) -> list[tuple[str, str, Estimate, Estimate]]:
    """Pairs of points, and how the second differs: for these policies, and over training runs."""
    found = []
    for first, second in compared(plain, varied):
        one, other = plain[plain["point"] == first], plain[plain["point"] == second]
        episodes = len(one) // len(policies_of(one))
        trained = between_runs(run_rates(one), run_rates(other), episodes)
        found.append((first, second, same_policies(one, other), trained))
    return found


def mass_differences(episodes: pd.DataFrame, points: Sequence[str]) -> list[tuple[str, str, Estimate]]:
    """How success changes with each control of equal mass, compared with the same unchanged policies."""
    keys = ["policy", "task", "seed"]
    found = []
    for point in points:
        of_point = episodes[episodes["point"] == point]
        plain = of_point[of_point["arm"] == PLAIN].set_index(keys)["success"]
        for arm in sorted(set(of_point["arm"]) - {PLAIN}):
            weighed = of_point[of_point["arm"] == arm].set_index(keys)["success"]
            change = (weighed - plain).dropna()
            drawn = [(task, seed) for _, task, seed in change.index]
            found.append((point, str(arm), mean_difference(change.to_numpy(), drawn)))
    return found


def complete_policies(plain: pd.DataFrame) -> tuple[list[str], list[tuple[str, int, int]]]:
    """Policies that ran every episode that any of them ran.

    Returns:
        Their names; and of the others the name, the number of episodes done and of all.
    """
    ran = {
        str(name): set(zip(rows["task"], rows["seed"], strict=True))
        for name, rows in plain.groupby("policy", sort=False)
    }
    every = set().union(*ran.values())
    whole = [name for name, episodes in ran.items() if episodes == every]
    return whole, [(name, len(episodes), len(every)) for name, episodes in ran.items() if episodes != every]
