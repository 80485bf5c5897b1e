"""One episode of LIBERO as results have it, and the seeds of its noise. Needs no simulator."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import TypeAlias

#: Suite, task and trial: which episode.
Key: TypeAlias = tuple[str, int, int]

#: What the time of an episode is spent on.
PARTS = ("reset", "draw", "encode", "sample", "physics")


@dataclass
class Episode:
    """One episode and its outcome.

    Attributes:
        suite: Name of the suite.
        task: Number of the task in it.
        trial: Number of the trial.
        success: Whether the goal was reached within the protocol's limit.
        steps: Control steps until success, or until the end; settling not counted.
        chunks: Number of chunks that the policy computed.
        seconds: Time by part of ``PARTS``.
    """

    suite: str
    task: int
    trial: int
    success: bool = False
    steps: int = 0
    chunks: int = 0
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))

    @property
    def key(self) -> Key:
        """Suite, task and trial."""
        return self.suite, self.task, self.trial


@dataclass(frozen=True)
class Noise:
    """The seeds of the noise that chunks begin with.

    Attributes:
        seed: Changes all of them.
        is_common: Whether every episode has the same: ``seed``, ``seed + 1``, and so on, as
            ``lerobot-eval --policy.seed`` gives them to saccade. Otherwise episodes are independent.
    """

    seed: int = 0
    is_common: bool = False

    def of(self, episode: Episode) -> int:
        """The seed of the next chunk of an episode.

        Example:
            >>> Noise(7, is_common=True).of(Episode("libero_object", 0, 0, chunks=2))
            9
        """
        if self.is_common:
            return self.seed + episode.chunks
        named = f"{self.seed} {episode.suite} {episode.task} {episode.trial} {episode.chunks}"
        return int.from_bytes(hashlib.sha256(named.encode()).digest()[:8], "little")
