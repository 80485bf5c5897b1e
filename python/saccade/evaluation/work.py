"""One episode of ``saccade evaluate`` as an independent work item."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from saccade.evaluation.prediction import Predicted, predict_episode
from saccade.evaluation.source import Source


@dataclass(frozen=True)
class PredictEpisode:
    """Predicts an episode. It is pickled; each process loads policy and recordings once."""

    source: Source
    stride: int
    seed: int
    sampling: Mapping[str, Any]

    def __call__(self, episode: int) -> Predicted:
        """The predictions of the episode at a place of the data set."""
        return predict_episode(
            self.source.policy,
            self.source.data,
            episode,
            stride=self.stride,
            seed=self.seed,
            sampling=self.sampling,
            clock=time.perf_counter,
        )
