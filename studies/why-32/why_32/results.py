"""The analysis of the study, from its table alone: policies are paired by training seed."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import pandas as pd

from saccade.errors import InputError
from saccade_lab.study.questions.sweeps_results import PLAIN
from saccade_lab.study.sign_flip import SignFlip, sign_flip
from saccade_lab.study.statistics import CONFIDENCE, Estimate, holm
from saccade_lab.study.table import truths
from why_32.arms import ARMS
from why_32.contrasts import CONFIRMATORY, EXPLORATORY, MARGIN, Contrast
from why_32.correlations import correlated
from why_32.measured import MEASURED
from why_32.plan import CORE_STAGE, PILOT, Plan
from why_32.times import TIMES

Float64Array = npt.NDArray[np.float64]
#: In words: `more` or `less` for a contrast that is not zero, `small` for one within its margin.
Finding: TypeAlias = Literal["more", "less", "small", "undecided", "not measured", "estimate"]
#: A policy whose held-out loss is above this counts as one that stopped on the first plateau of its training.
#: Chosen after the core was seen, whose losses are below 0.13 or above 0.20.
PLATEAU = 0.15


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
        rates: Mean over tasks of the success rate, by recipe, in the order of stage and N, and training seed.
        missing: Policies that lack episodes.
    """

    rates: Mapping[str, Mapping[int, float]]
    missing: Sequence[Missing]

    def paired(
        self, recipes: Sequence[str], among: Collection[int] = ()
    ) -> tuple[list[int], list[int], Float64Array]:
        """The training seeds that all recipes have, those that only some have, and rates `(seeds, recipes)`.

        Args:
            recipes: Their names.
            among: The training seeds that count; empty for all.
        """
        have = [{seed for seed in self.rates.get(one, {}) if not among or seed in among} for one in recipes]
        seeds = sorted(set.intersection(*have))
        rates = [[self.rates[recipe][seed] for recipe in recipes] for seed in seeds]
        found = np.array(rates, dtype=float).reshape(len(seeds), len(recipes))
        return seeds, sorted(set.union(*have) - set(seeds)), found


@dataclass(frozen=True)
class ContrastResult:
    """A contrast, tested over training seeds.

    Attributes:
        contrast: What was tested.
        seeds: The training seeds that were used.
        unpaired: Those that some of the recipes have and others lack.
        values: The contrast at each seed.
        test: The exact test, or None without a seed; for a contrast that needs all its training seeds, None
            without one of them.
        corrected: Its p value after Holm's correction; None if the test is exploratory.
    """

    contrast: Contrast
    seeds: Sequence[int]
    unpaired: Sequence[int]
    values: Sequence[float]
    test: SignFlip | None
    corrected: float | None = None

    @property
    def finding(self) -> Finding:
        """What the result shows, by rules that were decided beforehand. The first that holds decides:

        1. `not measured`: no training seed has all policies.
        2. `more`, `less`: a confirmatory test rejects at the 5 % level after Holm's correction; for an
           exploratory contrast, its interval excludes zero.
        3. `small`: the interval is inside the margin on both sides.
        4. `undecided`: anything else, and whatever has no interval.

        A contrast with a test of its own has `more` or `less` if this rejects at the 5 % level, and is
        `undecided` otherwise. One that is only an `estimate` has no other finding.
        """
        if self.test is None:
            return "not measured"
        if self.contrast.use == "estimate":
            return "estimate"
        found, margin = self.test.difference, self.contrast.margin
        if self.contrast.use == "test":
            rejected = self.test.p_value <= 1 - CONFIDENCE
            return ("more" if found.value > 0 else "less") if rejected else "undecided"
        if self.corrected is None:
            return finding(found, margin)
        if self.corrected <= 1 - CONFIDENCE:
            return "more" if found.value > 0 else "less"
        return "small" if inside(found, margin) else "undecided"

    @property
    def inside(self) -> bool:
        """Whether the interval is inside the margin on both sides, whatever the finding."""
        return self.test is not None and inside(self.test.difference, self.contrast.margin)


def inside(found: Estimate, margin: float) -> bool:
    """Whether an interval excludes the margin on both sides; False without an interval."""
    return not math.isnan(found.low) and max(-found.low, found.high) < margin


def finding(found: Estimate, margin: float = MARGIN) -> Finding:
    """What an exploratory estimate shows, by the rules of `ContrastResult.finding`.

    Example:
        >>> [finding(Estimate((low + high) / 2, low, high))
        ...  for low, high in ((0.02, 0.2), (-0.2, -0.02), (-0.05, 0.05), (-0.05, 0.15))]
        ['more', 'less', 'small', 'undecided']
    """
    if found.low > 0 or found.high < 0:
        return "more" if found.value > 0 else "less"
    return "small" if inside(found, margin) else "undecided"


def judged(table: pd.DataFrame, tasks: Sequence[str], seeds: Sequence[int], arm: str = PLAIN) -> Judged:
    """The success rates of policies, each task weighted alike; pilots are left out.

    Args:
        table: Table of the study.
        tasks, seeds: The episodes of every policy.
        arm: What was done to the policies.

    Raises:
        InputError: an episode is in the table twice, or is not one of those.
    """
    if "stage" not in table:  # no policy is trained
        return Judged({}, [])
    expected = len(tasks) * len(seeds)
    trained = table[(table["kind"] == "training") & (table["stage"] != PILOT)]
    episodes = table[(table["kind"] == "episodes") & (table["arm"] == arm)] if "arm" in table else trained[:0]
    rates: dict[str, dict[int, float]] = {}
    missing = []
    by_policy = {str(name): rows for name, rows in episodes.groupby("policy")} if len(episodes) else {}
    for policy, row in ordered(trained).set_index("policy").iterrows():
        rows = by_policy.get(str(policy), episodes[:0])
        pairs = set(zip(rows["task"], rows["seed"], strict=True)) if len(rows) else set()
        if len(pairs) != len(rows) or not pairs <= {(task, seed) for task in tasks for seed in seeds}:
            raise InputError(f"episodes: those of {policy} are not distinct ones of the plan")
        if len(rows) < expected:
            missing.append(Missing(str(policy), len(rows), expected))
            continue
        by_task = rows.assign(success=truths(rows["success"])).groupby("task")["success"].mean()
        rates.setdefault(str(row["recipe"]), {})[int(row["training_seed"])] = float(by_task.mean())
    return Judged(rates, missing)


def judged_by_task(table: pd.DataFrame, tasks: Sequence[str], seeds: Sequence[int]) -> dict[str, Judged]:
    """The success rates of the unchanged policies in each task alone; see `judged`."""
    other = {task: (table["kind"] == "episodes") & (table["task"] != task) for task in tasks}
    return {task: judged(table[~other[task]], [task], seeds) for task in tasks}


@dataclass(frozen=True)
class Losses:
    """Held-out loss and success of the core's policies.

    Attributes:
        policies: By recipe, `(policies, 2)`: loss, and success rate.
        correlation: Their rank correlation over all policies; NaN where one of the two is the same for all.
    """

    policies: Mapping[str, Float64Array]
    correlation: Estimate


def losses(table: pd.DataFrame, found: Judged) -> Losses:
    """Held-out loss and success of the core's policies.

    Args:
        table: Table of the study.
        found: The unchanged policies, with at least one of the core.
    """
    of_core = table[(table["kind"] == "training") & (table["stage"] == CORE_STAGE)]
    policies: dict[str, list[tuple[float, float]]] = {}
    for _, row in ordered(of_core).iterrows():
        rate = found.rates.get(str(row["recipe"]), {}).get(int(row["training_seed"]))
        if rate is not None:
            policies.setdefault(str(row["recipe"]), []).append((float(row["validation_loss"]), rate))
    arrays = {recipe: np.array(pairs) for recipe, pairs in policies.items()}
    pairs = np.concatenate(list(arrays.values()))
    return Losses(arrays, correlated(pairs))


def stopped(table: pd.DataFrame, recipes: Collection[str]) -> tuple[int, int]:
    """How many policies of recipes stopped on the plateau of their training, and the number of all."""
    trained = table[(table["kind"] == "training") & table["recipe"].isin(list(recipes))]
    return int((trained["validation_loss"] > PLATEAU).sum()), len(trained)


def ordered(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of policies in the order of stage, N, recipe and training seed."""
    stages = [CORE_STAGE, *EXPLORATORY]
    rows = rows.assign(order=rows["stage"].map(stages.index))
    return rows.sort_values(["order", "num_future_tokens", "recipe", "training_seed"], kind="stable")


@dataclass(frozen=True)
class Progress:
    """How much of a stage is there.

    Attributes:
        stage: Its name.
        done: Number of its policies that are trained and have all their episodes; in a stage that trains
            none, of pairs of a policy and an arm, of measured policies, or of timed recipes.
        planned: Their number in the plan.
    """

    stage: str
    done: int
    planned: int


def progress(
    table: pd.DataFrame, found: Judged, plan: Plan, tasks: Sequence[str], seeds: Sequence[int]
) -> list[Progress]:
    """How much of every stage is there, without the pilots.

    Args:
        table, tasks, seeds: As of `judged`.
        found: The unchanged policies.
        plan: The plan of the study.
    """
    results = []
    for stage in plan.stages:
        if stage != PILOT:
            planned = list(plan.policies(stage))
            there = [one for one in planned if one.seed in found.rates.get(one.recipe.name, {})]
            results.append(Progress(stage, len(there), len(planned)))
    for stage, arms in ARMS.items():
        done = [sum(map(len, judged(table, tasks, seeds, arm.name).rates.values())) for arm in arms]
        counts = [policy.training.num_future_tokens for policy in plan.all_policies(pilots=False)]
        results.append(Progress(stage, sum(done), sum(arm.applies(n) for arm in arms for n in counts)))
    for stage, measured in MEASURED.items():
        of_stage = table[table["kind"] == stage]
        policies = of_stage["policy"].nunique() if len(of_stage) else 0
        results.append(Progress(stage, policies, len(list(measured.policies(plan)))))
    recipes = {recipe.name for recipe in plan.recipes if recipe.stage != PILOT}
    results.append(Progress(TIMES, int((table["kind"] == TIMES).sum()), len(recipes)))
    return results


@dataclass(frozen=True)
class Pilot:
    """A pilot policy, which is no result.

    Attributes:
        policy: Its name.
        loss: Its held-out loss.
        rates: Its success rate by task, as far as it was judged.
    """

    policy: str
    loss: float
    rates: Mapping[str, float]


def pilots(table: pd.DataFrame) -> list[Pilot]:
    """The pilots, by name."""
    if "stage" not in table:
        return []
    of_stage = table[table["stage"] == PILOT]
    found = []
    for policy, rows in of_stage.groupby("policy"):
        episodes = rows[rows["kind"] == "episodes"]
        rates = {}
        for task, of_task in episodes.groupby("task") if len(episodes) else ():
            rates[str(task)] = float(truths(of_task["success"]).mean())
        trained = rows[rows["kind"] == "training"]
        found.append(Pilot(str(policy), float(trained["validation_loss"].iloc[0]), rates))
    return found


def over_seeds(found: Judged, contrast: Contrast) -> ContrastResult:
    """Tests a contrast over the training seeds for which all its recipes are complete."""
    seeds, unpaired, rates = found.paired(contrast.recipes, contrast.seeds)
    values = contrast.of(rates)
    complete = contrast.use == "interval" or len(seeds) == len(contrast.seeds)
    test = sign_flip(values) if seeds and complete else None
    return ContrastResult(contrast, seeds, unpaired, list(values), test)


def confirmed(found: Judged) -> list[ContrastResult]:
    """The confirmatory tests, with Holm's correction over all of them.

    A test without a pair counts as one with p = 1, so that the others are corrected as planned.
    """
    results = [over_seeds(found, contrast) for contrast in CONFIRMATORY]
    corrected = holm([1.0 if one.test is None else one.test.p_value for one in results])
    return [replace(one, corrected=p) for one, p in zip(results, corrected, strict=True)]


@dataclass(frozen=True)
class Change:
    """What an arm changes in the success of the policies of a recipe.

    Attributes:
        recipe, arm: Their names.
        test: The success under the arm minus that of the same unchanged policies, over training seeds.
    """

    recipe: str
    arm: str
    test: SignFlip

    @property
    def finding(self) -> Finding:
        """What it shows, as an exploratory contrast with the margin `MARGIN`."""
        return finding(self.test.difference)


def changes(table: pd.DataFrame, found: Judged, tasks: Sequence[str], seeds: Sequence[int]) -> list[Change]:
    """What every arm changes, for the policies that are complete with and without it.

    Args:
        table, tasks, seeds: As of `judged`.
        found: The unchanged policies.
    """
    results = []
    for arm in dict.fromkeys(table["arm"].dropna()) if "arm" in table else ():
        under = judged(table, tasks, seeds, arm).rates if arm != PLAIN else {}
        for recipe, rates in under.items():
            plain = found.rates.get(recipe, {})
            values = [rates[seed] - plain[seed] for seed in rates if seed in plain]
            if values:
                results.append(Change(recipe, arm, sign_flip(np.round(values, 12))))
    return results


def explored(found: Judged) -> dict[str, list[ContrastResult]]:
    """The exploratory contrasts of which something was measured, by stage."""
    results = {}
    for stage, contrasts in EXPLORATORY.items():
        measured = [one for one in (over_seeds(found, each) for each in contrasts) if one.test is not None]
        if measured:
            results[stage] = measured
    return results
