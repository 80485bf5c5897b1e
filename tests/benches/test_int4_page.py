"""The page about int4 says what its record says."""

from __future__ import annotations

import json
from typing import Any

from benches.int4 import __main__ as main
from benches.int4 import page

RUNS = {
    name: {"actions": error, "features": 2 * error}
    for name, error in zip((*page.RUNS, "other noise"), (1e-3, 2e-3, 3e-2, 1.5e-2, 0.5), strict=True)
}
LOAD = {"nbytes": 2e9, "loaded": 3e9, "called": 4e9, "load": 5.0, "read": 6.0}


def record() -> dict[str, Any]:
    half = {key: value / 2 for key, value in LOAD.items()}
    return {
        "machine": {"cpu": "a CPU", "family": "a family", "isa": "avx2", "cores": 2, "commit": "abc"},
        "accuracy": {"a policy": RUNS},
        "groups": {"a policy": {"all": {"int4": 0.25, "int4, calibrated": 0.125}}},
        "size": {
            "int8": {"file_bytes": 2_000_000_000, "loads": [LOAD, LOAD, {**LOAD, "load": 50.0}]},
            "int4": {"file_bytes": 1_000_000_000, "loads": [half]},
        },
    }


def test_the_page() -> None:
    lines = page.document(record()).splitlines()
    for line in (
        "| int4 | 3.0e-02 | 15.00 | 6.0e-02 |",
        "| int4, calibrated | 1.5e-02 | 7.50 | 3.0e-02 |",
        "| float32, other noise | 5.0e-01 | | |",
        "| all | 2.5e-01 | 1.2e-01 |",
        "| int8 | 2.00 | 2.00 | 3.00 | 4.00 | 5.00 | 6.00 |",
        "| int4 over int8 | 0.50 | 0.50 | 0.50 | 0.50 | 0.50 | 0.50 |",
    ):
        assert line in lines
    text = " ".join(lines)
    assert "a CPU (a family, avx2), 2 cores; commit abc" in text


def test_sizes_are_left_out_where_they_were_not_measured() -> None:
    assert "Memory and loading" not in page.document(record() | {"size": None})


def test_the_committed_page_is_that_of_its_record() -> None:
    assert main.PAGE.read_text() == page.document(json.loads(main.KEPT.read_text()))
