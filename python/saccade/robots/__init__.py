"""Robots: the statistics of their states and actions, and the normalizer that uses them.

`reading` finds the statistics of a checkpoint and chooses their layout. Each layout has a file of its own:
`isaac_metadata` (Isaac-GR00T N1 and N1.5), `isaac_processor` (Isaac-GR00T N1.6 and N1.7), `lerobot` and
`flat` (a mapping). `groups` has the arithmetic.
"""

from saccade.robots.files import read_json
from saccade.robots.groups import Group, Robot
from saccade.robots.isaac_metadata import EMBODIMENTS
from saccade.robots.normalizer import Normalizer, padded

__all__ = ["EMBODIMENTS", "Group", "Normalizer", "Robot", "padded", "read_json"]
