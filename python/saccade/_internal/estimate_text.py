"""Numbers and their intervals as text, and what to know about intervals over few episodes."""

from __future__ import annotations

import math
from collections.abc import Iterable

#: With fewer clusters a percentile interval of the bootstrap is too narrow.
ENOUGH = 10
NONE = "–"  # what is written where there is no number


def number(value: float, form: str) -> str:
    """A number in a format; a dash if it is NaN.

    Example:
        >>> number(0.256, ".2f"), number(float("nan"), ".2f")
        ('0.26', '–')
    """
    return NONE if math.isnan(value) else format(value, form)


def interval(low: float, high: float, form: str) -> str:
    """An interval; a dash if it has no bounds, as over one episode.

    Example:
        >>> interval(0.1, 0.25, ".2f"), interval(float("nan"), float("nan"), ".2f")
        ('0.10 to 0.25', '–')
    """
    if math.isnan(low) or math.isnan(high):
        return NONE
    return f"{low:{form}} to {high:{form}}"


def caution(episodes: Iterable[int]) -> str:
    """What to know about intervals over few episodes; empty if there are enough.

    Args:
        episodes: Number of episodes of each interval that is shown.

    Example:
        >>> caution([6])
        'The intervals are over 6 episodes: with fewer than 10 they are too narrow.'
        >>> caution([20, 4, 7])
        'Some intervals are over 4 to 7 episodes: with fewer than 10 they are too narrow.'
        >>> caution([1]), caution([10, 20]), caution([])
        ('One episode has no interval.', '', '')
    """
    counts = sorted(set(episodes))
    few = [count for count in counts if count < ENOUGH]
    if not few:
        return ""
    if counts == [1]:
        return "One episode has no interval."
    those = "The" if few == counts else "Some"
    span = str(few[0]) if len(few) == 1 else f"{few[0]} to {few[-1]}"
    return f"{those} intervals are over {span} episodes: with fewer than {ENOUGH} they are too narrow."
