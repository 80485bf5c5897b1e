"""Observation formats: Isaac-GR00T's two, and lerobot's.

:func:`read` detects the format of an observation by its keys, checks the observation against what the robot
needs, and returns a :class:`ParsedObservation`, which is the same for all formats.

- ``requirements``: what a robot's observation must contain; ``checkpoint`` reads it from a checkpoint.
- ``formats``: the table of formats; ``isaac`` and ``lerobot`` have them, ``checks`` what they share.
- ``pictures``: observations from image files.
"""

from saccade.observations.checkpoint import read_requirements
from saccade.observations.checks import view_places
from saccade.observations.formats import FORMATS, read, read_state
from saccade.observations.parsed import ObservationFormat, ParsedObservation, ParsedState
from saccade.observations.requirements import Camera, Requirements

__all__ = [
    "FORMATS",
    "Camera",
    "ObservationFormat",
    "ParsedObservation",
    "ParsedState",
    "Requirements",
    "read",
    "read_requirements",
    "read_state",
    "view_places",
]
