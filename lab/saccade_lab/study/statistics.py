"""Confidence intervals for rates, paired differences and means over episodes; verdicts; statistical power."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import scipy  # its parts are imported when they are used: that takes longer than most commands

from saccade._internal.bootstrap import CONFIDENCE as CONFIDENCE
from saccade._internal.bootstrap import Estimate as Estimate
from saccade._internal.bootstrap import bootstrap as bootstrap
from saccade._internal.bootstrap import bootstrap_ratio as bootstrap_ratio
from saccade.errors import InputError
from saccade_lab import intervals as _intervals

POWER = 0.8
LOSS_THAT_MATTERS = 0.05  # of the success rate: 5 percentage points
Verdict: TypeAlias = Literal["better", "worse", "no worse", "undecided"]


def verdict(difference: Estimate) -> Verdict:
    """What the 95 % interval of a difference of success rates shows.

    The first of these rules that holds decides:

    1. ``better``: the whole interval is above zero.
    2. ``worse``: the whole interval is below zero, even if it excludes a loss of ``LOSS_THAT_MATTERS``.
    3. ``no worse``: the interval contains zero and excludes a loss of ``LOSS_THAT_MATTERS``.
    4. ``undecided``: anything else, and a difference without an interval.

    Example:
        >>> [verdict(Estimate((low + high) / 2, low, high))
        ...  for low, high in ((0.01, 0.03), (-0.04, -0.01), (-0.04, 0.02), (-0.06, 0.02))]
        ['better', 'worse', 'no worse', 'undecided']
    """
    if difference.low > 0:
        return "better"
    if difference.high < 0:
        return "worse"
    if difference.low > -LOSS_THAT_MATTERS:
        return "no worse"
    return "undecided"


@dataclass(frozen=True)
class PairedDifference:
    """Success of two arms on the same episodes.

    Attributes:
        difference: Success rate of the first arm minus that of the second, with Tango's score interval.
        pairs: Number of episodes that both arms ran.
        both, only_first, only_second, neither: Number of episodes in which both arms succeeded, only one of
            them, or none. Only the discordant pairs (``only_first``, ``only_second``) distinguish the arms.
        p_value: P value of McNemar's exact test.
    """

    difference: Estimate
    pairs: int
    both: int
    only_first: int
    only_second: int
    neither: int
    p_value: float


def scaled(value: Estimate) -> Estimate:
    """A fraction in percent."""
    return Estimate(100 * value.value, 100 * value.low, 100 * value.high)


def wilson(successes: int, trials: int) -> Estimate:
    """A success rate with Wilson's score interval; without trials, NaN with the interval 0 to 1.

    Raises:
        InputError: ``successes`` is negative or larger than ``trials``.

    Example:
        >>> rate = wilson(18, 20)
        >>> rate.value, round(rate.low, 3), round(rate.high, 3)
        (0.9, 0.699, 0.972)
    """
    low, high = _intervals.wilson(successes, trials)
    return Estimate(successes / trials if trials else math.nan, low, high)


def paired_difference(first: Sequence[bool], second: Sequence[bool]) -> PairedDifference:
    """Compares the success of two arms on the same episodes.

    The interval is Tango's score interval (Statistics in Medicine 17, 1998). Unlike the intervals of Wald
    and Newcombe it has a positive width when no pair is discordant, so equal results do not look like proof
    of equality.

    Args:
        first, second: Success of each arm, episode by episode in the same order.

    Raises:
        InputError: The lengths differ, or there are no pairs.

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
        p_value=float(scipy.stats.binomtest(only_first, discordant).pvalue) if discordant else 1.0,
    )


def tango(only_first: float, only_second: float, pairs: int) -> Estimate:
    """The difference of two paired rates with Tango's score interval, from the discordant pairs.

    Args:
        only_first, only_second: Number of pairs in which only the first, or only the second, succeeded.
        pairs: Number of all pairs.

    Example:
        Response to a therapy, before and after (Cavo and others, Blood 120, 2012):

        >>> found = tango(6, 16, 161)
        >>> [round(number, 4) for number in (found.value, found.low, found.high)]
        [-0.0621, -0.124, -0.0054]
    """
    quantile = float(scipy.stats.norm.ppf((1 + CONFIDENCE) / 2))
    value = (only_first - only_second) / pairs

    def score(difference: float) -> float:
        return tango_score(only_first, only_second, pairs, difference)

    # At -1 and 1 the variance may be zero; the limit is then -1 or 1 itself.
    edge = 1 - 1e-12
    low, high = -1.0, 1.0
    if score(-edge) > quantile:
        low = float(
            scipy.optimize.brentq(lambda difference: score(difference) - quantile, -edge, min(value, edge))
        )
    if score(edge) < -quantile:
        high = float(
            scipy.optimize.brentq(lambda difference: score(difference) + quantile, max(value, -edge), edge)
        )
    return Estimate(value, low, high)


def tango_score(only_first: float, only_second: float, pairs: int, difference: float) -> float:
    """Tango's test statistic: the observed difference minus the hypothesised one, in standard errors."""
    # Maximum-likelihood share of pairs that only the second won, given the difference (root of a quadratic).
    linear = (2 * pairs - only_first + only_second) * difference - only_first - only_second
    constant = -only_second * difference * (1 - difference)
    share = (math.sqrt(max(linear**2 - 8 * pairs * constant, 0.0)) - linear) / (4 * pairs)
    variance = pairs * (2 * share + difference * (1 - difference))
    excess = only_first - only_second - pairs * difference
    return excess / math.sqrt(variance) if excess else 0.0  # both are zero where no pair is discordant


def p_of_loss(pairs: PairedDifference, loss: float) -> float:
    """One-sided p value of the hypothesis that the first arm is worse by at least ``loss``, by Tango's score.

    It is below 2.5 % exactly where the 95 % interval excludes such a loss. Correct it with ``holm`` when
    several arms are compared with the same second arm.

    Example:
        >>> close = paired_difference([True] * 297 + [False] * 3, [True] * 300)
        >>> close.difference.low > -0.05, p_of_loss(close, 0.05) < 0.025
        (True, True)
    """
    return float(scipy.stats.norm.sf(tango_score(pairs.only_first, pairs.only_second, pairs.pairs, -loss)))


def holm(p_values: Sequence[float]) -> list[float]:
    """P values corrected for multiple comparisons by Holm's step-down method, in the given order.

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


def detectable_difference(pairs: int, discordant: float) -> float:
    """The smallest difference of two paired rates that McNemar's test detects: 80 % power, 5 % level.

    Connor's formula for the sample size (Biometrics 43, 1987), solved for the difference.

    Args:
        pairs: Number of episodes that both arms run.
        discordant: Fraction of pairs in which exactly one arm succeeds. Two independent arms with the same
            success rate p have 2 p (1 - p).

    Returns:
        The difference of the rates. NaN if even the largest possible one, ``discordant``, is not detected.

    Raises:
        InputError: ``pairs`` is below 1, or ``discordant`` is outside (0, 1].

    Example:
        75 episodes per arm, a quarter of them with different outcomes:

        >>> round(detectable_difference(75, 0.25), 3)
        0.159
    """
    if pairs < 1 or not 0 < discordant <= 1:
        raise InputError(
            f"pairs, discordant: given {pairs} and {discordant}, expected at least 1 and a fraction above 0"
        )
    level, power = scipy.stats.norm.ppf((1 + CONFIDENCE) / 2), scipy.stats.norm.ppf(POWER)

    def shortfall(difference: float) -> float:
        needed = level * math.sqrt(discordant) + power * math.sqrt(discordant - difference**2)
        return float(needed - difference * math.sqrt(pairs))

    return (
        float(scipy.optimize.brentq(shortfall, 0.0, discordant)) if shortfall(discordant) <= 0 else math.nan
    )


def detectable_between_runs(rate: float, episodes: int, runs: int, run_deviation: float) -> float:
    """The smallest difference between two arms of trained policies that is detected: 80 % power, 5 % level.

    For a t test between the runs of two arms with the same number of runs. A run's measured rate varies with
    the sampled episodes and with the training itself, and the test estimates this variance from the runs
    alone. With few runs the estimate is poor, which costs more power than the variance itself.

    Args:
        rate: Expected success rate of both arms.
        episodes: Episodes of each run.
        runs: Trained policies of each arm.
        run_deviation: Assumed standard deviation of the true success rate between training seeds.

    Returns:
        The difference of the rates. NaN if no possible difference is detected, as with a single run.

    Raises:
        InputError: An argument is out of range.

    Example:
        Two runs, then ten runs, of 100 episodes each, at a rate of 50 % with a standard deviation of 4
        points between training seeds:

        >>> round(detectable_between_runs(0.5, 100, 2, 0.04), 2)
        0.36
        >>> round(detectable_between_runs(0.5, 100, 10, 0.04), 2)
        0.08
    """
    if not 0 <= rate <= 1 or episodes < 1 or runs < 1 or run_deviation < 0:
        raise InputError(
            f"rate, episodes, runs, run_deviation: given {rate}, {episodes}, {runs}, {run_deviation}; "
            "expected a fraction, two numbers of at least 1, and a number of at least 0"
        )
    if runs == 1:
        return math.nan
    error = math.sqrt(2 * (run_deviation**2 + rate * (1 - rate) / episodes) / runs)
    if error == 0:
        return 0.0
    freedom = 2 * (runs - 1)
    critical = scipy.stats.t.ppf((1 + CONFIDENCE) / 2, freedom)

    def shortfall(difference: float) -> float:
        return POWER - float(scipy.stats.nct.sf(critical, freedom, difference / error))

    return float(scipy.optimize.brentq(shortfall, 0.0, 1.0)) if shortfall(1.0) < 0 else math.nan
