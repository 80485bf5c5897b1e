"""The exact sign-flip test of paired differences, with the interval that it implies.

If the two sides of every pair are exchangeable, each difference is as likely as its negative. The test
compares the observed sum with the sums under all ``2^n`` patterns of signs, so it needs no distribution and
no variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from saccade.errors import InputError
from saccade_lab.study.statistics import CONFIDENCE, Estimate

MOST_PAIRS = 20  # a million patterns
ROUNDING = 1e-9  # of the sum of all absolute differences: sums that close are equal
SUMS_AT_ONCE = 2**22  # 32 MB


@dataclass(frozen=True)
class SignFlip:
    """Paired differences, and the test that they are symmetric around zero.

    Attributes:
        difference: Their mean, with the 95 % interval of ``sign_flip``.
        p_value: Two-sided, ``k / 2^n`` with an even ``k`` of at least 2.
        pairs: Their number.
    """

    difference: Estimate
    p_value: float
    pairs: int


def sign_flip(differences: npt.ArrayLike) -> SignFlip:
    """Tests whether paired differences are symmetric around zero, exactly.

    The p value is the share of all ``2^n`` patterns of signs whose sum is at least as far from zero as the
    observed one. The interval contains every shift that the same test does not reject at the 5 % level when
    it is subtracted from all differences. Both count the same subsets: a pattern that flips the signs of a
    subset is as extreme as the data exactly if the shift lies between the mean of the subset and that of the
    other differences. The interval therefore ends at such means and needs no search.

    With fewer than 6 pairs even the most extreme pattern has a p value above 5 %: nothing can be rejected,
    every shift is possible, and the bounds are NaN.

    Args:
        differences: ``(n,)``, one for each pair.

    Raises:
        InputError: There are none, more than ``MOST_PAIRS``, or they are not finite.

    Example:
        Two treatments of 10 patients, the extra hours of sleep (Student, Biometrika 6, 1908):

        >>> found = sign_flip([1.2, 2.4, 1.3, 1.3, 0.0, 1.0, 1.8, 0.8, 4.6, 1.4])
        >>> round(found.difference.value, 2), found.p_value
        (1.58, 0.00390625)
        >>> round(found.difference.low, 2), round(found.difference.high, 2)
        (0.83, 2.47)
    """
    values = checked(differences)
    if values.ndim != 1:
        raise InputError(f"differences: shape {values.shape}, expected (n,)")
    return SignFlip(
        Estimate(float(values.mean()), *interval(values)), float(sign_flip_p(values)), len(values)
    )


def sign_flip_p(differences: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The p values of ``sign_flip`` for many sets of differences at once.

    Args:
        differences: ``(..., n)``.

    Returns:
        ``(...)``.

    Raises:
        InputError: As ``sign_flip``.

    Example:
        >>> sign_flip_p([[1.0, 2.0, 3.0], [1.0, -2.0, 3.0]]).tolist()
        [0.25, 0.75]
    """
    values = checked(differences)
    rows = values.reshape(-1, values.shape[-1])
    found = np.empty(len(rows))
    patterns = 2 ** (rows.shape[1] - 1)  # the others are their negatives, with the same distance from zero
    for first in range(0, len(rows), max(1, SUMS_AT_ONCE // patterns)):
        some = rows[first : first + max(1, SUMS_AT_ONCE // patterns)]
        sums = some[:, :1]
        for column in some.T[1:]:
            sums = np.concatenate([sums + column[:, None], sums - column[:, None]], axis=1)
        distance = np.abs(some.sum(axis=1)) - ROUNDING * np.abs(some).sum(axis=1)
        found[first : first + len(some)] = (np.abs(sums) >= distance[:, None]).mean(axis=1)
    return found.reshape(values.shape[:-1])


def interval(values: npt.NDArray[np.float64]) -> tuple[float, float]:
    """The bounds of the interval of ``sign_flip``, NaN where it is unbounded.

    Args:
        values: The differences, ``(n,)``.
    """
    # Of each pair of complementary subsets one contains the first difference.
    sums, counts = values[:1], np.ones(1)
    for value in values[1:]:
        sums = np.concatenate([sums + value, sums])
        counts = np.concatenate([counts + 1, counts])
    sums, counts = sums[1:], counts[1:]  # without all of them, whose complement is empty
    inside, outside = sums / counts, (values.sum() - sums) / (len(values) - counts)
    # All these ranges contain the mean of all, so a shift is in fewer of them the further away it is. It is
    # rejected where 1 + their number is at most 5 % of all pairs of subsets.
    rank = math.floor((1 - CONFIDENCE) * (len(sums) + 1) + ROUNDING)
    if rank == 0:
        return math.nan, math.nan
    low = np.partition(np.minimum(inside, outside), rank - 1)[rank - 1]
    high = np.partition(np.maximum(inside, outside), -rank)[-rank]
    return float(low), float(high)


def checked(differences: npt.ArrayLike | Sequence[float]) -> npt.NDArray[np.float64]:
    """The differences as an array ``(..., n)``; raises as ``sign_flip``."""
    values = np.asarray(differences, dtype=np.float64)
    if values.ndim == 0 or not 1 <= values.shape[-1] <= MOST_PAIRS:
        raise InputError(f"differences: shape {values.shape}, expected 1 to {MOST_PAIRS} pairs")
    if not np.isfinite(values).all():
        raise InputError("differences: expected finite numbers")
    return values
