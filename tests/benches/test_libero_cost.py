"""The table of what LIBERO costs, from measurements."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("saccade_lab.libero.episodes")

from benches import libero
from saccade_lab.libero.episode import Episode

ROOT = Path(__file__).resolve().parents[2]


def episode(steps: int, chunks: int, **seconds: float) -> Episode:
    return Episode("libero_object", 0, 0, False, steps, chunks, {**Episode("", 0, 0).seconds, **seconds})


def test_means_are_of_each_part() -> None:
    found = libero.means([episode(100, 10, draw=2.0), episode(300, 30, draw=6.0, reset=1.0)])
    assert (found["steps"], found["chunks"]) == (200, 20)
    assert found["seconds"] == {"reset": 0.5, "draw": 4.0, "encode": 0.0, "sample": 0.0, "physics": 0.0}


def test_a_whole_episode_is_computed_from_its_beginning() -> None:
    begun = libero.means([episode(8, 4, reset=3.0, draw=5.0, encode=8.0, sample=4.0, physics=0.8)])
    whole = libero.extrapolated(begun, 280)
    assert whole["steps"] == 280
    assert whole["chunks"] == 140
    # 5 pictures were drawn, and 141 would be.
    assert whole["seconds"] == pytest.approx(
        {"reset": 3.0, "draw": 141.0, "encode": 280.0, "sample": 140.0, "physics": 28.0}
    )


def test_the_guide_has_the_tables_of_the_record() -> None:
    record = json.loads(libero.RECORD.read_text())
    assert libero.table(record) in (ROOT / "docs" / "libero.md").read_text()
