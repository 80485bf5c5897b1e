"""The baselines of an evaluation at each step of the horizon, as the policy's error is given by step."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from saccade.evaluation import Evaluation, Predicted
from saccade.evaluation.measures import Actions, squared


def baselines_by_step(report: Evaluation) -> dict[str, list[float]]:
    """Mean squared errors of ``hold``, ``mean`` and ``noise`` at each step of the horizon.

    As ``report.by_step``: the mean over the chunks of an episode that have the step, then over the episodes
    that have such a chunk; NaN if none has. ``hold`` repeats what the report says, ``mean`` is the mean
    action of all episodes.
    """
    every = np.concatenate([one.recorded for one in report.predictions]).astype(np.float64)
    mean = np.mean(every, axis=0)
    found: dict[str, list[float]] = {name: [] for name in ("hold", "mean", "noise")}
    for step in range(report.horizon):
        errors = [_at_step(report, one, step, mean) for one in report.predictions]
        for name, values in found.items():
            known = [one[name] for one in errors if one is not None]
            values.append(float(np.mean(known)) if known else math.nan)
    return found


def _at_step(report: Evaluation, one: Predicted, step: int, mean: Actions) -> Mapping[str, float] | None:
    """The errors of one episode at a step; None if no chunk has it."""
    known = one.steps + step < len(one.recorded)
    if not known.any():
        return None
    recorded = one.recorded[one.steps[known] + step]
    held = np.zeros_like(recorded)
    for key, where in report.layout.keys.items():
        state = report.layout.holds[key]
        if report.hold[key] == "state" and state is not None:
            held[:, where] = one.state[known][:, state]
    first, other = one.predicted[known, 0, step], one.predicted[known, 1, step]
    constant = np.broadcast_to(mean.astype(recorded.dtype), recorded.shape)
    pairs = {"hold": (held, recorded), "mean": (constant, recorded), "noise": (other, first)}
    return {name: float(squared(*pair)) for name, pair in pairs.items()}
