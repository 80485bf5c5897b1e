"""The log of a server: lines for people, JSON lines for machines, or one live line on a terminal.

A thread of `logging` writes the lines, so a full disk or a reader that stalls does not hold up the server.
Lines that cannot be written are counted.
"""

from __future__ import annotations

import logging
import logging.handlers
import os
import queue
import shutil
import threading
import time
from typing import Any, Protocol

from saccade._internal.json import dumps
from saccade.errors import printable
from saccade.serve.statistics import line

#: Lines that wait to be written; more are lost, and counted.
MOST_LINES = 10_000
#: Warnings a second that are written; more are counted.
MOST_WARNINGS = 20
#: Back to the start of the line of a terminal, and erases it.
ERASE = "\r\x1b[2K"
#: Seconds between two statistics in a log, and on a terminal.
STATISTICS_SECONDS = 10.0
LIVE_SECONDS = 1.0


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


class _Queued(logging.handlers.QueueHandler):
    """Appends records to a queue, and never waits; those for which there is no room are counted."""

    lost = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """See `QueueHandler`."""
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            self.lost += 1


class _Written(logging.handlers.QueueListener):
    """Writes records to a file descriptor. It takes no lock, for which the end of the program would wait."""

    lost = 0

    def __init__(self, waiting: queue.Queue[Any], descriptor: int) -> None:
        super().__init__(waiting)
        self._descriptor = descriptor

    def handle(self, record: logging.LogRecord) -> None:
        """See `QueueListener`. A record that cannot be written is counted."""
        data = record.getMessage().encode("utf-8", "backslashreplace")
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError:  # a full disk, a closed pipe
            self.lost += 1


class Writer:
    """Writes text to a file descriptor in a thread of its own.

    Args:
        descriptor: The file descriptor. It is not closed.
    """

    def __init__(self, descriptor: int) -> None:
        self._waiting: queue.Queue[Any] = queue.Queue(MOST_LINES)
        self._queued = _Queued(self._waiting)
        self._written = _Written(self._waiting, descriptor)
        self._logger = logging.Logger("saccade.serve")
        self._logger.addHandler(self._queued)
        self._written.start()

    @property
    def lost(self) -> int:
        """Number of texts that were not written."""
        return self._queued.lost + self._written.lost

    def write(self, text: str) -> None:
        """Appends text, with its line break; never waits."""
        self._logger.info("%s", text)

    def close(self, seconds: float = 2.0) -> None:
        """Writes what waits, for at most the given number of seconds."""

        def end() -> None:
            self._waiting.join()
            self._written.stop()

        ending = threading.Thread(target=end, daemon=True)
        ending.start()
        ending.join(seconds)


class _Lines:
    """What all logs do: write to a file descriptor, and limit the number of warnings a second."""

    every = STATISTICS_SECONDS

    def __init__(self, descriptor: int) -> None:
        self._writer = Writer(descriptor)
        self._second, self._passed, self._held = 0, 0, 0

    def close(self) -> None:
        """See :class:`Log`."""
        self._writer.close()

    def _left_out(self) -> int | None:
        """The number of warnings that were not written before this one, or None if this is not either."""
        now = int(time.monotonic())
        if now != self._second:
            self._second, self._passed = now, 0
        if self._passed >= MOST_WARNINGS:
            self._held += 1
            return None
        self._passed += 1
        held, self._held = self._held, 0
        return held


class JsonLog(_Lines):
    """JSON lines on standard output: an object with ``event`` and ``time`` (seconds since 1970) each.

    Events: ``listening``, ``request``, ``statistics``, ``warning``, ``stopping``, ``stopped``.
    """

    def __init__(self, descriptor: int = 1) -> None:
        super().__init__(descriptor)

    def event(self, name: str, **fields: Any) -> None:
        """See :class:`Log`."""
        if name == "warning":
            if (held := self._left_out()) is None:
                return
            fields |= {"left_out": held} if held else {}
        self._write(name, fields)

    def request(self, **fields: Any) -> None:
        """See :class:`Log`."""
        self._write("request", fields)

    def statistics(self, summary: dict[str, Any]) -> None:
        """See :class:`Log`."""
        self._write("statistics", {**summary, "lost_lines": self._writer.lost})

    def _write(self, name: str, fields: dict[str, Any]) -> None:
        self._writer.write(
            dumps({"event": name, "time": round(time.time(), 6), **fields}, default=str) + "\n"
        )


class TextLog(_Lines):
    """Lines on standard error: what happens, errors, and statistics where there are new requests."""

    def __init__(self, descriptor: int = 2) -> None:
        super().__init__(descriptor)
        self._last = ""

    def event(self, name: str, **fields: Any) -> None:
        """See :class:`Log`."""
        text = _described(name, fields)
        if name == "warning":
            if (held := self._left_out()) is None:
                return
            text += f" (and {held} more)" if held else ""
        self._line(text)

    def request(self, **fields: Any) -> None:
        """See :class:`Log`. Only errors are written."""
        if fields.get("error"):
            self.event("warning", client=fields.get("client", ""), message=fields["error"])

    def statistics(self, summary: dict[str, Any]) -> None:
        """See :class:`Log`."""
        text = line(summary)
        if summary["requests"] and (text.partition(";")[0] != self._last.partition(";")[0]):
            self._line(text)
        self._last = text

    def _line(self, text: str) -> None:
        self._writer.write(f"saccade serve: {printable(text)}\n")


class LiveLog(TextLog):
    """On a terminal: the lines of :class:`TextLog`, with one live line of statistics below them."""

    every = LIVE_SECONDS

    def statistics(self, summary: dict[str, Any]) -> None:
        """See :class:`Log`."""
        self._last = line(summary)
        self._writer.write(ERASE + self._shown())

    def close(self) -> None:
        """See :class:`Log`."""
        self._writer.write("\n")
        super().close()

    def _line(self, text: str) -> None:
        self._writer.write(f"{ERASE}saccade serve: {printable(text)}\n{self._shown()}")

    def _shown(self) -> str:
        """The live line, as wide as the terminal at most."""
        return self._last[: shutil.get_terminal_size().columns - 1]


def _described(name: str, fields: dict[str, Any]) -> str:
    if name == "warning":
        client = fields.get("client")
        return f"{client}: {fields['message']}" if client else str(fields["message"])
    if name == "listening":
        return f"listening on {fields['address']} ({fields['policy']})"
    details = ", ".join(f"{key} {value}" for key, value in fields.items())
    return f"{name}{f': {details}' if details else ''}"
