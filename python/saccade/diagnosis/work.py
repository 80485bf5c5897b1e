"""One episode of ``saccade diagnose`` as an independent work item."""

from __future__ import annotations

import time
from dataclasses import dataclass

from saccade.diagnosis.effects import Measured, measure_episode
from saccade.diagnosis.plan import Plan
from saccade.evaluation.source import Source


@dataclass(frozen=True)
class MeasureEpisode:
    """Measures an episode. It is pickled; each process loads policy and recordings once."""

    source: Source
    plan: Plan

    def __call__(self, episode: int) -> Measured:
        """The effects in the episode at a place of the data set."""
        return measure_episode(self.source.policy, self.source.data, episode, self.plan, time.perf_counter)
