"""Rank correlations between numbers of policies: of all together, or within their recipes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata

from saccade_lab.study.statistics import Estimate, bootstrap

Float64Array = npt.NDArray[np.float64]


def correlated(pairs: Float64Array) -> Estimate:
    """The rank correlation of `(pairs, 2)` with its bootstrap interval over pairs."""
    return bootstrap(pairs, range(len(pairs)), rank_correlation, vectorized=True)


def correlated_within(values: Float64Array) -> Estimate:
    """`correlation_within` with its bootstrap interval over training seeds.

    A training seed is drawn with its policies of all recipes: they share data, noise and first weights.

    Args:
        values: `(training seeds, recipes, 2)`.
    """
    return bootstrap(values, range(len(values)), correlation_within, vectorized=True)


def rank_correlation(pairs: Float64Array) -> Float64Array:
    """Spearman's correlation of `(..., pairs, 2)`; NaN where a column is constant.

    Example:
        >>> rank_correlation(np.array([[1.0, 10.0], [2.0, 40.0], [9.0, 30.0]]))
        array(0.5)
    """
    return correlation_within(pairs[..., :, np.newaxis, :])


def correlation_within(values: Float64Array) -> Float64Array:
    """The rank correlation within recipes: that of policies which differ in their training seed alone.

    Each number is replaced by its rank among the policies of its recipe, minus the mean of these ranks. The
    result is the correlation of these centred ranks, over the policies of all recipes together. What differs
    between recipes has no part in it. A recipe with more policies has more weight.

    Args:
        values: `(..., training seeds, recipes, 2)`, both NaN for a policy that is not there.

    Returns:
        `(...)`; NaN where one of the two numbers is constant within each recipe.

    Example:
        Two recipes far from each other, with opposite orders within:

        >>> correlation_within(np.array([[[1.0, 1.0], [8.0, 9.0]], [[2.0, 2.0], [9.0, 8.0]]]))
        array(0.)
    """
    ranks = rankdata(values, axis=-3, nan_policy="omit")
    there = ~np.isnan(ranks)
    sums = np.where(there, ranks, 0.0).sum(axis=-3, keepdims=True)
    means = sums / np.maximum(there.sum(axis=-3, keepdims=True), 1)
    centred = np.where(there, ranks - means, 0.0)
    squares = (centred**2).sum(axis=(-3, -2)).prod(axis=-1)
    products = centred.prod(axis=-1).sum(axis=(-2, -1))
    return np.asarray(np.where(squares > 0, products / np.sqrt(np.where(squares > 0, squares, 1)), np.nan))
