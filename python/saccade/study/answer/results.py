"""The analysis of `saccade study answer`, from its table alone: policies are paired by training seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pandas as pd

from saccade.errors import InputError
from saccade.study.sign_flip import SignFlip, sign_flip
from saccade.study.statistics import holm
from saccade.study.table import truths

PLAIN = "plain"  # the arm of an unchanged policy
CORE = {"n-0": 0, "n-4": 4, "n-32": 32}  # N of the recipes of the confirmatory tests
Float64Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Contrast:
    """A number that is computed from the success rates of policies of one training seed.

    Attributes:
        name: What it is, for tables.
        recipes: The recipes that it needs.
        function: Function from their rates `(..., recipes)` to `(...)`.
    """

    name: str
    recipes: tuple[str, ...]
    function: Callable[[Float64Array], Float64Array]


def difference(second: str, first: str) -> Contrast:
    """The success of one recipe minus that of another."""
    return Contrast(f"{second} minus {first}", (first, second), lambda rates: rates[..., 1] - rates[..., 0])


def slope(counts: Mapping[str, int]) -> Contrast:
    """The least-squares slope of success over log2(N + 1).

    Args:
        counts: N of each recipe.

    Example:
        >>> float(slope({"none": 0, "one": 1, "three": 3}).function(np.array([0.1, 0.2, 0.3])).round(6))
        0.1
    """
    x = np.log2(np.array(list(counts.values())) + 1.0)
    weights = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    return Contrast("slope over log2(N + 1)", tuple(counts), lambda rates: rates @ weights)


#: The tests that were decided beforehand: the primary one, then the secondary ones. Holm's correction is over
#: all three.
CONFIRMATORY = (difference("n-32", "n-0"), difference("n-32", "n-4"), slope(CORE))


@dataclass(frozen=True)
class Missing:
    """A policy that is not used.

    Attributes:
        policy: Its name.
        done, all: Number of its episodes, and of those that it should have run.
    """

    policy: str
    done: int
    all: int


@dataclass(frozen=True)
class Judged:
    """The success of complete policies.

    Attributes:
        rates: Mean over tasks of the success rate, by recipe and training seed.
        missing: Policies that lack episodes.
    """

    rates: Mapping[str, Mapping[int, float]]
    missing: Sequence[Missing]

    def paired(self, recipes: Sequence[str]) -> tuple[list[int], Float64Array]:
        """The training seeds that all recipes have, and their rates `(seeds, recipes)`."""
        have = [set(self.rates.get(recipe, {})) for recipe in recipes]
        seeds = sorted(set.intersection(*have))
        rates = [[self.rates[recipe][seed] for recipe in recipes] for seed in seeds]
        return seeds, np.array(rates, dtype=float).reshape(len(seeds), len(recipes))


@dataclass(frozen=True)
class ContrastResult:
    """A contrast, tested over training seeds.

    Attributes:
        contrast: What was tested.
        seeds: The training seeds that were used.
        unpaired: Those that some of the recipes have and others lack.
        values: The contrast at each seed.
        test: The exact test, or None without a seed.
        corrected: Its p value after Holm's correction; None if the test is exploratory.
    """

    contrast: Contrast
    seeds: Sequence[int]
    unpaired: Sequence[int]
    values: Sequence[float]
    test: SignFlip | None
    corrected: float | None = None


def judged(table: pd.DataFrame, tasks: Sequence[str], seeds: Sequence[int], arm: str = PLAIN) -> Judged:
    """The success rates of policies, each task weighted alike.

    Args:
        table: Table of the study.
        tasks, seeds: The episodes of every policy.
        arm: What was done to the policies.

    Raises:
        InputError: an episode is in the table twice, or is not one of those.
    """
    expected = len(tasks) * len(seeds)
    trained = table[table["kind"] == "training"]
    episodes = table[(table["kind"] == "episodes") & (table["arm"] == arm)] if "arm" in table else trained[:0]
    rates: dict[str, dict[int, float]] = {}
    missing = []
    for policy, row in trained.set_index("policy").iterrows():
        rows = episodes[episodes["policy"] == policy]
        pairs = set(zip(rows["task"], rows["seed"], strict=True)) if len(rows) else set()
        if len(pairs) != len(rows) or not pairs <= {(task, seed) for task in tasks for seed in seeds}:
            raise InputError(f"episodes: those of {policy} are not distinct ones of the plan")
        if len(rows) < expected:
            missing.append(Missing(str(policy), len(rows), expected))
            continue
        by_task = rows.assign(success=truths(rows["success"])).groupby("task")["success"].mean()
        rates.setdefault(str(row["recipe"]), {})[int(row["training_seed"])] = float(by_task.mean())
    return Judged(rates, missing)


def over_seeds(found: Judged, contrast: Contrast) -> ContrastResult:
    """Tests a contrast over the training seeds for which all its recipes are complete."""
    seeds, rates = found.paired(contrast.recipes)
    have = [set(found.rates.get(recipe, {})) for recipe in contrast.recipes]
    values = contrast.function(rates)
    test = sign_flip(values) if seeds else None
    return ContrastResult(contrast, seeds, sorted(set.union(*have) - set(seeds)), list(values), test)


def confirmed(found: Judged) -> list[ContrastResult]:
    """The confirmatory tests, with Holm's correction over all of them.

    A test without a pair counts as one with p = 1, so that the others are corrected as planned.
    """
    results = [over_seeds(found, contrast) for contrast in CONFIRMATORY]
    corrected = holm([1.0 if one.test is None else one.test.p_value for one in results])
    return [replace(one, corrected=p) for one, p in zip(results, corrected, strict=True)]
