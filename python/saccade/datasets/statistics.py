"""Statistics of features, by lerobot's rules: of one episode, and of several together.

Quantiles of an episode come from a histogram of 5000 bins between minimum and maximum. Those of a data set
are the means of its episodes' quantiles, weighted by their steps. Both are as in lerobot 0.4 to 0.6,
``datasets/compute_stats.py``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Numbers = npt.NDArray[np.floating[Any]]

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
BINS = 5000
#: Of larger frames every n-th row and column counts, so that the longer side has about this many.
LARGE, REDUCED = 300, 150


def of_column(values: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """The statistics of a column of an episode, ``(steps, width)``, each of shape ``(width,)``."""
    return _of_rows(values) | {"count": np.array([len(values)])}


def of_frames(frames: npt.NDArray[np.uint8]) -> dict[str, npt.NDArray[Any]]:
    """The statistics of frames of an episode, ``(steps, H, W, 3)``, from 0 to 1, each of shape ``(3, 1, 1)``.

    Of long episodes some frames count, evenly spaced.
    """
    count = max(min(100, len(frames)), min(int(len(frames) ** 0.75), 10_000))
    sampled = frames[np.round(np.linspace(0, len(frames) - 1, count)).astype(int)]
    height, width = frames.shape[1:3]
    if max(height, width) >= LARGE:
        every = int(width / REDUCED) if width > height else int(height / REDUCED)
        sampled = sampled[:, ::every, ::every]
    found = _of_rows(sampled.reshape(-1, 3))
    return {name: value.reshape(3, 1, 1) / 255.0 for name, value in found.items()} | {
        "count": np.array([count])
    }


def _of_rows(rows: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """All statistics but the count. A single row is each of its quantiles."""
    if len(rows) < 2:
        mean = np.mean(rows, axis=0)
        found = {"min": rows[0], "max": rows[0], "mean": mean, "std": np.std(rows, axis=0)}
        return found | {_name(quantile): mean for quantile in QUANTILES}
    rows = rows.astype(np.result_type(rows.dtype, np.float32))
    mean, low, high = rows.mean(axis=0), rows.min(axis=0), rows.max(axis=0)
    found = {
        "min": low,
        "max": high,
        "mean": mean,
        "std": np.sqrt(np.maximum(0, np.mean(rows**2, axis=0) - mean**2)),
    }
    binned = []
    for place in range(rows.shape[1]):
        edges = np.linspace(low[place] - 1e-10, high[place] + 1e-10, BINS + 1)
        binned.append((np.cumsum(np.histogram(rows[:, place], bins=edges)[0]), edges))
    for quantile in QUANTILES:
        wanted = quantile * len(rows)
        found[_name(quantile)] = np.array([_quantile(sums, edges, wanted) for sums, edges in binned])
    return found


def _name(quantile: float) -> str:
    return f"q{int(quantile * 100):02d}"


def _quantile(sums: npt.NDArray[Any], edges: npt.NDArray[Any], wanted: float) -> Any:
    """The value below which ``wanted`` rows are, interpolated in its bin."""
    place = int(np.searchsorted(sums, wanted))
    if place == 0:
        return edges[0]
    if place >= len(sums):
        return edges[-1]
    inside = sums[place] - sums[place - 1]
    share = (wanted - sums[place - 1]) / inside
    return edges[place] + share * (edges[place + 1] - edges[place])


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
            found[name] = (np.stack([part[name] for part in parts]) * weights).sum(axis=0) / total
    return found
