"""saccade.linalg and the folds of the studies against scikit-learn and SciPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import scipy.linalg
from sklearn.decomposition import PCA as Components
from sklearn.linear_model import Ridge as Regression
from sklearn.model_selection import GroupKFold, StratifiedGroupKFold
from sklearn.preprocessing import StandardScaler

from saccade.errors import InputError
from saccade.linalg import PCA, Ridge, Standardizer, principal_angles
from saccade_lab.study.folds import grouped_folds, stratified_folds

SHAPES = [(60, 9), (9, 60), (25, 25), (600, 300), (5, 1)]


def rows_of(shape: tuple[int, int], kind: str) -> npt.NDArray[np.float64]:
    """Rows that are of full rank, of rank 3, or constant in some columns."""
    rng = np.random.default_rng(shape)
    x = rng.standard_normal(shape) * rng.uniform(0.1, 10, shape[1]) + rng.uniform(-5, 5, shape[1])
    if kind == "deficient":
        x = rng.standard_normal((shape[0], 3)) @ rng.standard_normal((3, shape[1])) + 1.0
    if kind == "constant":
        x[:, ::3] = 0.1
    return x


@pytest.mark.parametrize("kind", ["full", "deficient", "constant"])
@pytest.mark.parametrize("shape", SHAPES)
def test_standardised_ridge_is_scikit_learn_s(shape: tuple[int, int], kind: str) -> None:
    x = rows_of(shape, kind)
    y = np.random.default_rng(1).standard_normal((shape[0], 3)) + x[:, :1]
    new = rows_of((4, shape[1]), "full")
    scaler, peer = Standardizer(x), StandardScaler().fit(x)
    np.testing.assert_allclose(scaler.mean, peer.mean_, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(scaler.scale, peer.scale_, rtol=1e-12)
    np.testing.assert_allclose(scaler.transform(new), peer.transform(new), rtol=1e-11, atol=1e-11)
    standard = peer.transform(x)
    alphas = [1e-2, 1.0, 1e5]
    ridge = Ridge(standard, y, alphas)
    for place, alpha in enumerate(alphas):
        regression = Regression(alpha=alpha).fit(standard, y)
        np.testing.assert_allclose(ridge.weights[place], regression.coef_.T, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(ridge.intercepts[place], regression.intercept_, rtol=1e-9, atol=1e-11)
        predicted = regression.predict(peer.transform(new))
        np.testing.assert_allclose(ridge.predict(peer.transform(new))[place], predicted, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("kind", ["full", "deficient", "constant"])
@pytest.mark.parametrize("shape", SHAPES)
def test_components_are_scikit_learn_s(shape: tuple[int, int], kind: str) -> None:
    x = rows_of(shape, kind)
    rank = np.linalg.matrix_rank(x - x.mean(axis=0))
    if rank == 0:
        pytest.skip("the only column is constant")
    pca, peer = PCA(x, rank), Components(rank, svd_solver="full").fit(x)
    np.testing.assert_allclose(pca.mean, peer.mean_, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(pca.explained_variance, peer.explained_variance_, rtol=1e-9)
    np.testing.assert_allclose(
        pca.explained_variance / pca.total_variance, peer.explained_variance_ratio_, rtol=1e-9
    )
    np.testing.assert_allclose(pca.components, peer.components_, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(pca.transform(x), peer.transform(x), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    "shapes", [((20, 3), (20, 5)), ((20, 8), (20, 2)), ((6, 9), (6, 2)), ((50, 30), (50, 30))]
)
def test_angles_are_scipy_s(shapes: tuple[tuple[int, int], tuple[int, int]]) -> None:
    a, b = (rows_of(shape, "full") for shape in shapes)
    found, expected = principal_angles(a, b), scipy.linalg.subspace_angles(a, b)
    np.testing.assert_allclose(found, expected[::-1], atol=1e-7)  # SciPy's are descending
    near = a + 1e-9 * rows_of(a.shape, "deficient")
    np.testing.assert_allclose(
        principal_angles(a, near), scipy.linalg.subspace_angles(a, near)[::-1], atol=1e-12
    )


@pytest.mark.parametrize("seed", range(8))
def test_folds_are_scikit_learn_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, tasks, folds = int(rng.integers(10, 40)), int(rng.integers(1, 5)), int(rng.integers(2, 6))
    episodes = rng.permutation(np.repeat(3 * np.arange(count), rng.integers(1, 9, count)))
    rows = np.zeros((len(episodes), 1))
    # Episodes of one task, as in the studies, and with rows of several.
    for classes in (episodes // 3 % tasks, rng.integers(0, tasks, len(episodes))):
        made = list(stratified_folds(classes, episodes, folds, seed))
        expected = StratifiedGroupKFold(folds, shuffle=True, random_state=seed).split(rows, classes, episodes)
        same(made, list(expected))
    same(list(grouped_folds(episodes, folds)), list(GroupKFold(folds).split(rows, groups=episodes)))


def same(
    made: Sequence[tuple[npt.NDArray[Any], ...]], expected: Sequence[tuple[npt.NDArray[Any], ...]]
) -> None:
    assert len(made) == len(expected)
    for ours, theirs in zip(made, expected, strict=True):
        for mine, other in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(mine, other)


def test_more_folds_than_groups_are_refused() -> None:
    with pytest.raises(InputError, match="folds: expected 2 to 3, the number of groups, got 4"):
        list(grouped_folds(np.array([0, 1, 2, 2]), 4))
    with pytest.raises(InputError, match="folds: expected 2 to 3"):
        list(stratified_folds(np.zeros(4), np.array([0, 1, 2, 2]), 1, seed=0))
