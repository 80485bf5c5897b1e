"""The report's section of `saccade study answer`."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from saccade.study.answer.results import ContrastResult, Judged, confirmed, judged
from saccade.study.section import Grid, Prose, Section, points
from saccade.study.table import Provenance


def section(table: pd.DataFrame, provenance: Provenance) -> Section:
    """The study's part of the report.

    Args:
        table: Table of the study.
        provenance: Its provenance, whose settings say which episodes every policy runs.
    """
    found = judged(table, provenance.settings["tasks"], provenance.settings["episodes"])
    tests = confirmed(found)
    prose = Prose("answer", tests=tests, missing=found.missing, rates=found.rates)
    return prose.section((), [policy_grid(prose, found), test_grid(prose, tests)])


def policy_grid(prose: Prose, found: Judged) -> Grid:
    """Success of every policy, recipe by recipe."""
    seeds = sorted({seed for rates in found.rates.values() for seed in rates})
    lines = []
    for recipe, rates in found.rates.items():
        shown = [f"{100 * rates[seed]:.1f}" if seed in rates else "" for seed in seeds]
        lines.append([recipe, f"{100 * sum(rates.values()) / len(rates):.1f}", *shown])
    return Grid(
        prose.line("caption_policies"), ("recipe", "mean", *(f"seed {seed}" for seed in seeds)), lines
    )


def test_grid(prose: Prose, tests: Sequence[ContrastResult]) -> Grid:
    """The confirmatory tests."""
    lines = []
    for one in tests:
        if one.test is None:
            lines.append([one.contrast.name, "0", "", "", ""])
            continue
        p_values = (one.test.p_value, one.corrected)
        lines.append(
            [
                one.contrast.name,
                str(one.test.pairs),
                points(one.test.difference),
                *(f"{p:.4f}" for p in p_values if p is not None),
            ]
        )
    columns = ("contrast", "pairs", "points (95 % interval)", "p", "p after Holm")
    return Grid(prose.line("caption_tests"), columns, lines)
