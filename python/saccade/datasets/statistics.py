"""Statistics of features, by lerobot's rules: of one episode, and of several together.

Quantiles of an episode come from a histogram of 5000 bins between minimum and maximum, those of a data set
are the smallest (up to the median) or the largest of its episodes. Both are as in lerobot's
``datasets/compute_stats.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Numbers = npt.NDArray[np.floating[Any]]


def aggregate(episodes: Sequence[Mapping[str, Mapping[str, Numbers]]]) -> dict[str, dict[str, Numbers]]:
    """The statistics of several episodes together.

    Args:
        episodes: For each episode the statistics of its features; at least one.
    """
    keys = dict.fromkeys(key for episode in episodes for key in episode)
    return {key: _aggregate([episode[key] for episode in episodes if key in episode]) for key in keys}


def _aggregate(parts: Sequence[Mapping[str, Numbers]]) -> dict[str, Numbers]:
    """The statistics of one feature: means and variances are weighted by the number of steps."""
    counts = np.stack([part["count"] for part in parts])
    total = counts.sum(axis=0)
    means = np.stack([part["mean"] for part in parts])
    weights = counts.reshape(counts.shape + (1,) * (means.ndim - counts.ndim))
    mean = (means * weights).sum(axis=0) / total
    variances = np.stack([part["std"] ** 2 for part in parts]) + (means - mean) ** 2
    found = {
        "min": np.min(np.stack([part["min"] for part in parts]), axis=0),
        "max": np.max(np.stack([part["max"] for part in parts]), axis=0),
        "mean": mean,
        "std": np.sqrt((variances * weights).sum(axis=0) / total),
        "count": total,
    }
    for name in parts[0]:
        if name.startswith("q") and name[1:].isdigit() and all(name in part for part in parts):
            widest = np.min if int(name[1:]) <= 50 else np.max
            found[name] = widest(np.stack([part[name] for part in parts]), axis=0)
    return found
