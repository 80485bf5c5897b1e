"""Items of work for the tests of processes: they die, fail, or say where they ran."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Square:
    """Squares numbers, and writes a line to `log` before it begins.

    Attributes:
        log: Text file with the process and the number of each attempt.
        dies_once: Numbers whose process is killed at the first attempt.
        dies: Numbers whose process is killed at every attempt.
        fails: Numbers that raise an error.
        holds: Seconds that each attempt takes.
    """

    log: Path
    dies_once: tuple[int, ...] = ()
    dies: tuple[int, ...] = ()
    fails: tuple[int, ...] = ()
    holds: float = 0.0

    def __call__(self, number: int) -> int:
        first = number not in self.attempts
        with self.log.open("a") as log:
            log.write(f"{os.getpid()} {number}\n")
        time.sleep(self.holds)
        if number in self.dies or (first and number in self.dies_once):
            os._exit(9)
        if number in self.fails:
            raise ValueError(f"cannot square {number}")
        return number**2

    @property
    def attempts(self) -> list[int]:
        """The numbers that were begun."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return [int(line.split()[1]) for line in lines]


@dataclass(frozen=True)
class Reads:
    """Says where a file is that it was given, what is in it, and which node read it.

    Attributes:
        path: The file or directory.
        hold: Seconds that each item takes.
    """

    path: str
    hold: float = 0.0

    def __call__(self, number: int) -> tuple[int, str, bytes, str]:
        time.sleep(self.hold)
        path = Path(self.path)
        content = path.read_bytes() if path.is_file() else (path / "weights.bin").read_bytes()
        return number, self.path, content, os.environ.get("TMPDIR", "")
