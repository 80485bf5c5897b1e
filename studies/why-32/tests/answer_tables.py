"""Tables of the study `answer` with given success rates, and the section of the report on them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pandas as pd
from saccade_lab.study.section import Section
from saccade_lab.study.table import Provenance
from why_32 import plan as plans
from why_32.section import section

STAGES = {one.name: one.stage for one in plans.PLAN.recipes}


def rows_of(rates: dict[str, list[float]], episodes: int = 10) -> pd.DataFrame:
    """A table of policies with these success rates on two tasks of `episodes` episodes."""
    rows: list[dict[str, Any]] = []
    for name, of_recipe in rates.items():
        for seed, rate in enumerate(of_recipe):
            policy = {
                "stage": STAGES.get(name, "core"),
                "recipe": name,
                "policy": f"{name}-seed-{seed}",
                "training_seed": seed,
                "num_future_tokens": int(name.split("-")[1]),
            }
            rows.append({"kind": "training", **policy})
            for task in ("a", "b"):
                for episode in range(episodes):
                    result = {"task": task, "seed": episode, "success": episode < round(rate * episodes)}
                    rows.append({"kind": "episodes", "arm": "plain", **policy, **result})
    return pd.DataFrame(rows)


def provenance_of(episodes: int = 10) -> Provenance:
    return Provenance("answer", {"tasks": ["a", "b"], "episodes": list(range(episodes))}, 1, 1)


def plan_of(num_seeds: int) -> plans.Plan:
    """The plan of the study with other training seeds."""
    recipes = [replace(one, seeds=tuple(range(num_seeds))) for one in plans.PLAN.recipes]
    return replace(plans.PLAN, recipes=tuple(recipes))


def section_of(rates: dict[str, list[float]], more: pd.DataFrame | None = None) -> Section:
    """The report's section for these success rates, and other rows of the table."""
    table = pd.concat([rows_of(rates), more])
    return section(table.assign(validation_loss=0.05), provenance_of(), plan_of(len(rates["n-0"])))


FEWER, MORE = [0.1, 0.2, 0.1, 0.2, 0.1, 0.2, 0.1, 0.2], [0.7, 0.9, 0.8, 0.7, 0.9, 0.8, 0.7, 0.9]
CORE = {"n-0": FEWER, "n-4": FEWER, "n-32": MORE}
# Patterns of what a sentence of the report has behind a number.
LINK = r"\[table 1\]\(#table-1\), `--stages core`"
BOUNDS = r"95 % interval [-\d.]+ to [-\d.]+"
