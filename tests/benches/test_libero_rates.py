"""The table of success rates on LIBERO, from results of runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benches import libero_rates

ROOT = Path(__file__).resolve().parents[2]


def run(suite: str, successes: list[int], **changes: Any) -> dict[str, Any]:
    common = dict.fromkeys(libero_rates.COMMON, "the same")
    return {
        **common,
        "protocol": {"name": "lerobot"},
        "summary": [
            {"suite": suite, "task": task, "episodes": 50, "successes": count, "median_steps": 100}
            for task, count in [*enumerate(successes), (None, sum(successes))]
        ],
        "tasks": [{"suite": suite, "task": task, "instruction": f"{suite} {task}"} for task in (0, 1)],
        **changes,
    }


def test_suites_are_summed_and_the_first_has_its_tasks() -> None:
    record = libero_rates.record_of([run("libero_object", [40, 50]), run("libero_object_swap", [0, 1])])
    assert libero_rates.table(record).splitlines()[2:] == [
        "| **libero_object** | 90 of 100 | 90 % (83 to 94) |",
        "| libero_object 0 | 40 of 50 | 80 % (67 to 89) |",
        "| libero_object 1 | 50 of 50 | 100 % (93 to 100) |",
        "| **libero_object_swap**, exchanged positions | 1 of 100 | 1 % (0 to 5) |",
    ]


def test_runs_that_do_not_belong_together_are_refused() -> None:
    first = run("libero_object", [40, 50])
    with pytest.raises(SystemExit, match="runs that differ in checkpoint"):
        libero_rates.record_of([first, run("libero_object_swap", [1, 2], checkpoint="another")])
    with pytest.raises(SystemExit, match="libero_object is in two runs"):
        libero_rates.record_of([first, first])


def test_the_guide_has_the_tables_of_the_records() -> None:
    records = sorted(libero_rates.RECORD.parent.glob("libero-*rates.json"))
    assert len(records) > 1
    for path in records:
        record = json.loads(path.read_text())
        assert libero_rates.table(record) in (ROOT / "docs" / "libero.md").read_text()
