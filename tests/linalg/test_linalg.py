"""saccade.linalg against NumPy and the definitions, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from saccade.errors import DtypeError, InputError, ShapeError
from saccade.linalg import PCA, Ridge, Standardizer, linear_cka, principal_angles

Floats = npt.NDArray[np.float64]

#: Rows and features: tall, wide, square, one feature, one row.
SHAPES = [(40, 7), (7, 40), (300, 150), (12, 12), (9, 1), (1, 5)]


def drawn(*shape: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("alpha", [1e-3, 1.0, 1e4])
def test_ridge_solves_the_primal_and_the_dual_equations(shape: tuple[int, int], alpha: float) -> None:
    x, y = drawn(*shape) + 3.0, drawn(shape[0], 3, seed=1) - 2.0
    ridge = Ridge(x, y, [alpha])
    centred, offset = x - x.mean(axis=0), y - y.mean(axis=0)
    gram = centred.T @ centred + alpha * np.eye(shape[1])
    kernel = centred @ centred.T + alpha * np.eye(shape[0])
    primal = np.linalg.solve(gram, centred.T @ offset)
    dual = centred.T @ np.linalg.solve(kernel, offset)
    np.testing.assert_allclose(ridge.weights[0], primal, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(ridge.weights[0], dual, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(
        ridge.intercepts[0], y.mean(axis=0) - x.mean(axis=0) @ ridge.weights[0], atol=1e-10
    )
    new = drawn(4, shape[1], seed=2)
    np.testing.assert_allclose(
        ridge.predict(new)[0], new @ ridge.weights[0] + ridge.intercepts[0], rtol=1e-12
    )


@pytest.mark.parametrize("shape", [(40, 7), (7, 40), (12, 12)])
def test_without_a_penalty_the_weights_are_the_shortest_of_least_squares(shape: tuple[int, int]) -> None:
    x, y = drawn(*shape), drawn(shape[0], 2, seed=1)
    x[:, 0] = x[:, 1:].sum(axis=1) / 7  # dependent
    expected = np.linalg.lstsq(x - x.mean(axis=0), y - y.mean(axis=0), rcond=None)[0]
    np.testing.assert_allclose(Ridge(x, y, [0.0]).weights[0], expected, rtol=1e-9, atol=1e-11)


def test_penalties_are_independent() -> None:
    x, y = drawn(30, 6), drawn(30, 2, seed=1)
    alphas = [0.0, 3.0, 0.1, 3.0]
    together = Ridge(x, y, alphas)
    assert together.weights.shape == (4, 6, 2)
    assert together.intercepts.shape == (4, 2)
    assert together.predict(x).shape == (4, 30, 2)
    for place, alpha in enumerate(alphas):
        np.testing.assert_array_equal(together.weights[place], Ridge(x, y, [alpha]).weights[0])


@pytest.mark.parametrize("shape", [(40, 7), (7, 40), (300, 150), (12, 12), (2, 5)])
def test_components_are_those_of_numpy_s_svd(shape: tuple[int, int]) -> None:
    x = drawn(*shape) * np.linspace(1, 5, shape[1]) + 1.0
    count = min(shape)
    pca = PCA(x, count)
    _, singular, right = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)
    np.testing.assert_allclose(pca.explained_variance, singular**2 / (shape[0] - 1), rtol=1e-10, atol=1e-12)
    assert pca.total_variance == pytest.approx(x.var(axis=0, ddof=1).sum(), rel=1e-12)
    kept = min(count, shape[0] - 1)  # the last one of a wide matrix has no variance
    expected = (
        right[:kept] * np.sign(right[:kept][np.arange(kept), np.abs(right[:kept]).argmax(axis=1)])[:, None]
    )
    np.testing.assert_allclose(pca.components[:kept], expected, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(pca.components @ pca.components.T, np.eye(count), atol=1e-12)
    few = PCA(x, 1)
    np.testing.assert_array_equal(few.components, pca.components[:1])
    new = drawn(3, shape[1], seed=1)
    np.testing.assert_allclose(pca.transform(new), (new - x.mean(axis=0)) @ pca.components.T, atol=1e-11)


@pytest.mark.parametrize("shape", [(40, 7, 3), (7, 40, 3), (7, 3, 40), (12, 30, 30), (100, 60, 50)])
def test_cka_is_the_alignment_of_centred_kernels(shape: tuple[int, int, int]) -> None:
    rows, own, other = shape
    x = drawn(rows, own) + 5.0
    y = x @ drawn(own, other, seed=1) + drawn(rows, other, seed=2)
    centring = np.eye(rows) - 1 / rows
    k, l = centring @ x @ x.T @ centring, centring @ y @ y.T @ centring  # noqa: E741 - as in the paper
    hsic = np.trace(k @ l)
    expected = hsic / np.sqrt(np.trace(k @ k) * np.trace(l @ l))
    assert linear_cka(x, y) == pytest.approx(expected, rel=1e-11)
    turn = np.linalg.qr(drawn(own, own, seed=3))[0]
    assert linear_cka(x, 7.0 * x @ turn - 2.0) == pytest.approx(1.0, abs=1e-12)
    assert linear_cka(x, x) == 1.0


def test_angles_are_those_between_the_subspaces() -> None:
    angles = np.array([0.0, 1e-10, 0.01, 0.5, 1.5])
    basis = np.linalg.qr(drawn(12, 10))[0]
    a, beside = basis[:, :5], basis[:, 5:]
    b = a * np.cos(angles) + beside * np.sin(angles)
    found = principal_angles(a @ drawn(5, 5, seed=1), b @ drawn(5, 8, seed=2))  # any vectors that span them
    np.testing.assert_allclose(found, angles, atol=2e-14)
    np.testing.assert_allclose(principal_angles(b, a), angles, atol=1e-14)
    assert principal_angles(a, b[:, :2]).shape == (2,)


def test_a_standardiser_leaves_constant_columns_unscaled() -> None:
    x = drawn(50, 4) * [1.0, 1e-150, 1e150, 0.0] + [3.0, 0.0, 0.0, 0.1]
    scaler = Standardizer(x)
    np.testing.assert_allclose(scaler.mean, x.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(scaler.scale[[0, 2]], x.std(axis=0)[[0, 2]], rtol=1e-12)
    assert scaler.scale[3] == 1.0
    standard = scaler.transform(x)
    np.testing.assert_allclose(standard[:, :3].std(axis=0), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(Standardizer(x, scaled=False).scale, np.ones(4))
    one = Standardizer([[2.0, -1.0]])
    np.testing.assert_array_equal(one.transform([[2.0, -1.0]]), [[0.0, 0.0]])


def test_rows_that_are_all_equal_have_no_components() -> None:
    x = np.full((5, 3), 0.1)
    pca = PCA(x, 2)
    np.testing.assert_array_equal(pca.transform(x), np.zeros((5, 2)))
    np.testing.assert_allclose(pca.components @ pca.components.T, np.eye(2), atol=1e-15)
    assert pca.total_variance == 0.0
    np.testing.assert_array_equal(Ridge(x, x, [0.0, 1.0]).weights, np.zeros((2, 3, 3)))


def test_arguments_of_other_kinds_are_converted() -> None:
    x = drawn(10, 3).astype(np.float32)
    expected = PCA(x.astype(np.float64), 2).components
    for given in (x, np.asfortranarray(x), x.tolist(), np.repeat(x, 2, axis=1)[:, ::2]):
        np.testing.assert_array_equal(PCA(given, 2).components, expected)
    assert Ridge([[0], [1]], [[1], [3]], 0).weights == pytest.approx(2.0)


#: Prints bits of everything, on as many threads as the environment says.
BITS = """
import numpy as np
from saccade.linalg import PCA, Ridge, linear_cka, principal_angles
x = np.random.default_rng(0).standard_normal((150, 400))
y = x[:, :5] ** 2
made = [PCA(x, 20).components, Ridge(x, y, [0.1, 10]).weights, linear_cka(x, y)]
made += [principal_angles(x[:, :90], y)]
print(*(np.asarray(each).tobytes().hex() for each in made))
"""


def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    def bits(threads: str) -> str:
        names = ("SACCADE_NUM_THREADS", "OMP_NUM_THREADS", "RAYON_NUM_THREADS")
        environment = {"PYTHONPATH": ":".join(sys.path), **dict.fromkeys(names, threads)}
        done = subprocess.run([sys.executable, "-c", BITS], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert bits("1") == bits("3") == bits("3")


X = np.arange(6.0).reshape(3, 2)
REFUSED: list[tuple[Callable[[], Any], type[Exception], str]] = [
    (lambda: Standardizer(np.zeros(3)), ShapeError, r"x: expected two axes, \(rows, features\), got \(3"),
    (lambda: Standardizer(np.zeros((0, 2))), ShapeError, r"x: .* at least one element, got \(0, 2\)"),
    (lambda: Standardizer([["a"]]), DtypeError, "x: expected numbers, got <U1"),
    (lambda: Standardizer([[1j]]), DtypeError, "x: expected numbers, got complex128"),
    (lambda: Standardizer([[1.0], [1.0, 2.0]]), ShapeError, "x: expected an array"),
    (
        lambda: Standardizer([[0.0, np.inf]]),
        InputError,
        r"x: expected finite values, got inf at index \(0, 1\)",
    ),
    (lambda: Standardizer([[1.7e308], [1.7e308]]), InputError, "x: the result is not finite"),
    (lambda: Standardizer(X).transform(X[:, :1]), ShapeError, r"x: expected .* \(3, 2\), got \(3, 1\)"),
    (lambda: PCA(X[:1], 1), ShapeError, "x: expected at least 2 rows, got 1"),
    (lambda: PCA(X, 3), InputError, r"components: expected 1 to 2 for x of shape \(3, 2\), got 3"),
    (lambda: PCA(X, 0), InputError, "components: expected at least 1, got 0"),
    (lambda: PCA(X, 1.0), InputError, "components: expected an integer"),  # type: ignore[arg-type]
    (lambda: Ridge(X, X[:2], [1.0]), ShapeError, r"y: expected \(rows, targets\) = \(3, 2\), got \(2, 2\)"),
    (lambda: Ridge(X, X[:, 0], [1.0]), ShapeError, r"y: expected two axes, \(rows, targets\)"),
    (lambda: Ridge(X, np.full((3, 1), np.nan), [1.0]), InputError, "y: expected finite values, got NaN"),
    (lambda: Ridge(X, X, []), InputError, "alphas: expected at least one penalty, got none"),
    (lambda: Ridge(X, X, [1.0, -0.5]), InputError, "alphas: .* at least 0, got -0.5"),
    (lambda: Ridge(X, X, [np.nan]), InputError, "alphas: .* got NaN"),
    (lambda: Ridge(X, X, [1.0]).predict(X[:, :1]), ShapeError, r"x: expected .* \(3, 2\), got \(3, 1\)"),
    (lambda: linear_cka(X[:1], X[:1]), ShapeError, "x: expected at least 2 rows, got 1"),
    (lambda: linear_cka(X, X[:2]), ShapeError, "y: expected"),
    (lambda: linear_cka(X, np.ones((3, 2))), InputError, "y: expected a feature that varies between rows"),
    (lambda: principal_angles(X, X[:2]), ShapeError, r"b: expected \(dimensions, vectors\) = \(3, 2\)"),
    (lambda: principal_angles(0.0 * X, X), InputError, "a: expected a column that is not zero"),
]


@pytest.mark.parametrize(("call", "error", "message"), REFUSED)
def test_what_is_refused_is_named(call: Callable[[], Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()
