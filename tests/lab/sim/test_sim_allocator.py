"""Freed memory stays with the process that trains."""

from __future__ import annotations

import ctypes
import platform
import subprocess
import sys

import pytest

from saccade_lab.sim.allocator import keep_freed_memory

#: Prints how many pages the system gave for filling 64 MB five times: as the C library decides, and kept.
PROGRAM = """
import resource
import torch
from saccade_lab.sim.allocator import keep_freed_memory

def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        torch.ones(16 << 20)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first = pages()
keep_freed_memory()
for _ in range(4):  # until there is memory that stays
    pages()
print(first, pages())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_memory_is_used_again() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    first, kept = map(int, done.stdout.split())
    assert first >= 5 * 30  # huge pages of 2 MB, or many more small ones
    assert kept < first / 10


def test_other_c_libraries_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: pytest.fail("was called"))
    keep_freed_memory()
