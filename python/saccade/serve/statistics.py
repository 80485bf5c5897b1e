"""What a server has done: counts, sizes of batches, and the latency of its answers by part."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from saccade.serve.engine import PARTS

#: Latencies are those of so many answers, the last ones.
WINDOW = 1024


class Statistics:
    """Counts and latencies since the start; one thread uses it.

    Attributes:
        requests: Number of requests by endpoint; ``"unreadable"`` for those that had none.
        errors: Number of them that did not get what they asked for.
        dropped: Number of them by why nobody got their answer: ``"gone"`` and ``"late"`` were not computed,
            ``"unsent"`` were computed in vain.
    """

    def __init__(self) -> None:
        self.requests: Counter[str] = Counter()
        self.errors = 0
        self.dropped: Counter[str] = Counter()
        self._started = time.monotonic()
        self._computed: deque[tuple[float, int, Mapping[str, float]]] = deque(maxlen=WINDOW)

    def count(self, endpoint: str, *, is_error: bool) -> None:
        """Counts a request."""
        self.requests[endpoint] += 1
        self.errors += is_error

    def computed(self, batch: int, milliseconds: Mapping[str, float]) -> None:
        """Takes notice of actions, of which so many observations were computed together."""
        self._computed.append((time.monotonic(), batch, milliseconds))

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON.

        Returns:
            ``requests``, ``errors`` and ``dropped`` since the start, ``per_second`` over the last actions,
            ``batch`` (mean number of observations computed together, as a request sees it), and
            ``milliseconds``: ``p50`` and ``p99`` by part.
        """
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
