"""Episodes in several processes: the same results, and one that is lost does not lose the others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade import SaccadeError, cli
from saccade.cli import recorded
from saccade_lab.recordings.spreading import spread
from tests.helpers.parallel_cases import Square
from tests.helpers.recorded_cases import made_up
from tests.helpers.recorded_folder import written

OPTIONS: dict[str, Any] = {"backend": "loky", "address": None, "num_threads": None, "files": []}


def test_an_episode_whose_process_dies_is_named_after_the_others(tmp_path: Path) -> None:
    found = []

    def keep() -> None:
        for one in spread(Square(tmp_path / "log", dies=(2,)), [1, 2, 3, 4], jobs=2, **OPTIONS):
            found.append(one)

    with pytest.raises(SaccadeError, match="1 of 4 episodes are missing: episode 2: "):
        keep()
    assert sorted(found) == [(1, 1), (3, 9), (4, 16)]


def test_one_job_is_this_process() -> None:
    assert list(spread(abs, [-2, 1], jobs=1, **OPTIONS)) == [(-2, 2), (1, 1)]


def test_processes_give_the_same_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded, "extension", lambda name: spread if name == "spread" else None)
    folder = written(made_up((9, 5, 8)), tmp_path / "tiny")
    demo, found = str(saccade.demo_checkpoint()), []
    for jobs in ("1", "2"):
        out = tmp_path / jobs
        command = ["evaluate", demo, str(folder), "--out", str(out), "--stride", "8", "--jobs", jobs]
        assert cli.main([*command, "--num-threads", "1"]) == 0
        found.append({**json.loads((out / "results.json").read_text()), "seconds": 0})
    assert found[0] == found[1]
