"""The confidence interval of a success rate, for rollouts and studies."""

from __future__ import annotations

import scipy  # scipy.stats is imported when it is used: it takes longer than most commands

from saccade._internal.bootstrap import CONFIDENCE
from saccade.errors import InputError


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a success rate; 0 to 1 without trials.

    Raises:
        InputError: ``successes`` is negative or larger than ``trials``.

    Example:
        >>> [round(bound, 3) for bound in wilson(18, 20)]
        [0.699, 0.972]
    """
    if not 0 <= successes <= trials:
        raise InputError(f"successes: given {successes} of {trials} trials, expected 0 to {trials}")
    if trials == 0:
        return 0.0, 1.0
    interval = scipy.stats.binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)
