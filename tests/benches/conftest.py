"""What the tests of several programs need."""

from __future__ import annotations

import pytest


@pytest.fixture
def known_peaks(monkeypatch: pytest.MonkeyPatch) -> None:
    """`benches.peers` in this process is told the peaks of the machine: measuring them takes two seconds."""
    from benches.peers import machine

    rates = {"macs_per_second": {"portable": {"float32": 1e9}}, "read_bytes_per_second": 1e9}
    monkeypatch.setattr(machine, "peaks", lambda threads: {"threads": threads, **rates})
