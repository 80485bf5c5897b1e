"""Dense linear algebra of what a model computes: ridge regression, principal components, similarity.

Arguments are ``(rows, features)``, NumPy or torch. Everything is computed and returned in float64, on one
thread: equal inputs give equal bits on the same CPU. All but :func:`principal_angles` subtract the mean of
each column first; a column that varies by rounding alone counts as constant.

Errors name the argument. A ShapeError says that it is empty or has other axes, an InputError that it has NaN,
infinity or too large values or is out of range, a DtypeError that it has no numbers.
"""

from __future__ import annotations

import saccade._saccade as _saccade
from saccade._internal.arrays import ArrayLike, Float64Array, float64, integer

__all__ = ["PCA", "Ridge", "Standardizer", "linear_cka", "principal_angles"]


class Standardizer:
    """Subtracts the mean of each column of ``x``, and divides by its standard deviation over all rows.

    Attributes:
        mean: ``(features,)``.
        scale: ``(features,)``: the deviation, 1 for a constant column, and 1 everywhere without ``scaled``.

    Example:
        >>> import numpy as np
        >>> x = np.array([[1.0, 5.0], [3.0, 5.0]])
        >>> Standardizer(x).transform(x)
        array([[-1.,  0.],
               [ 1.,  0.]])
    """

    def __init__(self, x: ArrayLike, *, scaled: bool = True) -> None:
        self._held = _saccade.Standardizer.fit(float64("x", x), bool(scaled))
        self.mean: Float64Array = self._held.mean
        self.scale: Float64Array = self._held.scale

    def transform(self, x: ArrayLike) -> Float64Array:
        """``(x - mean) / scale``."""
        return self._held.transform(float64("x", x))


class PCA:
    """Principal components: the orthonormal directions along which the rows of ``x`` vary most.

    At most as many as ``x`` has rows or features. The entry of largest magnitude of each is positive, as in
    scikit-learn since 1.5. Components without variance are orthonormal too, and otherwise arbitrary.

    Attributes:
        mean: ``(features,)``.
        components: ``(components, features)``, by descending variance.
        explained_variance: ``(components,)``, the variance along each (divisor: rows - 1).
        total_variance: The sum of the variances of all columns.

    Example:
        >>> import numpy as np
        >>> pca = PCA(np.outer([0.0, 1.0, 2.0], [3.0, 4.0]), components=1)
        >>> pca.components.round(3), round(pca.total_variance, 3)
        (array([[0.6, 0.8]]), 25.0)
    """

    def __init__(self, x: ArrayLike, components: int) -> None:
        self._held = _saccade.PCA.fit(float64("x", x), integer("components", components))
        self.mean: Float64Array = self._held.mean
        self.components: Float64Array = self._held.components
        self.explained_variance: Float64Array = self._held.explained_variance
        self.total_variance: float = self._held.total_variance

    def transform(self, x: ArrayLike) -> Float64Array:
        """Coordinates of rows along the components, ``(rows, components)``."""
        return self._held.transform(float64("x", x))


class Ridge:
    """Ridge regression with an intercept, for several penalties at once.

    For each of ``alphas`` the weights minimise ``|y - x @ weights - intercept|^2 + alpha * |weights|^2``. One
    decomposition of ``x`` serves all, also with more features than rows. With ``alpha = 0`` the weights are
    the least-squares solution of smallest norm.

    Attributes:
        weights: ``(penalties, features, targets)``, for ``y (rows, targets)``.
        intercepts: ``(penalties, targets)``.

    Example:
        >>> ridge = Ridge([[0], [1], [2]], [[1], [3], [5]], alphas=[0, 2])
        >>> ridge.predict([[3]]).round(9).ravel()
        array([7., 5.])
    """

    def __init__(self, x: ArrayLike, y: ArrayLike, alphas: ArrayLike) -> None:
        self._held = _saccade.Ridge.fit(float64("x", x), float64("y", y), float64("alphas", alphas))
        self.weights: Float64Array = self._held.weights
        self.intercepts: Float64Array = self._held.intercepts

    def predict(self, x: ArrayLike) -> Float64Array:
        """``x @ weights + intercept`` for each penalty, ``(penalties, rows, targets)``."""
        return self._held.predict(float64("x", x))


def linear_cka(x: ArrayLike, y: ArrayLike) -> float:
    """Linear centred kernel alignment of two sets of features of the same rows, 0 to 1.

    It is 1 if they are equal up to rotation, reflection, a common factor and an offset (Kornblith et al.
    2019, "Similarity of Neural Network Representations Revisited"). An InputError says that nothing varies.

    Example:
        >>> import numpy as np
        >>> x = np.random.default_rng(0).standard_normal((20, 3))
        >>> round(linear_cka(x, 2.0 * x[:, ::-1] + 1.0), 6)
        1.0
    """
    return _saccade.linear_cka(float64("x", x), float64("y", y))


def principal_angles(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """The principal angles between the spans of the columns of two matrices, ascending, in radians.

    Small and large ones are exact to rounding (Bjorck and Golub 1973). Dependent columns count once: there
    are as many angles as the smaller rank. Arguments are ``(dimensions, vectors)``, not all zero.

    Example:
        >>> import numpy as np
        >>> np.degrees(principal_angles([[1], [0]], [[1], [1]])).round(9)
        array([45.])
    """
    return _saccade.principal_angles(float64("a", a), float64("b", b))
