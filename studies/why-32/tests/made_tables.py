"""Tables of the study with given success rates."""

from __future__ import annotations

from typing import Any

import pandas as pd

from why_32 import plan as plans

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


FEWER, MORE = [0.1, 0.2, 0.1, 0.2, 0.1, 0.2, 0.1, 0.2], [0.7, 0.9, 0.8, 0.7, 0.9, 0.8, 0.7, 0.9]
