"""Robots: the statistics of their states and actions, and the normalizer that uses them.

`reading` finds the statistics of a checkpoint and chooses their layout. Each layout has a file of its own:
`isaac_metadata` (Isaac-GR00T N1 and N1.5, with `data_configs`), `isaac_processor` (Isaac-GR00T N1.6 and
N1.7), `lerobot` (with `lerobot_pipeline`) and `flat` (a mapping). `embodiments` has the tags and ids of each
release. `groups` has the arithmetic, `rotations` that of rotations and poses.
"""

from saccade.robots.data_configs import LANGUAGE_KEY, RELEASED, DataConfig, DataConfigLike, data_config
from saccade.robots.embodiments import N15_IDS, N16_IDS, N17_IDS
from saccade.robots.files import read_json
from saccade.robots.groups import Group, Robot
from saccade.robots.normalizer import Normalizer, padded

__all__ = [
    "LANGUAGE_KEY",
    "N15_IDS",
    "N16_IDS",
    "N17_IDS",
    "RELEASED",
    "DataConfig",
    "DataConfigLike",
    "Group",
    "Normalizer",
    "Robot",
    "data_config",
    "padded",
    "read_json",
]
