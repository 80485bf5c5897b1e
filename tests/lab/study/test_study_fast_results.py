"""The study of fast modes: when a task counts, and what is said of a mode."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pandas as pd

from saccade._internal.arrays import PRECISIONS
from saccade_lab.study.questions import fast_results
from saccade_lab.study.questions.fast_results import BASELINE, ONE_STEP
from saccade_lab.study.questions.fast_section import section
from saccade_lab.study.section import Section
from saccade_lab.study.statistics import holm, p_of_loss, paired_difference, tango, verdict
from saccade_lab.study.table import Provenance


def outcomes(
    rate_by_mode: Mapping[str, Callable[[int], bool]], task: str = "fork", count: int = 300
) -> pd.DataFrame:
    """A table of episodes, each mode by a rule of the seed."""
    return pd.DataFrame(
        [
            {"part": "episodes", "task": task, "seed": seed, "mode": mode, "success": rule(seed), "steps": 30}
            for mode, rule in rate_by_mode.items()
            for seed in range(count)
        ]
    )


def section_of(table: pd.DataFrame) -> Section:
    """The report's section on a table of the simulator."""
    checkpoint = {"name": "policy", "sha256": "ab" * 32, "num_future_tokens": 8, "num_layers": 4}
    return section(table, Provenance("fast", {"checkpoint": checkpoint}, done=1, total=1))


def test_a_task_counts_only_if_one_step_measurably_fails() -> None:
    table = pd.concat(
        [
            outcomes({BASELINE: lambda seed: seed % 10 > 0, ONE_STEP: lambda seed: seed % 10 > 4}),
            outcomes({BASELINE: lambda seed: True, ONE_STEP: lambda seed: seed % 50 > 0}, task="reach"),
            # 8 points are lost, but 30 episodes cannot show that it is more than 5.
            outcomes(
                {BASELINE: lambda seed: True, ONE_STEP: lambda seed: seed % 12 > 0}, task="push", count=30
            ),
            outcomes({BASELINE: lambda seed: True}, task="two-goals"),
        ]
    )
    found = {task: fast_results.counts(one) for task, one in fast_results.separations(table).items()}
    assert found == {"fork": True, "reach": False, "push": False}
    lines = section_of(table).concluded
    assert lines[0].startswith("fork counts: one Euler step against four: 50 against 90 %, -40.0 (")
    assert all("judges no mode" in line for line in lines[1:])
    assert len(lines) == 3


def test_no_mode_is_judged_where_no_task_counts() -> None:
    table = outcomes(
        {BASELINE: lambda seed: True, ONE_STEP: lambda seed: True, "int8-euler-4": lambda seed: False}
    )
    assert all(one.verdict is None for one in fast_results.results_of(table).values())
    lines = section_of(table).concluded
    assert lines[1:] == [
        "No mode is judged: no task was shown to distinguish one step from four (float32-euler-1)."
    ]


def timed(mode: str, milliseconds: float) -> dict[str, Any]:
    return {
        "part": "time", "task": "n1.5", "seed": 0, "mode": mode, "encode_ms": 1.0,
        "sample_ms": milliseconds - 1.0, "chunk_ms": milliseconds, "chunk_ms_low": milliseconds,
        "chunk_ms_high": milliseconds, "rounds": 5, "num_threads": 2, "isa": "avx2", "num_vl_tokens": 296,
    }  # fmt: skip


def test_verdicts_and_the_recommendation() -> None:
    rules: dict[str, Callable[[int], bool]] = {
        BASELINE: lambda seed: seed % 10 > 0,
        ONE_STEP: lambda seed: seed % 10 > 5,
        "int8-euler-4": lambda seed: seed % 10 > 0,  # the same episodes
        "bfloat16-euler-4": lambda seed: seed % 10 > 0 and seed != 11,  # as good, but slower than int8
        "float32-euler-2": lambda seed: seed % 10 > 1,  # 10 points less
        # 7 won and 18 lost: worse by its own interval, but not after Holm's correction.
        "int8-euler-2": lambda seed: (seed % 10 > 0 or seed < 70) and not 101 <= seed < 120,
    }
    spent = {
        BASELINE: 100.0,
        ONE_STEP: 40.0,
        "int8-euler-4": 20.0,
        "int8-euler-2": 10.0,
        "bfloat16-euler-4": 50.0,
        "float32-euler-2": 60.0,
    }
    table = pd.concat([outcomes(rules), pd.DataFrame([timed(*item) for item in spent.items()])])
    results = fast_results.results_of(table)
    assert list(results) == [
        ONE_STEP, "float32-euler-2", BASELINE, "bfloat16-euler-4", "int8-euler-2", "int8-euler-4"
    ]  # fmt: skip
    pairs = results["int8-euler-2"].pairs
    assert pairs is not None
    assert (pairs.only_first, pairs.only_second) == (7, 18)
    assert {name: (one.verdict, one.significant) for name, one in results.items()} == {
        BASELINE: (None, False),
        ONE_STEP: (None, False),
        "int8-euler-4": ("no worse", True),
        "bfloat16-euler-4": ("no worse", True),
        "float32-euler-2": ("worse", True),
        "int8-euler-2": ("worse", False),
    }
    assert fast_results.recommended(results) == ["int8-euler-4", "bfloat16-euler-4", BASELINE]
    # Holm: four modes are judged, and the control that decides which tasks count is not one of them.
    p_values = [one.pairs.p_value for name, one in results.items() if one.pairs and name != ONE_STEP]
    assert [one.p_value for one in results.values() if one.p_value is not None] == holm(p_values)
    found = section_of(table)
    assert any(
        line.startswith("int8-euler-4: success: no worse, 0.0 points (")
        and "0.20 of the baseline's time" in line
        for line in found.concluded
    )
    assert any(line.startswith("float32-euler-2: success: worse, -10.0 points (") for line in found.concluded)
    assert "Not significant after Holm's correction for 4 modes: int8-euler-2 (worse)." in found.concluded
    assert found.concluded[-1] == (
        "The fastest mode of each precision that is no worse, also after Holm's correction: "
        f"int8-euler-4, bfloat16-euler-4, {BASELINE}."
    )
    # What is said of a mode and what the table of the report says agree with the interval.
    grid = found.grids[0]
    for row in grid.rows:
        cells = dict(zip(grid.columns, row, strict=True))
        difference = results[cells["mode"]].pairs
        if cells["verdict"]:
            assert difference is not None
            assert cells["verdict"] == verdict(difference.difference)


def test_modes_of_every_precision_are_drawn_in_their_order() -> None:
    modes = [f"{precision}-euler-4" for precision in PRECISIONS]
    rules = {mode: lambda seed: seed % 10 > 0 for mode in reversed(modes)}
    table = pd.concat(
        [
            outcomes({**rules, ONE_STEP: lambda seed: seed % 10 > 5}),
            pd.DataFrame([timed(mode, 10.0 + place) for place, mode in enumerate([ONE_STEP, *modes])]),
        ]
    )
    assert list(fast_results.results_of(table)) == [ONE_STEP, *modes]
    found = section_of(table)
    assert found.figures
    assert [row[list(found.grids[0].columns).index("mode")] for row in found.grids[0].rows][1:] == modes


def test_no_loss_is_the_interval_that_excludes_it() -> None:
    for pairs in (20, 100, 400):
        for only_first in (0, 1, 5, 12):
            for only_second in (0, 2, 7, 8):
                first = (
                    [True] * only_first + [False] * only_second + [True] * (pairs - only_first - only_second)
                )
                second = [False] * only_first + [True] * (pairs - only_first)
                one = paired_difference(first, second)
                assert (one.only_first, one.only_second) == (only_first, only_second)
                assert (p_of_loss(one, 0.05) < 0.025) == (tango(only_first, only_second, pairs).low > -0.05)
