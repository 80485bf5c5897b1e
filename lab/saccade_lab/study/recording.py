"""Recorded observations as a source, without a simulator: what any have in common, and a file of features."""

from __future__ import annotations

import functools
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade._internal.files import sha256_of
from saccade.head.config import HeadConfig
from saccade.head.head import ActionHead
from saccade.head.intervention import Intervention
from saccade_lab.files import checkpoint_identity
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.study.source import Source, episode_rng

NOISES = 4  # drawn for each observation that has none


class Recorded(Source):
    """Observations that are there before a study begins. There is no closed loop, so success is unknown.

    Attributes:
        task: What stands in the tables in place of the simulator's task.
        seed: Seed of random tokens, and of the noise of observations that have none.
    """

    closed_loop: ClassVar[bool] = False
    task: ClassVar[str]
    seed: int

    @property
    @abstractmethod
    def all(self) -> HeadInputs:
        """All observations, checked."""

    @property
    def others(self) -> HeadInputs | None:
        """For each of ``all`` an observation to compare it with, or None if there are none."""
        return None

    @property
    def units(self) -> list[tuple[str, int]]:
        """Every observation by its number."""
        return [(self.task, row) for row in range(len(self.all))]

    @property
    def config(self) -> HeadConfig:
        """See ``Source``."""
        return self.head().config

    def observed(self, task: str, seed: int) -> HeadInputs:
        """See ``Source``."""
        rng = np.random.default_rng([self.seed, seed])
        return self.all.row(seed).with_noise(rng, self.config, NOISES)

    def episode_of(self, row: int) -> int:
        """The episode of an observation, or its number if unknown."""
        return int(self.all.clusters[row])

    def rng(self, task: str, seed: int) -> np.random.Generator:
        """See ``Source``; the same for all observations of an episode."""
        return episode_rng(f"{task} {self.seed}", self.episode_of(seed))

    def encode(self, observation: HeadInputs) -> Any:
        """See ``Source``."""
        return observation.encode(self.head())

    def actions(
        self, observation: HeadInputs, intervention: Intervention | None, context: Any = None
    ) -> Float32Array:
        """The head's own, normalised actions, those that count; see ``Source``."""
        found = observation.sample(self.head(), context, intervention=intervention)
        found = found[..., : self.action_width]
        return found if found.ndim == 4 else found[:, None]

    def comparable(self, chunk: Float32Array) -> Float32Array:
        """See ``Source``."""
        return chunk

    def outcome(self, task: str, seed: int, intervention: Intervention | None) -> dict[str, Any]:
        """See ``Source``."""
        return {"success": None}

    def labels(self, task: str, seed: int) -> dict[str, Any]:
        """See ``Source``."""
        return {"episode": self.episode_of(seed)}

    def describe_head(self, checkpoint: dict[str, str]) -> dict[str, Any]:
        """What ``describe`` says of the checkpoint.

        Args:
            checkpoint: Its name and hash.
        """
        return {
            **checkpoint,
            "num_future_tokens": self.config.num_future_tokens,
            "num_layers": self.config.num_layers,
            "num_steps": self.config.num_steps,
            "num_vl_tokens": self.all.num_vl_tokens,
        }


def num_episodes(observation: HeadInputs) -> int | None:
    """The number of episodes, or None if unknown."""
    return None if observation.episode is None else int(observation.episode.max()) + 1


@dataclass(frozen=True)
class Recording(Recorded):
    """A checkpoint and a file of features for it.

    Attributes:
        checkpoint: A checkpoint that ``ActionHead.from_pretrained`` reads.
        file: File of features, see ``saccade.head.input_files.read_arrays``.
        config_file: Path of the head's config. Default: that of the checkpoint.
        seed: Seed of random tokens, and of the noise if the file contains none.
        num_threads: Number of threads of the head. Default: that of the engine.
    """

    checkpoint: str
    file: str
    config_file: str | None = None
    seed: int = 0
    num_threads: int | None = None
    task: ClassVar[str] = "features"

    @property
    def files(self) -> tuple[str, ...]:
        """See ``Source``."""
        return (*super().files, self.file)

    def describe(self) -> dict[str, Any]:
        """See ``Source``."""
        found = self.all
        checkpoint = checkpoint_identity(Path(self.checkpoint))
        if self.config_file is not None:
            checkpoint["config_sha256"] = sha256_of(Path(self.config_file))
        return {
            "checkpoint": self.describe_head(checkpoint),
            "features": {
                "name": Path(self.file).name,
                "sha256": sha256_of(Path(self.file)),
                "observations": len(found),
                "episodes": num_episodes(found),
                "noise": f"{NOISES} draws an observation" if found.noise is None else "of the file",
            },
            "seed": self.seed,
        }

    def head(self, precision: str = "float32") -> ActionHead:
        """See ``Source``."""
        return head_of(self.checkpoint, self.config_file, precision, self.num_threads)

    @property
    def all(self) -> HeadInputs:
        """All observations of the file, checked; raises as ``HeadInputs.from_file``."""
        return read(self.file, self.config)


@functools.lru_cache(maxsize=3)
def head_of(checkpoint: str, config: str | None, precision: str, num_threads: int | None) -> ActionHead:
    """The head. One of each precision is cached."""
    return ActionHead.from_pretrained(checkpoint, config=config, precision=precision, num_threads=num_threads)


@functools.lru_cache(maxsize=1)
def read(file: str, config: HeadConfig) -> HeadInputs:
    """The observations of a file, cached for the next cell."""
    return HeadInputs.from_file(Path(file), config)
