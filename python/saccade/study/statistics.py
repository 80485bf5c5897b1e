"""Intervals for rates, paired differences and means over episodes, and what a number of them can detect."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.stats import binomtest, nct, norm, t

from saccade.errors import InputError

CONFIDENCE = 0.95
POWER = 0.8
Statistic = Callable[..., float]


@dataclass(frozen=True)
class Estimate:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class PairedDifference:
    """Success of two arms on the same episodes.

    Attributes:
        difference: Rate of the first less rate of the second, with Tango's score interval.
        pairs: Episodes that both have.
        both, only_first, only_second, neither: In how many of them which arm succeeded. Only the two middle
            ones, the discordant pairs, tell the arms apart.
        p_value: McNemar's exact test.
    """

    difference: Estimate
    pairs: int
    both: int
    only_first: int
    only_second: int
    neither: int
    p_value: float


def scaled(value: Estimate) -> Estimate:
    """A share in percent."""
    return Estimate(100 * value.value, 100 * value.low, 100 * value.high)


def wilson(successes: int, trials: int) -> Estimate:
    """A success rate with Wilson's score interval; without a trial the rate is NaN and may be anything.

    Example:
        >>> rate = wilson(18, 20)
        >>> rate.value, round(rate.low, 3), round(rate.high, 3)
        (0.9, 0.699, 0.972)
    """
    if not 0 <= successes <= trials:
        raise InputError(f"successes: given {successes} of {trials}, expected between 0 and all of them")
    if trials == 0:
        return Estimate(math.nan, 0.0, 1.0)
    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(successes / trials, float(interval.low), float(interval.high))


def paired_difference(first: Sequence[bool], second: Sequence[bool]) -> PairedDifference:
    """Compares two arms on the same episodes, in the same order.

    The interval is Tango's score interval (Statistics in Medicine 17, 1998). Unlike those of Wald and
    Newcombe it keeps its width where no pair is discordant, so equal results are not taken for equality.

    Raises:
        InputError: lengths differ, or there is no pair.

    Example:
        >>> found = paired_difference([True] * 9 + [False], [True] * 5 + [False] * 5)
        >>> found.difference.value, found.only_first, found.only_second
        (0.4, 4, 0)
        >>> round(found.difference.low, 2), round(found.difference.high, 2)
        (0.01, 0.69)
    """
    one, two = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    if one.shape != two.shape or one.ndim != 1 or not one.size:
        raise InputError(
            f"paired_difference: given {one.size} and {two.size} results, expected pairs, at least one"
        )
    only_first, only_second = int((one & ~two).sum()), int((~one & two).sum())
    discordant = only_first + only_second
    return PairedDifference(
        difference=tango(only_first, only_second, one.size),
        pairs=one.size,
        both=int((one & two).sum()),
        only_first=only_first,
        only_second=only_second,
        neither=int((~one & ~two).sum()),
        p_value=float(binomtest(only_first, discordant).pvalue) if discordant else 1.0,
    )


def tango(only_first: float, only_second: float, pairs: int) -> Estimate:
    """The difference of two paired rates with Tango's score interval, from the discordant pairs.

    Example:
        Response to a therapy, before and after (Cavo and others, Blood 120, 2012):

        >>> found = tango(6, 16, 161)
        >>> [round(number, 4) for number in (found.value, found.low, found.high)]
        [-0.0621, -0.124, -0.0054]
    """
    quantile = float(norm.ppf((1 + CONFIDENCE) / 2))
    value = (only_first - only_second) / pairs

    def score(difference: float) -> float:
        return tango_score(only_first, only_second, pairs, difference)

    # At -1 and 1 the variance may vanish; there the limit is the bound itself.
    edge = 1 - 1e-12
    low, high = -1.0, 1.0
    if score(-edge) > quantile:
        low = float(brentq(lambda difference: score(difference) - quantile, -edge, min(value, edge)))
    if score(edge) < -quantile:
        high = float(brentq(lambda difference: score(difference) + quantile, max(value, -edge), edge))
    return Estimate(value, low, high)


def tango_score(only_first: float, only_second: float, pairs: int, difference: float) -> float:
    """The observed difference of paired rates less a supposed one, in its standard deviations."""
    # The likeliest share of pairs that only the second won, given the difference (a quadratic's root).
    linear = (2 * pairs - only_first + only_second) * difference - only_first - only_second
    constant = -only_second * difference * (1 - difference)
    share = (math.sqrt(max(linear**2 - 8 * pairs * constant, 0.0)) - linear) / (4 * pairs)
    variance = pairs * (2 * share + difference * (1 - difference))
    excess = only_first - only_second - pairs * difference
    return excess / math.sqrt(variance) if excess else 0.0  # both vanish where no pair is discordant


def p_of_loss(pairs: PairedDifference, loss: float) -> float:
    """The p value of "the first loses at least `loss` against the second", by Tango's score.

    It is below 2.5 % just where the 95 % interval excludes such a loss; Holm's method corrects it where many
    are compared with the same second.

    Example:
        >>> close = paired_difference([True] * 297 + [False] * 3, [True] * 300)
        >>> close.difference.low > -0.05, p_of_loss(close, 0.05) < 0.025
        (True, True)
    """
    return float(norm.sf(tango_score(pairs.only_first, pairs.only_second, pairs.pairs, -loss)))


def holm(p_values: Sequence[float]) -> list[float]:
    """P values corrected for their number by Holm's step-down method, in the order given.

    Example:
        >>> [round(p, 3) for p in holm([0.01, 0.04, 0.03])]
        [0.03, 0.06, 0.06]
    """
    corrected = [0.0] * len(p_values)
    largest = 0.0
    for rank, place in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[place]))
        corrected[place] = largest
    return corrected


def bootstrap(
    values: npt.ArrayLike,
    clusters: Sequence[Any] | npt.NDArray[Any],
    statistic: Statistic = np.mean,
    *,
    draws: int = 2000,
    seed: int = 0,
) -> Estimate:
    """A statistic with its percentile interval, drawing whole clusters with replacement.

    Chunks of one episode are alike, so episodes are drawn and not chunks. With fewer than about ten clusters
    the interval is too narrow; with one there is none (NaN). Where all values are equal it has no width,
    which is no proof of equality: rates and their differences belong to `wilson` and `paired_difference`.

    Args:
        values: `(observations, ...)`; the statistic gets the rows of the clusters drawn.
        clusters: of each observation, such as its episode; text or numbers, or tuples of them.
        statistic: a function of such rows; must not depend on their order.
        draws, seed: of the bootstrap.

    Example:
        >>> mean = bootstrap([1.0, 1.0, 3.0, 3.0], ["a", "a", "b", "b"])
        >>> mean.value, mean.low, mean.high
        (2.0, 1.0, 3.0)
    """
    rows = np.asarray(values)
    names = [tuple(name) if isinstance(name, (tuple, list)) else name for name in clusters]
    if len(names) != len(rows) or not names:
        raise InputError(
            f"clusters: given {len(names)} for {len(rows)} values, expected one for each, at least one"
        )
    if statistic is np.mean and rows.ndim == 1:
        return bootstrap_ratio(rows, np.ones(len(rows)), names, draws=draws, seed=seed)
    value = float(statistic(rows))
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    if len(numbers) < 2:
        return Estimate(value, math.nan, math.nan)
    number_of = np.array([numbers[name] for name in names])
    members = [np.flatnonzero(number_of == number) for number in range(len(numbers))]
    rng = np.random.default_rng(seed)
    drawn = []
    for _ in range(draws):
        chosen = rng.integers(len(members), size=len(members))
        drawn.append(float(statistic(rows[np.concatenate([members[one] for one in chosen])])))
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def bootstrap_ratio(
    parts: npt.ArrayLike, wholes: npt.ArrayLike, clusters: Sequence[Any], *, draws: int = 2000, seed: int = 0
) -> Estimate:
    """The sum of parts over the sum of wholes, with its percentile interval, drawing whole clusters.

    `bootstrap` for what is made of two sums, and much faster. With wholes of 1 it is the mean. NaN where the
    wholes add up to nothing.

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


def detectable_difference(pairs: int, discordant: float) -> float:
    """The smallest difference of two paired rates that McNemar's test finds with 80 % power at the 5 % level.

    From Connor's sample size (Biometrics 43, 1987), solved for the difference.

    Args:
        pairs: episodes that both arms have.
        discordant: share of pairs in which one succeeds and the other fails. Two arms that have nothing in
            common but a rate p have 2 p (1 - p).

    Returns:
        The difference of the rates; NaN if not even one as large as `discordant`, the largest there can be,
        would be found.

    Example:
        75 episodes an arm, of which a quarter go one way in one arm and the other way in the other:

        >>> round(detectable_difference(75, 0.25), 3)
        0.159
    """
    if pairs < 1 or not 0 < discordant <= 1:
        raise InputError(
            f"pairs, discordant: given {pairs} and {discordant}, expected at least 1, and a share above 0"
        )
    level, power = norm.ppf((1 + CONFIDENCE) / 2), norm.ppf(POWER)

    def shortfall(difference: float) -> float:
        needed = level * math.sqrt(discordant) + power * math.sqrt(discordant - difference**2)
        return float(needed - difference * math.sqrt(pairs))

    return float(brentq(shortfall, 0.0, discordant)) if shortfall(discordant) <= 0 else math.nan


def detectable_between_runs(rate: float, episodes: int, runs: int, run_deviation: float) -> float:
    """The smallest difference between two arms of trained policies found with 80 % power at the 5 % level.

    For a t test between the runs of the two arms, with as many runs in each: a run's measured rate varies by
    the episodes drawn and by the training itself, and that variance is told from the runs alone. Few runs
    tell it badly, which costs more than the variance does.

    Args:
        rate: success expected of both arms.
        episodes: of each run.
        runs: trained policies of each arm.
        run_deviation: standard deviation of the true rate between training seeds, a guess.

    Returns:
        The difference of the rates; NaN if none that rates can have would be found, as with a single run.

    Example:
        Two runs of 100 episodes each, at a rate of 50 % that varies by 4 points between training seeds, and
        then ten runs:

        >>> round(detectable_between_runs(0.5, 100, 2, 0.04), 2)
        0.36
        >>> round(detectable_between_runs(0.5, 100, 10, 0.04), 2)
        0.08
    """
    if not 0 <= rate <= 1 or episodes < 1 or runs < 1 or run_deviation < 0:
        raise InputError(
            f"rate, episodes, runs, run_deviation: given {rate}, {episodes}, {runs}, {run_deviation}; "
            "expected a share, two numbers of at least 1, and a number of at least 0"
        )
    if runs == 1:
        return math.nan
    error = math.sqrt(2 * (run_deviation**2 + rate * (1 - rate) / episodes) / runs)
    if error == 0:
        return 0.0
    freedom = 2 * (runs - 1)
    critical = t.ppf((1 + CONFIDENCE) / 2, freedom)

    def shortfall(difference: float) -> float:
        return POWER - float(nct.sf(critical, freedom, difference / error))

    return float(brentq(shortfall, 0.0, 1.0)) if shortfall(1.0) < 0 else math.nan
