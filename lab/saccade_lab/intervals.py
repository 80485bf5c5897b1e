"""The confidence interval of a success rate, for rollouts and studies."""

from __future__ import annotations

import math
from statistics import NormalDist

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
    z = NormalDist().inv_cdf((1 + CONFIDENCE) / 2)
    rate = successes / trials
    middle = 2 * trials * rate + z**2
    half = z * math.sqrt(4 * trials * rate * (1 - rate) + z**2)
    low, high = ((middle + side * half) / (2 * (trials + z**2)) for side in (-1, 1))
    return (low if successes else 0.0), (high if successes < trials else 1.0)
