"""What the study compares: sums of weighted success rates of policies of one training seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from why_32.plan import LATER_SEEDS, SEEDS

#: A difference of success rates that would matter. Smaller ones count as none.
MARGIN = 0.10
CORE = {"n-0": 0, "n-4": 4, "n-32": 32}  # N of the recipes of the confirmatory tests
#: N of the recipes that the later stages are compared with, and of those with other numbers.
SCALED = {f"n-{count}-scaled": count for count in (0, 1, 4, 16, 32, 64)}
LONGER = {"n-0-long": 0, "n-32-long": 32}  # N of the recipes that are trained for longer
#: The training seeds of `LONGER` that were added because of the others. They are tested alone.
NEW_SEEDS = SEEDS[len(LATER_SEEDS) :]
#: What is concluded from a contrast. `interval`: what its interval shows. `test`: what its p value shows.
#: `estimate`: nothing, since some of its training seeds were run because of the others. The last two need all
#: their training seeds.
Use: TypeAlias = Literal["interval", "test", "estimate"]


@dataclass(frozen=True)
class Contrast:
    """A number that is computed from the success rates of policies of one training seed.

    Attributes:
        name: What it is, for tables.
        weights: The weight of each recipe.
        margin: The smallest absolute value that would matter.
        unit: What a value of 1 is 100 of.
        seeds: The training seeds that it is restricted to; empty for all that are there.
        use: What is concluded from it. Other ones than `interval` have `seeds`.
    """

    name: str
    weights: Mapping[str, float]
    margin: float = MARGIN
    unit: str = "points"
    seeds: tuple[int, ...] = ()
    use: Use = "interval"

    @property
    def recipes(self) -> tuple[str, ...]:
        """The recipes that it needs."""
        return tuple(self.weights)

    def of(self, rates: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Its values.

        Args:
            rates: Success rates of `recipes`, `(..., recipes)`.

        Returns:
            `(...)`, where equal rates give exactly 0, so that rounding has no sign that a test could see.
        """
        return np.asarray(np.round(rates @ np.array(list(self.weights.values())), 12))


def difference(second: str, first: str) -> Contrast:
    """The success of one recipe minus that of another."""
    return Contrast(f"{second} minus {first}", {second: 1.0, first: -1.0})


def estimate(contrast: Contrast) -> Contrast:
    """A contrast over all training seeds. Nothing is concluded from it: some were run because of others."""
    return replace(contrast, name=f"{contrast.name}, all twelve: estimate", seeds=SEEDS, use="estimate")


def in_parts(contrast: Contrast) -> tuple[Contrast, ...]:
    """A contrast over the first training seeds, over those of `NEW_SEEDS`, and over both."""
    return (
        replace(contrast, name=f"{contrast.name}, first six", seeds=LATER_SEEDS),
        replace(contrast, name=f"{contrast.name}, new six: tested", seeds=NEW_SEEDS, use="test"),
        estimate(contrast),
    )


def interaction(contrast: Contrast, reference: Contrast) -> Contrast:
    """One difference of recipes minus another.

    Example:
        >>> found = interaction(difference("b", "a"), difference("d", "c"))
        >>> found.name, found.weights
        ('(b minus a) minus (d minus c)', {'b': 1.0, 'a': -1.0, 'd': -1.0, 'c': 1.0})
    """
    weights = {**contrast.weights, **{name: -weight for name, weight in reference.weights.items()}}
    return Contrast(f"({contrast.name}) minus ({reference.name})", weights)


def within(suffix: str) -> tuple[Contrast, ...]:
    """What 32 tokens instead of 4 change in policies of another kind, alone and against those of `SCALED`."""
    found = difference(f"n-32{suffix}", f"n-4{suffix}")
    return found, interaction(found, difference("n-32-scaled", "n-4-scaled"))


def slope(counts: Mapping[str, int]) -> Contrast:
    """The least-squares slope of success over log2(N + 1).

    Its margin is that of the difference between the smallest and the largest N.

    Args:
        counts: N of each recipe.

    Example:
        >>> found = slope({"none": 0, "one": 1, "three": 3})
        >>> found.weights, found.margin
        ({'none': -0.5, 'one': 0.0, 'three': 0.5}, 0.05)
    """
    x = np.log2(np.array(list(counts.values())) + 1.0)
    weights = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    shown = ", ".join(map(str, counts.values()))
    return Contrast(
        f"slope over log2(N + 1), N = {shown}",
        dict(zip(counts, weights.tolist(), strict=True)),
        MARGIN / float(x.max() - x.min()),
        "points per unit of log2(N + 1)",
    )


#: The tests that were decided beforehand: the primary one, then the secondary ones. Holm's correction is over
#: all three.
CONFIRMATORY = (difference("n-32", "n-0"), difference("n-32", "n-4"), slope(CORE))

#: Everything else, by stage: intervals, and one test, of the pairs that were added.
EXPLORATORY: dict[str, tuple[Contrast, ...]] = {
    "scaled": (
        difference("n-32-scaled", "n-0-scaled"),
        difference("n-32-scaled", "n-4-scaled"),
        difference("n-4-scaled", "n-0-scaled"),
        difference("n-0-scaled", "n-0"),
        difference("n-4-scaled", "n-4"),
        difference("n-32-scaled", "n-32"),
        difference("n-4", "n-0"),
        interaction(difference("n-32-scaled", "n-0-scaled"), difference("n-32", "n-0")),
    ),
    "alignment": (
        difference("n-4-aligned", "n-4-scaled"),
        difference("n-32-aligned", "n-32-scaled"),
        difference("n-32-aligned", "n-4-aligned"),
        difference("n-32-aligned", "n-0-scaled"),
    ),
    "numbers": (
        difference("n-1-scaled", "n-0-scaled"),
        difference("n-16-scaled", "n-4-scaled"),
        difference("n-64-scaled", "n-32-scaled"),
        slope(SCALED),
    ),
    "compute": (
        difference("n-32-scaled", "n-0-wide"),
        difference("n-32-scaled", "n-0-long"),
        difference("n-0-wide", "n-0-scaled"),
        difference("n-0-long", "n-0-scaled"),
        *in_parts(difference("n-32-long", "n-0-long")),
        estimate(interaction(difference("n-32-long", "n-0-long"), difference("n-32-scaled", "n-0-scaled"))),
    ),
    "patch-32": within("-patch-32"),
    "vlsa": (*within("-vlsa-0"), *within("-vlsa-4")),
    "patch-8": within("-patch-8"),
    "two-cameras": within("-two-cameras"),
    "aligned-again": (difference("n-32-aligned-again", "n-4-aligned-again"),),
}
