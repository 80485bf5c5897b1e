"""Statistics of future tokens: whether they are distinct, and how far they are from their initialisation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from saccade._internal.arrays import Float32Array
from saccade.checkpoints.findings import Spread, TokenGeometry, TokenStatistics
from saccade.checkpoints.initialisation import NORMAL_STD, Draw, distance, is_as_drawn, sample


def token_statistics(tokens: Float32Array, key_bias: Sequence[float] | None = None) -> TokenStatistics:
    """Statistics of future tokens ``(N, width)``, at least one, and the ``future_key_bias`` of the config."""
    drawn = NORMAL_STD * np.random.default_rng(0).standard_normal(tokens.shape, np.float32)
    values, fresh = sample(tokens), Draw("normal", NORMAL_STD)
    _, index, counts = np.unique(tokens, axis=0, return_inverse=True, return_counts=True)
    groups = [np.flatnonzero(index.reshape(-1) == group).tolist() for group in np.flatnonzero(counts > 1)]
    groups.sort()
    return TokenStatistics(
        **vars(token_geometry(tokens)),
        count=tokens.shape[0],
        std=float(np.std(tokens, dtype=np.float64)),
        distance=distance(values, fresh),
        as_drawn=is_as_drawn(values, fresh),
        identical=groups,
        zero=np.flatnonzero(~tokens.any(axis=1)).tolist(),
        drawn=token_geometry(drawn),
        key_bias=None if key_bias is None else list(key_bias),
    )


def token_geometry(tokens: Float32Array) -> TokenGeometry:
    """Norms, cosines of pairs and effective rank of tokens ``(N, width)``, computed in float64."""
    wide = tokens.astype(np.float64)
    norms = np.linalg.norm(wide, axis=1)
    unit = wide / np.where(norms == 0.0, 1.0, norms)[:, None]
    cosines = (unit @ unit.T)[np.triu_indices(len(unit), 1)]
    values = np.linalg.svd(wide, compute_uv=False)
    shares = values[values > 0.0] / max(float(values.sum()), np.finfo(np.float64).tiny)
    return TokenGeometry(
        norm=spread_of(norms),
        cosine=spread_of(cosines),
        effective_rank=float(np.exp(-np.sum(shares * np.log(shares)))) if shares.size else 0.0,
    )


def spread_of(values: np.ndarray) -> Spread | None:
    """Mean, minimum and maximum; None if there are no values."""
    if values.size == 0:
        return None
    return Spread(mean=float(values.mean()), min=float(values.min()), max=float(values.max()))
