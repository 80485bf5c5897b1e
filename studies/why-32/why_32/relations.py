"""Which cheap measure of a policy predicts what a cut costs it in success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from saccade_lab.study.section import FEWEST
from saccade_lab.study.statistics import Estimate
from why_32.contrasts import EXPLORATORY
from why_32.correlations import correlated, correlated_within
from why_32.measures import CUT, MEASURES, NAMES
from why_32.plan import CORE_STAGE
from why_32.results import Judged, judged

Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Relation:
    """How well a measure of policies predicts what a cut does to their success.

    Attributes:
        measure: Its name in `measures.NAMES`.
        policies, seeds: Number of policies, and of their training seeds.
        within: The rank correlation with the success that the cut costs, among policies of the same recipe;
            see `correlations.correlation_within`. NaN where one of the two is the same within each recipe.
        together: That over all policies, of any N, so that it may be one of N alone.
    """

    measure: str
    policies: int
    seeds: int
    within: Estimate
    together: Estimate

    @property
    def predicts(self) -> bool:
        """Whether the measure is correlated with the cost among policies of the same recipe: the interval
        excludes zero, over enough training seeds.
        """
        return self.seeds >= FEWEST and excludes_zero(self.within)

    @property
    def tells_recipes(self) -> bool:
        """Whether it is shown to be correlated over all policies together only."""
        return not self.predicts and self.policies >= FEWEST and excludes_zero(self.together)


def excludes_zero(found: Estimate) -> bool:
    """Whether an interval excludes zero; False without an interval."""
    return found.low > 0 or found.high < 0


def relations(
    table: pd.DataFrame,
    found: Judged,
    tasks: Sequence[str],
    seeds: Sequence[int],
    stages: Sequence[str] = (CORE_STAGE, *EXPLORATORY),
) -> list[Relation]:
    """The relations of all measures, over the policies that are measured and judged with and without the cut.

    Args:
        table, tasks, seeds: As of `results.judged`.
        found: The unchanged policies.
        stages: The stages whose policies are used.
    """
    rows = table[table["kind"] == MEASURES]
    rows = rows[rows["stage"].isin(stages)] if len(rows) else rows
    if rows.empty:
        return []
    cut = judged(table, tasks, seeds, CUT).rates
    results = []
    for name in NAMES:
        pairs: dict[tuple[str, int], tuple[float, float]] = {}
        for _, row in rows[rows[name].notna()].iterrows():
            recipe, seed = str(row["recipe"]), int(row["training_seed"])
            if seed in cut.get(recipe, {}) and seed in found.rates.get(recipe, {}):
                lost = round(found.rates[recipe][seed] - cut[recipe][seed], 12)
                pairs[recipe, seed] = (float(row[name]), lost)
        if pairs:
            values = by_seed(pairs)
            together = correlated(np.array(list(pairs.values())))
            results.append(Relation(name, len(pairs), len(values), correlated_within(values), together))
    return results


def by_seed(pairs: Mapping[tuple[str, int], tuple[float, float]]) -> Float64Array:
    """Two numbers of each policy as `(training seeds, recipes, 2)`, NaN where there is no policy.

    Args:
        pairs: By recipe and training seed.
    """
    recipes = list(dict.fromkeys(recipe for recipe, _ in pairs))
    seeds = sorted({seed for _, seed in pairs})
    values = np.full((len(seeds), len(recipes), 2), np.nan)
    for (recipe, seed), pair in pairs.items():
        values[seeds.index(seed), recipes.index(recipe)] = pair
    return values
