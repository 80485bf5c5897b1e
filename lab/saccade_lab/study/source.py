"""Where a study's observations come from: the simulator or a recording, behind one interface."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.intervention import Intervention
from saccade_lab.head_inputs import HeadInputs


class Source(ABC):
    """Observations for a checkpoint.

    A source is a frozen dataclass: it is pickled, and results are cached by its value. A unit is an episode,
    identified by task and seed, or a row of a file, identified by ``recording.TASK`` and its number.

    Attributes:
        closed_loop: Whether episodes can be run, so that success is known.
        checkpoint: Path of the checkpoint.
    """

    closed_loop: ClassVar[bool]
    checkpoint: str

    @property
    def config_file(self) -> str | None:
        """Path of the head's config; None for the one in the checkpoint's directory."""
        return None

    @property
    def files(self) -> tuple[str, ...]:
        """The files and directories that are read, as the fields of the source name them."""
        return tuple(path for path in (self.checkpoint, self.config_file) if path is not None)

    @property
    def num_threads(self) -> int | None:
        """Threads that compute the head. Default: 1, because cells are spread over processes."""
        return 1

    @property
    def engine_name(self) -> str:
        """What computes the head."""
        return "rust"

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What identifies checkpoint and observations, as JSON values; part of a study's settings."""

    @property
    @abstractmethod
    def units(self) -> list[tuple[str, int]]:
        """Task and seed of every unit."""

    @property
    @abstractmethod
    def config(self) -> HeadConfig:
        """Config of the head."""

    @abstractmethod
    def head(self, precision: str = "float32") -> ActionHead:
        """The head; loaded once in a process for each precision."""

    @property
    def action_width(self) -> int:
        """Number of the head's action dimensions that count; they come first. Default: all."""
        return self.config.action_dim

    @property
    def future_tokens(self) -> Float32Array:
        """The learned future tokens, ``(N, width)``; N is 0 where the checkpoint has none."""
        return self.head().future_tokens

    @abstractmethod
    def observed(self, task: str, seed: int) -> HeadInputs:
        """The input of the unchanged head: all observations of an episode, or one row of the file.

        Returns:
            At least one row, with noise.
        """

    @abstractmethod
    def rng(self, task: str, seed: int) -> np.random.Generator:
        """The random numbers of an episode, apart from the noise of its chunks: the same for every arm."""

    @abstractmethod
    def actions(
        self, observation: HeadInputs, intervention: Intervention | None, context: Any = None
    ) -> Float32Array:
        """Chunks as they are compared, ``(batch, draws, horizon, action_dim)``.

        Args:
            observation: One row, with noise.
            intervention: The change inside the head; None for no change.
            context: The result of ``encode``. Default: it is computed.
        """

    @abstractmethod
    def encode(self, observation: HeadInputs) -> Any:
        """The ``context`` of an observation for ``actions``."""

    @abstractmethod
    def comparable(self, chunk: Float32Array) -> Float32Array:
        """Converts actions of the head to those that are compared: the robot's, or the head's own."""

    @abstractmethod
    def outcome(self, task: str, seed: int, intervention: Intervention | None) -> dict[str, Any]:
        """Columns of the table: success and length of an episode under an intervention.

        Success is None without a closed loop.
        """

    @abstractmethod
    def labels(self, task: str, seed: int) -> dict[str, Any]:
        """Columns that describe a unit in addition to task and seed."""


def episode_rng(task: str, seed: int) -> np.random.Generator:
    """The random numbers of an episode, apart from the noise of its chunks."""
    return np.random.default_rng([seed, *task.encode()])


@dataclass(frozen=True, eq=False)
class Unchanged:
    """What the unchanged head does on the observations of a unit.

    Attributes:
        observations: One row each.
        contexts: The context of each observation.
        actions: ``(observations, draws, horizon, action_dim)``, as they are compared.
    """

    observations: Sequence[HeadInputs]
    contexts: Sequence[Any]
    actions: Float32Array


@functools.lru_cache(maxsize=1)
def unchanged(source: Source, task: str, seed: int) -> Unchanged:
    """Runs the unchanged head on a unit. The result is cached for the next arm."""
    rows = list(source.observed(task, seed).rows())
    contexts = [source.encode(one) for one in rows]
    chunks = [source.actions(one, None, context) for one, context in zip(rows, contexts, strict=True)]
    return Unchanged(rows, contexts, np.concatenate(chunks))


def changed(source: Source, task: str, seed: int, intervention: Intervention | None) -> Float32Array:
    """The actions of ``unchanged`` with an intervention, from equal noise."""
    before = unchanged(source, task, seed)
    if intervention is None:
        return before.actions
    pairs = zip(before.observations, before.contexts, strict=True)
    return np.concatenate([source.actions(one, intervention, context) for one, context in pairs])
