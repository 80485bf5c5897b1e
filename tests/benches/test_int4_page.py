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


MACHINE = {"cpu": "a CPU", "family": "a family", "isa": "avx2", "cores": 2, "commit": "abc"}


def record() -> dict[str, Any]:
    half = {key: value / 2 for key, value in LOAD.items()}
    measured = {
        "errors": {
            "observations": {"calibrated": 24, "measured": 12},
            "policies": {
                "the bundled policy": {"tasks": ["reach"], "sha256": 64 * "a", "settings": None},
                "a policy for fork": {
                    "tasks": ["fork"],
                    "sha256": 64 * "b",
                    "settings": {
                        "num_future_tokens": 8,
                        "steps": 5000,
                        "seed": 0,
                        "demonstrations": {"tasks": {"fork": 300}},
                    },
                },
            },
            "models": {"a policy": RUNS},
            "groups": {"a policy": {"all": {"int4": 0.25, "int4, calibrated": 0.125}}},
        },
        "loop": {
            "a policy": {
                "tasks": ["reach", "push"],
                # 161 pairs of which 6 and 16 are discordant: the published example of Tango's interval.
                "success": {
                    "float32": [True] * 16 + [False] * 145,
                    "int4": [False] * 16 + [True] * 6 + [False] * 139,
                },
            }
        },
        "libero": [
            {
                "checkpoint": {"name": "n17", "sha256": 64 * "c"},
                "machine": {"cpu": "another CPU"},
                "instruction_set": "avx512",
                "saccade": "0.1.0",
                "protocol": {"name": "lerobot", "start": "official states"},
                "runs": {
                    "int4": {
                        "tasks": ["libero_object"],
                        "success": {"float32": [True, True, False], "int4": [True, False, False]},
                    }
                },
            }
        ],
        "full": {
            "size": {
                "int8": {"file_bytes": 2_000_000_000, "loads": [LOAD, LOAD, {**LOAD, "load": 50.0}]},
                "int4": {"file_bytes": 1_000_000_000, "loads": [half]},
            },
            "time": {"sample": {"int8": [0.2, 0.4, 0.2], "int4": [0.1, 0.4, 0.18]}},
        },
        "bench": [
            {
                "saccade": "0.1.0",
                "num_vl_tokens": 296,
                "machine": {"family": "a third family", "isa": "amx", "num_threads": 2},
                "time": {"encode": {"int8": [0.2, 0.4, 0.2], "int4": [0.2, 0.3, 0.1]}},
                "read": {"int8": 15e9, "int4": 7e9, "peak": 30e9},
            }
        ],
        "calibrate": {"observations": 16, "weights": 400, "seconds": 90.0, "peak": 7e9, "errors": RUNS},
    }
    return {word: {"machine": MACHINE, "measured": one} for word, one in measured.items()}


def test_the_page() -> None:
    lines = page.document(record()).splitlines()
    for line in (
        "| int4 | 3.0e-02 | 15.00 | 6.0e-02 |",
        "| int4, calibrated | 1.5e-02 | 7.50 | 3.0e-02 |",
        "| float32, other noise | 5.0e-01 | | |",
        "| all | 2.5e-01 | 1.2e-01 |",
        "| int8 | 2.00 | 2.00 | 3.00 | 4.00 | 5.00 | 6.00 |",
        "| int4 over int8 | 0.50 | 0.50 | 0.50 | 0.50 | 0.50 | 0.50 |",
        "| **a policy**: reach, push | | | |",
        "| float32 | 16 of 161 |  |  |",
        "| int4 | 6 of 161 | -6.2 (-12.4 to -0.5) | worse |",
        "| **int4**: libero_object | | | |",
        "| float32 | 2 of 3 |  |  |",
        "| sample | 200 | 180 | 0.90 (0.70 to 0.95) |",
        "| encode | 200 | 200 | 0.75 (0.62 to 0.88) |",
    ):
        assert line in lines
    text = " ".join(lines)
    assert text.count("a CPU (a family, avx2), 2 cores; commit abc") == 4
    assert "(`n17`, checkpoint cccccccccccccccc: `saccade libero --protocol lerobot`, official" in text
    assert "another CPU, avx512, saccade 0.1.0" in text
    assert "15 GB/s in int8 and at 7 GB/s in int4, of 30 GB/s" in text
    assert "(a third family, amx, 2 threads, 296 vision-language tokens, saccade 0.1.0;" in text
    assert "rounded for 24 observations, and errors are those on 12." in text
    assert "The bundled policy: checkpoint aaaaaaaaaaaaaaaa." in text
    assert (
        "A policy for fork: checkpoint bbbbbbbbbbbbbbbb; `saccade demos --tasks fork --episodes 300`, then "
        "`saccade train --num-future-tokens 8 --training-steps 5000`, which has the seed 0."
    ) in text
    assert "for 16 observations (400 weights): 1.5 minutes, and at most 7.0 GB" in text


def test_what_was_not_measured_is_left_out() -> None:
    found = record()
    del found["full"]
    assert "Memory and loading" not in page.document(found)


def test_the_committed_page_is_that_of_its_record() -> None:
    assert main.PAGE.read_text() == page.document(json.loads(main.KEPT.read_text()))
