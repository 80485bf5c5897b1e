"""Numbers with their confidence intervals: bootstraps over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError

CONFIDENCE = 0.95
Statistic: TypeAlias = Callable[..., Any]  # a number, or an array if it is vectorized


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval; the bounds are NaN where there is none."""

    value: float
    low: float
    high: float


def bootstrap(
    values: npt.ArrayLike,
    clusters: Sequence[Any] | npt.NDArray[Any],
    statistic: Statistic = np.mean,
    *,
    draws: int = 2000,
    seed: int = 0,
    vectorized: bool = False,
) -> Estimate:
    """A statistic with its percentile interval from a cluster bootstrap.

    Whole clusters are drawn with replacement, because observations of one episode are correlated. With fewer
    than about ten clusters the interval is too narrow; with one cluster its bounds are NaN. Where all values
    are equal the interval has zero width, which does not prove equality: use ``wilson`` for rates and
    ``paired_difference`` for their differences.

    Args:
        values: Array ``(observations, ...)``. The statistic receives the rows of the drawn clusters.
        clusters: The cluster of each observation, such as its episode: strings, numbers or tuples of them.
        statistic: A function of such rows that does not depend on their order.
        draws, seed: Number of bootstrap samples and seed of the random generator.
        vectorized: Whether ``statistic`` also takes ``(draws, observations, ...)`` and returns ``(draws,)``.
            Each observation must be a cluster of its own.

    Raises:
        InputError: ``clusters`` does not have one entry per observation, there are no observations, or, with
            ``vectorized``, a cluster has several.

    Example:
        >>> mean = bootstrap([1.0, 1.0, 3.0, 3.0], ["a", "a", "b", "b"])
        >>> mean.value, mean.low, mean.high
        (2.0, 1.0, 3.0)
    """
    rows = np.asarray(values)
    names = [tuple(name) if isinstance(name, (tuple, list)) else name for name in clusters]
    if len(names) != len(rows) or not names:
        raise InputError(
            f"clusters: given {len(names)} for {len(rows)} values, expected one for each value, at least one"
        )
    if statistic is np.mean and rows.ndim == 1:
        return bootstrap_ratio(rows, np.ones(len(rows)), names, draws=draws, seed=seed)
    value = float(statistic(rows))
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    if vectorized and len(numbers) < len(rows):
        raise InputError(
            f"clusters: given {len(numbers)} for {len(rows)} values, expected as many if vectorized"
        )
    if len(numbers) < 2:
        return Estimate(value, math.nan, math.nan)
    number_of = np.array([numbers[name] for name in names])
    members = [np.flatnonzero(number_of == number) for number in range(len(numbers))]
    chosen = np.random.default_rng(seed).integers(len(members), size=(draws, len(members)))
    if vectorized:
        drawn = np.asarray(statistic(rows[chosen]))
    else:
        samples = (np.concatenate([members[one] for one in of_draw]) for of_draw in chosen)
        drawn = np.array([float(statistic(rows[sample])) for sample in samples])
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def bootstrap_ratio(
    parts: npt.ArrayLike, wholes: npt.ArrayLike, clusters: Sequence[Any], *, draws: int = 2000, seed: int = 0
) -> Estimate:
    """The ratio of two sums with its percentile interval from a cluster bootstrap.

    Gives the same interval as ``bootstrap`` with that ratio as its statistic, and is much faster. With all
    ``wholes`` equal to 1 it is the mean of ``parts``. NaN if ``wholes`` sum to zero.

    Args:
        parts, wholes: Numerators and denominators, ``(observations,)``.
        clusters: The cluster of each observation.
        draws, seed: Number of bootstrap samples and seed of the random generator.

    Example:
        >>> share = bootstrap_ratio([1.0, 1.0, 3.0, 3.0], [2.0, 2.0, 4.0, 4.0], ["a", "a", "b", "b"])
        >>> round(share.value, 3), share.low, share.high
        (0.667, 0.5, 0.75)
    """
    numbers = {name: number for number, name in enumerate(dict.fromkeys(clusters))}
    number_of = np.array([numbers[name] for name in clusters], dtype=np.int64)
    sums = np.array(
        [np.bincount(number_of, np.asarray(values, dtype=float), len(numbers)) for values in (parts, wholes)]
    )
    if sums[1].sum() <= 0:
        return Estimate(math.nan, math.nan, math.nan)
    value = float(sums[0].sum() / sums[1].sum())
    if len(numbers) < 2:
        return Estimate(value, math.nan, math.nan)
    chosen = np.random.default_rng(seed).integers(len(numbers), size=(draws, len(numbers)))
    part, whole = sums[:, chosen].sum(axis=2)
    drawn = part[whole > 0] / whole[whole > 0]
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))
