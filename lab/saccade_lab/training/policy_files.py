"""What training needs to know of a policy's files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from saccade.head.config import HeadConfig
from saccade.processor import Processor
from saccade.robots import Normalizer
from saccade_lab.backbone_sizes import BackboneSizes


class PolicyFiles(Protocol):
    """All of a policy that is decided before its training; Meta-World and LIBERO have one each."""

    @property
    def head_config(self) -> HeadConfig:
        """The head's config."""
        ...

    @property
    def backbone_sizes(self) -> BackboneSizes:
        """The backbone's sizes."""
        ...

    @property
    def normalizer(self) -> Normalizer:
        """What the policy's states and actions are normalised by."""
        ...

    @property
    def instructions(self) -> Sequence[Sequence[str]]:
        """The wordings of each task, by the number that samples have of it."""
        ...

    @property
    def impossible(self) -> Sequence[Sequence[int]]:
        """Per task, the tasks of the policy that cannot be done in its scene."""
        ...

    @property
    def num_cameras(self) -> int:
        """Views of an observation."""
        ...

    @property
    def frame_size(self) -> int:
        """Pixels along each side of a recorded frame."""
        ...

    def processor(self) -> Processor:
        """What prepares images and instruction."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """The content of ``config.json``."""
        ...

    def metadata(self) -> dict[str, Any]:
        """Statistics of the robot, and what else is written with them."""
        ...

    def write(self, folder: Path) -> None:
        """Writes all files of the policy except its weights."""
        ...
