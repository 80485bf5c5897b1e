"""Made-up effects of changes, for the rules of a diagnosis and what follows from them."""

from __future__ import annotations

from saccade._internal.bootstrap import Estimate
from saccade.diagnosis import Effect
from saccade.diagnosis.changes import Kind


def effect(kind: Kind | None, low: float, high: float, episodes: int = 20, of_noise: float = 5.0) -> Effect:
    """An effect with an interval of its share."""
    return Effect(
        kind=kind,
        share=Estimate((low + high) / 2, low, high),
        of_noise=Estimate(of_noise, of_noise, of_noise),
        units={},
        episodes=episodes,
        largest=(0, 0),
    )


#: That of another observation, in enough episodes.
SEEN = effect(None, 1, 1)
