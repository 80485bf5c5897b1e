"""What is kept of runs of `saccade bench`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benches.int4 import bench


def run() -> dict[str, Any]:
    """What `saccade bench --json` prints, as far as it is read."""
    parts = [
        {"kernel": "amx-int8", "bytes": 300, "seconds": 2.0},
        {"kernel": "amx-int8", "bytes": 100, "seconds": 2.0},
        {"kernel": "amx-bf16", "bytes": 900, "seconds": 9.0},
    ]
    four = [{"kernel": "amx-int4", "bytes": 50, "seconds": 0.5}]
    return {
        "saccade": "0.1.0",
        "machine": {
            "family": "F",
            "isa": "amx",
            "num_threads": 2,
            "read_bytes_per_second": 7.0,
            "kernels": {},
        },
        "call": {"num_vl_tokens": 9, "batch": 1, "num_samples": 1},
        "results": [
            {"precision": precision, "call": call, "seconds": [value, value]}
            for value, (precision, call) in enumerate(
                (precision, call) for precision in ("int8", "int4") for call in ("encode", "sample", "both")
            )
        ],
        "profile": [
            {"precision": "int8", "call": "encode", "parts": []},
            {"precision": "int8", "call": "sample", "parts": parts},
            {"precision": "int4", "call": "sample", "parts": four},
        ],
    }


def test_times_machine_and_rates_are_kept(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(run()))
    (found,) = bench.measure([tmp_path / "a.json"])
    assert found == {
        "saccade": "0.1.0",
        "num_vl_tokens": 9,
        "machine": {"family": "F", "isa": "amx", "num_threads": 2},
        "time": {"encode": {"int8": [0, 0], "int4": [3, 3]}, "sample": {"int8": [1, 1], "int4": [4, 4]}},
        "read": {"int8": 100.0, "int4": 100.0, "peak": 7.0},
    }


@pytest.mark.parametrize("wrong", ["precision", "call", "profile", "batch"])
def test_runs_of_something_else_are_refused(tmp_path: Path, wrong: str) -> None:
    other = run()
    if wrong == "precision":
        other["results"] = other["results"][:3]
    elif wrong == "call":
        del other["results"][4]
    elif wrong == "profile":
        del other["profile"][2]
    else:
        other["call"]["batch"] = 2
    (tmp_path / "a.json").write_text(json.dumps(other))
    with pytest.raises(SystemExit, match=r"a\.json: expected int8 and int4 with --profile"):
        bench.measure([tmp_path / "a.json"])
