"""Robots: the statistics of their states and actions, and the normalizer that uses them.

- ``normalizer``: :class:`saccade.Normalizer`, made of a ``robot``; ``groups`` has the arithmetic,
  ``rotations`` that of rotations and poses.
- ``reading``: finds the statistics of a checkpoint and chooses their layout: ``isaac_metadata`` (Isaac-GR00T
  N1 and N1.5, with ``data_configs``), ``isaac_processor`` (Isaac-GR00T N1.6 and N1.7), or ``lerobot`` (with
  ``lerobot_pipeline``). ``building`` has what the layouts share,
  ``libero`` what lerobot does with one embodiment.
- ``embodiments``: the tags and ids of each release.
"""

from saccade.robots.data_configs import LANGUAGE_KEY, RELEASED, DataConfig, DataConfigLike, data_config
from saccade.robots.embodiments import N15_IDS, N16_IDS, N17_IDS
from saccade.robots.groups import Group
from saccade.robots.normalizer import Normalizer, padded
from saccade.robots.robot import Robot

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
]
