"""A recording as a source: a file of backbone features for any checkpoint, without a simulator."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from saccade import observation
from saccade._arrays import Float32Array
from saccade._files import checkpoint_identity, sha256_of
from saccade.config import HeadConfig
from saccade.head import ActionHead
from saccade.intervention import Intervention
from saccade.observation import Observation
from saccade.study.source import Source, episode_rng

TASK = "features"  # in the tables, in place of the simulator's task
NOISES = 4  # drawn for each observation if the file has none


@dataclass(frozen=True)
class Recording(Source):
    """A checkpoint and a file of features for it. There is no closed loop, so success is unknown.

    Attributes:
        checkpoint: A checkpoint that `ActionHead.load` reads.
        file: File of features, see `saccade.observation.read_arrays`.
        config_file: Path of the head's config. Default: that of the checkpoint.
        seed: Seed of random tokens, and of the noise if the file contains none.
        num_threads: Number of threads of the head. Default: that of the engine.
    """

    checkpoint: str
    file: str
    config_file: str | None = None
    seed: int = 0
    num_threads: int | None = None
    closed_loop: ClassVar[bool] = False

    def describe(self) -> dict[str, Any]:
        """See `Source`."""
        found = self.all
        checkpoint = checkpoint_identity(Path(self.checkpoint))
        if self.config_file is not None:
            checkpoint["config_sha256"] = sha256_of(Path(self.config_file))
        return {
            "checkpoint": {
                **checkpoint,
                "num_future_tokens": self.config.num_future_tokens,
                "num_layers": self.config.num_layers,
                "num_steps": self.config.num_steps,
                "num_vl_tokens": found.num_vl_tokens,
            },
            "features": {
                "name": Path(self.file).name,
                "sha256": sha256_of(Path(self.file)),
                "observations": len(found),
                "episodes": None if found.episode is None else int(found.episode.max()) + 1,
                "noise": f"{NOISES} draws an observation" if found.noise is None else "of the file",
            },
            "seed": self.seed,
        }

    @property
    def files(self) -> tuple[str, ...]:
        """See `Source`."""
        return (*super().files, self.file)

    @property
    def units(self) -> list[tuple[str, int]]:
        """Every row of the file."""
        return [(TASK, row) for row in range(len(self.all))]

    @property
    def config(self) -> HeadConfig:
        """See `Source`."""
        return self.head().config

    def head(self, precision: str = "float32") -> ActionHead:
        """See `Source`."""
        return head_of(self.checkpoint, self.config_file, precision, self.num_threads)

    @property
    def all(self) -> Observation:
        """All observations of the file, checked; raises as `saccade.observation.read`."""
        return read(self.file, self.config)

    def observed(self, task: str, seed: int) -> Observation:
        """See `Source`."""
        rng = np.random.default_rng([self.seed, seed])
        return self.all.row(seed).with_noise(rng, self.config, NOISES)

    def episode_of(self, row: int) -> int:
        """The episode of a row of the file, or the row itself if unknown."""
        return int(self.all.clusters[row])

    def rng(self, task: str, seed: int) -> np.random.Generator:
        """See `Source`; the same for all rows of an episode."""
        return episode_rng(f"{task} {self.seed}", self.episode_of(seed))

    def encode(self, observation: Observation) -> Any:
        """See `Source`."""
        return observation.encode(self.head())

    def actions(
        self, observation: Observation, intervention: Intervention | None, context: Any = None
    ) -> Float32Array:
        """The head's own, normalised actions; see `Source`."""
        found = observation.sample(self.head(), context, intervention=intervention)
        return found if found.ndim == 4 else found[:, None]

    def comparable(self, chunk: Float32Array) -> Float32Array:
        """See `Source`."""
        return chunk

    def outcome(self, task: str, seed: int, intervention: Intervention | None) -> dict[str, Any]:
        """See `Source`."""
        return {"success": None}

    def labels(self, task: str, seed: int) -> dict[str, Any]:
        """See `Source`."""
        return {"episode": self.episode_of(seed)}


@functools.lru_cache(maxsize=3)
def head_of(checkpoint: str, config: str | None, precision: str, num_threads: int | None) -> ActionHead:
    """The head. One of each precision is cached."""
    return ActionHead.load(checkpoint, config=config, precision=precision, num_threads=num_threads)


@functools.lru_cache(maxsize=1)
def read(file: str, config: HeadConfig) -> Observation:
    """The observations of a file, cached for the next cell."""
    return observation.read(Path(file), config)
