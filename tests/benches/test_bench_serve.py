"""The load test of the server, small, and its report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benches import serve, serve_report


def test_every_request_is_counted_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(serve, "COMPARED_SECONDS", 0.05)
    monkeypatch.setattr(serve, "REST_SECONDS", 0.0)
    arguments = ["--clients", "1", "3", "--requests", "12", "--rounds", "2", "--num-threads", "2"]
    assert serve.main([*arguments, "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "results.json").read_text())
    assert "demo" in results
    result = results["demo"]
    for row, clients in zip(result["rows"], (1, 3), strict=True):
        assert (row["clients"], row["requests"], row["lost"]) == (clients, 12, 0)
        for name in ("per_second", "in_process", "memory", "server_cpu", "client_cpu"):
            assert len(row[name]) == 2
            assert min(row[name]) >= 0
        assert 0 < row["p50"] <= row["p99"]
        assert sum(int(size) * count for size, count in row["batches"].items()) == 12
    text = serve_report.document({"demo": result})
    assert result["machine"]["cpu"] in text
    assert "Requests: 24; rounds: 2. Memory of the server: " in text
    for one in result["rows"]:
        one.update({key: value[:1] for key, value in one.items() if isinstance(value, list)})
    text = serve_report.document({"demo": result})
    assert "Requests: 24; rounds: 1." in text
    assert "Memory" not in text  # there is nothing to compare it with
    assert serve.main(["report", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.count("## ") == 1


def row(clients: int, per_second: list[float], in_process: list[float]) -> dict[str, Any]:
    return {
        "clients": clients,
        "requests": 100,
        "lost": 1,
        "per_second": per_second,
        "in_process": in_process,
        "memory": [50.0, 51.0],
        "batches": {"1": 2, "4": 1},
        "server_cpu": [9.0, 9.0],
        "client_cpu": [0.1, 0.1],
        "p50": 8.0,
        "p99": 12.0,
    }


def test_ratios_are_those_of_the_same_round() -> None:
    first = row(1, [100.0, 50.0], [100.0, 100.0])
    cells = serve_report.cells(row(16, [200.0, 150.0], [100.0, 100.0]), first)
    assert cells == [
        "16",
        "175 (162 to 188)",
        "2.50",
        "8.00",
        "12.0",
        "3.0",  # as a request sees it: 2 of 6 are alone, 4 of 6 in a batch of 4
        "100",
        "175% (162% to 188%)",
        "1 of 100",
        "9.00, 0.100",
    ]


def test_the_page_shows_what_is_committed() -> None:
    committed = json.loads(serve_report.COMMITTED.read_text())
    assert set(committed) <= set(serve_report.POLICIES)
    assert serve_report.document(committed) == serve_report.PAGE.read_text()
