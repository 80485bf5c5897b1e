"""Statistics of attention maps: mass by part, entropy, and similarity of the maps of several tokens."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating[Any]]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Overlap:
    """How similar the maps of several tokens are.

    Attributes:
        jensen_shannon: Mean over all pairs of the Jensen-Shannon divergence, divided by its largest value
            ln 2: 0 for identical maps, 1 for maps that share no key.
        cosine: Mean cosine over all pairs: 1 for identical maps, 0 for maps that share no key.
        distinct: Effective number of distinct maps: exp(H(mean map) - mean H(map)), which is the exponential
            of the information between token and key. 1 for identical maps, the number of tokens if no two
            share a key.
    """

    jensen_shannon: float
    cosine: float
    distinct: float


@dataclass(frozen=True)
class Spread:
    """Entropies of the maps of a group, in nats. A uniform map with that entropy has exp(entropy) keys."""

    mean: float
    least: float
    most: float


@dataclass(frozen=True)
class GroupSummary:
    """The maps of one group of rows.

    Attributes:
        tokens: Rows in the group.
        mass: Share of attention by part of the keys, mean over the rows.
        entropy: Entropy of the rows' maps.
        overlap: Between the rows' maps; None with fewer than two.
        shuffled: Overlap after each map was shuffled separately, see ``shuffle``: the overlap of unrelated
            maps with the same entropies.
    """

    tokens: int
    mass: dict[str, float]
    entropy: Spread
    overlap: Overlap | None
    shuffled: Overlap | None


def entropy(maps: FloatArray) -> npt.NDArray[np.float64]:
    """Entropy of probabilities along the last axis, in nats; keys with probability 0 add nothing.

    Example:
        >>> float(np.exp(entropy(np.full(8, 1 / 8)))).__round__(6), float(entropy(np.eye(3)[0]))
        (8.0, 0.0)
    """
    p = np.asarray(maps, dtype=np.float64)
    logs = np.log(p, out=np.zeros_like(p), where=p > 0)
    total: npt.NDArray[np.float64] = np.maximum(-(p * logs).sum(axis=-1), 0.0)
    return total


def overlap(maps: FloatArray) -> Overlap | None:
    """Overlap of maps ``(tokens, keys)``; None with fewer than two."""
    p = np.asarray(maps, dtype=np.float64)
    tokens = len(p)
    if tokens < 2:
        return None
    entropies = entropy(p)
    divergences = []
    for first in range(tokens - 1):
        between = entropy((p[first] + p[first + 1 :]) / 2)
        divergences.append(between - (entropies[first] + entropies[first + 1 :]) / 2)
    norms = np.linalg.norm(p, axis=-1)
    unit = p / np.where(norms > 0, norms, 1.0)[:, None]
    # All pairs at once: |sum of unit vectors|^2 counts each pair twice and each token with itself once.
    cosines = (np.square(unit.sum(axis=0)).sum() - np.square(unit).sum()) / (tokens * (tokens - 1))
    return Overlap(
        # Rounding may make identical maps slightly negative.
        jensen_shannon=max(float(np.concatenate(divergences).mean()) / math.log(2), 0.0),
        cosine=float(cosines),
        distinct=max(float(np.exp(entropy(p.mean(axis=0)) - entropies.mean())), 1.0),
    )


def shuffle(maps: FloatArray, parts: Mapping[str, Indices], rng: np.random.Generator) -> FloatArray:
    """Shuffles each map ``(tokens, keys)`` by itself, within each part of the keys.

    Every token keeps its mass on each part and its entropy; the keys that it attends to become unrelated to
    those of the others.
    """
    shuffled = np.array(maps)
    for positions in parts.values():
        shuffled[:, positions] = rng.permuted(shuffled[:, positions], axis=1)
    return shuffled


def summarize(
    maps: FloatArray,
    parts: Mapping[str, Indices],
    shuffled_within: Mapping[str, Indices],
    rng: np.random.Generator,
) -> GroupSummary:
    """Summarises the maps ``(tokens, keys)`` of one group; at least one token.

    Args:
        maps: Probabilities.
        parts: The keys by what they are, for ``mass``.
        shuffled_within: The parts within which keys are shuffled.
        rng: Generator for the shuffling.
    """
    entropies = entropy(maps)
    mean = np.asarray(maps, dtype=np.float64).mean(axis=0)
    found = overlap(maps)
    return GroupSummary(
        tokens=len(maps),
        mass={name: float(mean[positions].sum()) for name, positions in parts.items()},
        entropy=Spread(float(entropies.mean()), float(entropies.min()), float(entropies.max())),
        overlap=found,
        shuffled=None if found is None else overlap(shuffle(maps, shuffled_within, rng)),
    )
