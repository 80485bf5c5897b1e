"""The load test runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import whole_checkpoints

from benches import serve


def test_a_small_load(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serve, "COMPARED_SECONDS", 0.1)
    out = tmp_path / "results.json"
    options = ["--requests", "12", "--clients", "1", "3", "--num-threads", "1", "--out", str(out)]
    embodiment = ["--embodiment", whole_checkpoints.EMBODIMENT]
    assert serve.main([str(whole_checkpoints.whole("nvidia")), *embodiment, *options]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [(row["clients"], row["requests"], row["lost"]) for row in rows] == [(1, 12, 0), (3, 12, 0)]
    assert rows[0]["batch"] == 1
    for row in rows:
        assert 0 < row["p50"] <= row["p99"]
        assert row["per_second"] > 0
        assert row["in_process"] > 0
        assert min(row["memory"]) > 10
    assert "| 3 |" in capsys.readouterr().out


def test_arguments_are_checked() -> None:
    for arguments in ([], ["checkpoint", "--random", "out"], ["checkpoint", "--requests", "2"]):
        with pytest.raises(SystemExit):
            serve.parse(arguments)
