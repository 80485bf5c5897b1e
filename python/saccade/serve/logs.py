"""What a server has done, and its log: lines for people, JSON lines for machines, or one live line.

A thread of `logging` writes the lines, so a full disk or a reader that stalls does not hold up the server.
Lines that cannot be written are counted.
"""

from __future__ import annotations

import logging
import logging.handlers
import os
import queue
import shutil
import sys
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from saccade._internal.json import dumps
from saccade.errors import InputError, printable
from saccade.serve.engine import PARTS

#: Lines that wait to be written; more are lost, and counted.
MOST_LINES = 10_000
#: Warnings a second that are written; more are counted.
MOST_WARNINGS = 20
#: Back to the start of the line of a terminal, and erases it.
ERASE = "\r\x1b[2K"
#: Number of answers, the last ones, whose latencies are kept.
WINDOW = 1024


class Statistics:
    """Counts and latencies since the start; one thread uses it."""

    def __init__(self) -> None:
        self.requests: Counter[str] = Counter()  # by endpoint, or "unreadable"
        self.errors = 0  # requests that did not get what they asked for
        # By why nobody got the answer: "gone" and "late" were not computed, "unsent" were computed in vain.
        self.dropped: Counter[str] = Counter()
        self._started = time.monotonic()
        self._computed: deque[tuple[float, int, Mapping[str, float]]] = deque(maxlen=WINDOW)

    def count(self, endpoint: str, *, is_error: bool) -> None:
        """Counts a request."""
        self.requests[endpoint] += 1
        self.errors += is_error

    def computed(self, batch: int, milliseconds: Mapping[str, float]) -> None:
        """Counts actions and the number of observations that were computed together."""
        self._computed.append((time.monotonic(), batch, milliseconds))

    def summary(self) -> dict[str, Any]:
        """Counts since the start; of the last actions the rate, the mean batch and the latency by part."""
        now, batches = time.monotonic(), [batch for _, batch, _ in self._computed]
        span = now - self._computed[0][0] if self._computed else 0.0
        parts = {}
        for part in (*PARTS, "total") if self._computed else ():
            p50, p99 = np.percentile([took[part] for *_, took in self._computed], (50, 99))
            parts[part] = {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}
        return {
            "seconds": round(now - self._started, 3),
            "requests": dict(self.requests),
            "errors": self.errors,
            "dropped": dict(self.dropped),
            "per_second": round(len(self._computed) / span, 3) if span > 0 else 0.0,
            "batch": round(float(np.mean(batches)), 2) if batches else 0.0,
            "milliseconds": parts,
        }


def line(summary: dict[str, Any]) -> str:
    """A summary on one line.

    Example:
        >>> line(Statistics().summary())
        '0 requests, 0 errors'
    """
    text = f"{sum(summary['requests'].values())} requests, {summary['errors']} errors"
    if summary["dropped"]:
        text += f", {sum(summary['dropped'].values())} dropped"
    parts = summary["milliseconds"]
    if parts:
        shown = ", ".join(f"{part} {value['p50']:.1f}/{value['p99']:.1f}" for part, value in parts.items())
        speed = f"{summary['per_second']:.1f} a second in batches of {summary['batch']:.1f}"
        text += f"; {speed}; ms p50/p99: {shown}"
    return text


class Log(Protocol):
    """Where a server says what happens."""

    #: Seconds between two calls of `statistics`.
    every: float

    def event(self, name: str, **fields: Any) -> None:
        """Something that happens rarely: ``listening``, ``warning``, ``stopping``, ``stopped``."""

    def request(self, **fields: Any) -> None:
        """A request was answered or dropped."""

    def statistics(self, summary: dict[str, Any]) -> None:
        """What was done so far."""

    def close(self) -> None:
        """Writes what waits, if that is possible."""


def open_log(format: str = "text") -> Log:
    """Opens the log of a server; close it with its ``close()`` when the server has ended.

    Args:
        format: ``"json"`` for JSON lines on standard output, or ``"text"`` for lines on standard error, of
            which one is live on a terminal.

    Raises:
        InputError: ``format`` is neither.

    Example:
        >>> from saccade.serve import open_log
        >>> log = open_log("text")
        >>> log.close()
    """
    if format not in ("text", "json"):
        raise InputError(f"format: expected text or json, got {format!r}")
    if format == "json":
        return JsonLog(1)
    return LiveLog(2) if sys.stderr.isatty() else TextLog(2)


class Writer(logging.handlers.QueueListener):
    """Writes text to a file descriptor, which it does not close, in a thread of its own.

    It takes no lock, for which the end of the program would wait. Of warnings it limits the number a second.
    """

    every = 10.0

    def __init__(self, descriptor: int) -> None:
        self._lines: queue.Queue[Any] = queue.Queue(MOST_LINES)
        super().__init__(self._lines)
        self._descriptor = descriptor
        self._not_queued = self._not_written = 0
        self._second = self._warnings = self._left_out = 0
        self.start()

    @property
    def lost(self) -> int:
        """Number of texts that were not written."""
        return self._not_queued + self._not_written

    def write(self, text: str) -> None:
        """Appends text, with its line break; never waits."""
        try:
            self._lines.put_nowait(logging.makeLogRecord({"msg": text}))
        except queue.Full:
            self._not_queued += 1

    def handle(self, record: logging.LogRecord) -> None:
        """See `QueueListener`. A record that cannot be written is counted."""
        data = record.getMessage().encode("utf-8", "backslashreplace")
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError:  # a full disk, a closed pipe
            self._not_written += 1

    def close(self, seconds: float = 2.0) -> None:
        """Writes what waits, for at most the given number of seconds."""
        end = time.monotonic() + seconds
        while self._lines.unfinished_tasks and time.monotonic() < end:
            time.sleep(0.005)
        if not self._lines.unfinished_tasks:
            self.stop()
        self._descriptor = -1  # another file may have the number from now on

    def event(self, name: str, **fields: Any) -> None:
        """See :class:`Log`. The next warning that is written says how many were not."""
        if name == "warning":
            now = int(time.monotonic())
            if now != self._second:
                self._second, self._warnings = now, 0
            if self._warnings >= MOST_WARNINGS:
                self._left_out += 1
                return
            self._warnings += 1
            if self._left_out:
                fields["left_out"], self._left_out = self._left_out, 0
        self._event(name, fields)

    def _event(self, name: str, fields: dict[str, Any]) -> None:
        raise NotImplementedError


class JsonLog(Writer):
    """JSON lines: an object with ``event`` and ``time`` (seconds since 1970) each.

    Events: ``listening``, ``request``, ``statistics``, ``warning``, ``stopping``, ``stopped``.
    """

    def request(self, **fields: Any) -> None:
        """See :class:`Log`."""
        self._event("request", fields)

    def statistics(self, summary: dict[str, Any]) -> None:
        """See :class:`Log`."""
        self._event("statistics", {**summary, "lost_lines": self.lost})

    def _event(self, name: str, fields: dict[str, Any]) -> None:
        self.write(dumps({"event": name, "time": round(time.time(), 6), **fields}, default=str) + "\n")


class TextLog(Writer):
    """Lines for people: what happens, errors, and statistics where there are new requests."""

    _last = ""  # of the statistics

    def request(self, **fields: Any) -> None:
        """See :class:`Log`. Only errors are written."""
        if fields.get("error"):
            self.event("warning", client=fields.get("client", ""), message=fields["error"])

    def statistics(self, summary: dict[str, Any]) -> None:
        """See :class:`Log`."""
        text = line(summary)
        if summary["requests"] and text.partition(";")[0] != self._last.partition(";")[0]:
            self._line(text)
        self._last = text

    def _event(self, name: str, fields: dict[str, Any]) -> None:
        if name == "warning":
            text = f"{fields['client']}: " if fields.get("client") else ""
            text += str(fields["message"])
            text += f" (and {fields['left_out']} more)" if "left_out" in fields else ""
        elif name == "listening":
            commit = f", commit {fields['commit']}" if fields.get("commit") else ""
            text = f"listening on {fields['address']} ({fields['policy']}{commit})"
        else:
            details = ", ".join(f"{key} {value}" for key, value in fields.items())
            text = f"{name}: {details}" if details else name
        self._line(text)

    def _line(self, text: str) -> None:
        self.write(f"saccade serve: {printable(text)}\n")


class LiveLog(TextLog):
    """On a terminal: the lines of :class:`TextLog`, with one live line of statistics below them."""

    every = 1.0

    def statistics(self, summary: dict[str, Any]) -> None:
        """See :class:`Log`."""
        self._last = line(summary)
        self.write(ERASE + self._shown())

    def close(self, seconds: float = 2.0) -> None:
        """See :class:`Log`."""
        self.write("\n")
        super().close(seconds)

    def _line(self, text: str) -> None:
        self.write(f"{ERASE}saccade serve: {printable(text)}\n{self._shown()}")

    def _shown(self) -> str:
        """The live line, as wide as the terminal at most."""
        return self._last[: shutil.get_terminal_size().columns - 1]
