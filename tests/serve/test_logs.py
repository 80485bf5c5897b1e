"""Statistics and logs of the server."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from saccade.serve.logs import MOST_LINES, MOST_WARNINGS, JsonLog, LiveLog, Statistics, TextLog, Writer, line
from tests.helpers.serve_cases import ask, get_action, requester, serving


def test_statistics_count_everything() -> None:
    with serving() as running, requester(running.port) as made:
        for _ in range(3):
            ask(made, get_action())
        ask(made, {"endpoint": "ping"})
        ask(made, b"")
        running.stop()
        last = [line for line in running.log.lines if line["event"] == "statistics"][-1]
    assert last["requests"] == {"get_action": 3, "ping": 1, "unreadable": 1}
    assert last["errors"] == 1
    assert last["batch"] == 1.0
    assert list(last["milliseconds"]) == ["wait", "inputs", "backbone", "head", "total"]
    for part in last["milliseconds"].values():
        assert 0 <= part["p50"] <= part["p99"]
    assert "5 requests, 1 errors; " in line(last)
    assert json.loads(json.dumps(last))["requests"] == last["requests"]
    assert Statistics().summary()["milliseconds"] == {}


def test_json_lines(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as file:
        log = JsonLog(file.fileno())
        log.event("listening", address="tcp://x", policy=1)
        for number in range(MOST_WARNINGS + 5):
            log.event("warning", client="c", message=f"{number}\n")
        log.request(endpoint="ping", error=None)
        log.statistics({"requests": {}, "value": float("nan")})
        log.close()
    lines = [json.loads(text) for text in (tmp_path / "log").read_text().splitlines()]
    assert lines[0]["event"] == "listening"
    assert {"event", "time"} <= lines[0].keys()
    assert MOST_WARNINGS <= sum(one["event"] == "warning" for one in lines) <= MOST_WARNINGS + 5
    assert lines[-1] == {
        "event": "statistics",
        "time": lines[-1]["time"],
        "requests": {},
        "value": None,
        "lost_lines": 0,
    }


def test_a_live_line_is_written_again_below_other_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    with (tmp_path / "log").open("wb") as file:
        log = LiveLog(file.fileno())
        log.statistics(Statistics().summary())
        log.event("warning", client="c", message="dies")
        log.close()
    erase, live = b"\r\x1b[2K", b"0 requests, 0 error"
    expected = erase + live + erase + b"saccade serve: c: dies\n" + live + b"\n"
    assert (tmp_path / "log").read_bytes() == expected


def test_lines_of_text(tmp_path: Path) -> None:
    with (tmp_path / "log").open("wb") as file:
        log = TextLog(file.fileno())
        log.event("listening", address="tcp://x", policy="<policy>")
        log.request(client="c", endpoint="ping", error=None)
        log.request(client="c", endpoint="ping", error="bad\x1b[2J")
        summary = Statistics()
        summary.count("ping", is_error=False)
        for _ in range(2):
            log.statistics(summary.summary())
        log.close()
    assert (tmp_path / "log").read_text().splitlines() == [
        "saccade serve: listening on tcp://x (<policy>)",
        "saccade serve: c: bad\\x1b[2J",
        "saccade serve: 1 requests, 0 errors",
    ]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_loses_lines_only() -> None:
    descriptor = os.open("/dev/full", os.O_WRONLY)
    try:
        writer = Writer(descriptor)
        for _ in range(10):
            writer.write("x")
        writer.close()
        assert writer.lost == 10
    finally:
        os.close(descriptor)


def test_a_log_that_nobody_reads_holds_up_nothing() -> None:
    reader, writing = os.pipe()
    try:
        writer = Writer(writing)
        for _ in range(MOST_LINES + 2000):
            writer.write("x" * 100)
        assert writer.lost > 0
        start = time.monotonic()
        writer.close(0.1)
        assert time.monotonic() - start < 5
    finally:
        os.close(reader)  # ends the thread that writes
        os.close(writing)
