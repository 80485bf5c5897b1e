"""Recorded data sets: LeRobotDataset v2.0, v2.1 and v3.0, with Isaac-GR00T's ``modality.json`` or without.

:func:`open` opens one, :class:`Writer` writes one. Needs the extra ``data``.

- ``opening``, ``source``: the folder, and what it is read as.
- ``metadata`` with ``features``: what the data set says about itself, in any version.
- ``modality``, ``selection``: which numbers and cameras the keys are, and which of them a policy takes.
- ``stored`` with ``parquet`` and ``videos``: columns and frames, as they are recorded.
- ``dataset`` with ``forms``: observations, states and actions.
- ``writing``, ``encoding``: a data set of version 3.0.
- ``statistics``: by lerobot's rules.
"""

from saccade.datasets.dataset import Dataset
from saccade.datasets.features import Episode
from saccade.datasets.opening import open
from saccade.datasets.videos import Frame
from saccade.datasets.writing import Writer

__all__ = ["Dataset", "Episode", "Frame", "Writer", "open"]
