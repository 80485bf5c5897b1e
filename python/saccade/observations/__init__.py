"""The forms of observations and answers: Isaac-GR00T's two, and lerobot's.

`dialects.read` tells the form of an observation by its keys, checks it against what the robot needs
(`requirements`, read from the checkpoint by `sources`), and returns a `Reading`, which is the same for all
forms. `isaac_nested`, `isaac_flat` and `lerobot` have one form each; `checks` has what they share.
"""

from saccade.observations.checks import view_places
from saccade.observations.formats import DIALECTS, read, read_state
from saccade.observations.parsed import Dialect, Reading, StateReading
from saccade.observations.requirements import Camera, Requirements
from saccade.observations.sources import ObservationSources, observation_sources

__all__ = [
    "DIALECTS",
    "Camera",
    "Dialect",
    "ObservationSources",
    "Reading",
    "Requirements",
    "StateReading",
    "observation_sources",
    "read",
    "read_state",
    "view_places",
]
