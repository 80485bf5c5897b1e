"""Calibrated rounding against GPTQ's formula in NumPy, and the watch over inputs against torch's hooks."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from torch import nn

import saccade
from saccade import _saccade
from saccade.errors import InputError, ShapeError
from saccade_lab.reference.random_weights import random_inputs
from tests.helpers.engine_cases import arrays, both
from tests.helpers.reference_cases import small_config

Floats = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]


def drawn(rows: int, width: int, seed: int) -> Float32:
    """Rows whose inputs depend on each other, one of them always zero."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((rows, width // 3 + 1)) @ rng.standard_normal((width // 3 + 1, width))
    x += 0.5 * rng.standard_normal((rows, width))
    x[:, width // 2] = 0
    return (x * rng.uniform(0.2, 3.0, width)).astype(np.float32)


def nearest(values: Floats, scales: Floats) -> Floats:
    return np.clip(np.rint(values / scales), -7, 7)


def gptq(weight: Floats, scales: Floats, gram: Floats) -> Floats:
    """Algorithm 1 of Frantar et al. 2023 with the order of its `act_order`, in float64."""
    gram = gram.copy()
    dead = np.diag(gram) == 0
    gram[np.diag_indices_from(gram)] *= 1.01
    gram[dead, dead] = 1
    order = np.argsort(-np.where(dead, 0, np.diag(gram)), kind="stable")
    upper = np.linalg.cholesky(np.linalg.inv(gram[np.ix_(order, order)])).T
    left, values = weight[:, order].copy(), np.zeros_like(weight)
    for place, column in enumerate(order):
        values[:, column] = nearest(left[:, place], scales)
        error = (left[:, place] - values[:, column] * scales) / upper[place, place]
        left[:, place:] -= np.outer(error, upper[place, place:])
    return values


@pytest.mark.parametrize(("rows", "width"), [(500, 40), (90, 300), (20, 64), (1, 1)])
def test_values_are_those_of_numpy(rows: int, width: int) -> None:
    x = drawn(rows, width, seed=rows)
    weight = np.random.default_rng(1).standard_normal((50, width)).astype(np.float32)
    scales = (0.8 * np.abs(weight).max(axis=1) / 7).astype(np.float32)
    gram = _saccade.Gram(width)
    for part in np.array_split(x, 3):
        gram.add(np.ascontiguousarray(part), 2)
    values, errors = _saccade.gptq(weight, scales, gram, 2)

    exact, steps = weight.astype(np.float64), scales.astype(np.float64)
    found = gram.matrix().astype(np.float64)
    wide = x.astype(np.float64)
    np.testing.assert_allclose(found, wide.T @ wide, atol=1e-5 * rows * float(np.abs(x).max()) ** 2)
    expected = gptq(exact, steps, found)
    damped = found + 0.01 * np.diag(np.diag(found))

    def error(values: Floats) -> Floats:
        difference = exact - values * steps[:, None]
        of_rows: Floats = np.einsum("oi,ij,oj->o", difference, damped, difference)
        return of_rows

    plain = nearest(exact, steps[:, None])
    better = error(expected) < error(plain)
    assert width == 1 or better.mean() > 0.9
    # A tie in one step of hundreds of thousands may go the other way, and changes what comes after it.
    same = (values == np.where(better[:, None], expected, plain)).all(axis=1)
    assert same.mean() > 0.95
    kept = error(values.astype(np.float64))
    assert (kept <= error(plain) * (1 + 1e-9)).all()
    dead = np.flatnonzero((x == 0).all(axis=0))
    np.testing.assert_array_equal(values[:, dead], plain[:, dead])
    outputs = np.einsum("oi,ij,oj->", exact, damped, exact)
    for name, sums in (("rounded", kept), ("plain", error(plain)), ("outputs", outputs)):
        assert errors[name] == pytest.approx(float(np.sum(sums)), rel=1e-6)


def test_the_watch_sees_what_torch_sees() -> None:
    config = small_config(num_heads=2, head_dim=33, context_dim=62, hidden_dim=51, num_layers=3)
    head, reference = both(config, 1)
    reference = reference.float()
    inputs = random_inputs(saccade.HeadConfig.from_dict(config), 2, batch=2, num_vl_tokens=9)
    seen: dict[str, list[Float32]] = {}

    def keep(name: str, module: nn.Module) -> None:
        def hook(_: nn.Module, given: tuple[torch.Tensor, ...]) -> None:
            rows = given[0].detach().numpy()
            seen.setdefault(name, []).append(rows.reshape(-1, rows.shape[-1]))

        module.register_forward_pre_hook(hook)

    for name, module in reference.named_modules():
        if isinstance(module, nn.Linear):
            keep(f"{name}.weight", module)
    with torch.no_grad():
        reference(**inputs)

    def run(wanted: list[str]) -> list[tuple[list[str], int, Any]]:
        with _saccade.watch_linears(wanted) as watch:
            head(**arrays(inputs))
        return watch.layers()

    layers = run([])
    assert all(gram is None for *_, gram in layers)
    blocks = [names[0] for names, *_ in layers if "transformer_blocks" in names[0] and "norm" not in names[0]]
    assert len(blocks) == len(set(blocks)) > 10
    compared = 0
    for names, in_features, gram in run(blocks):
        if names[0] not in blocks:
            assert gram is None
            continue
        x = np.concatenate(seen[names[0]]).astype(np.float64)
        assert (gram.width, x.shape[1]) == (in_features, in_features)
        for other in names[1:]:
            np.testing.assert_array_equal(np.concatenate(seen[other]), np.concatenate(seen[names[0]]))
        if gram.num_rows != len(x):
            continue  # rows that are computed once for all steps, or for some positions only
        expected, compared = x.T @ x, compared + 1
        np.testing.assert_allclose(gram.matrix(), expected, atol=2e-4 * np.abs(expected).max())
    assert compared > len(blocks) / 2


def test_one_watch_at_a_time_and_none_is_left_behind() -> None:
    with _saccade.watch_linears([]), pytest.raises(InputError, match="watch: expected one for each thread"):
        _saccade.watch_linears([]).__enter__()
    with pytest.raises(ZeroDivisionError), _saccade.watch_linears([]):
        _ = 1 / 0
    with _saccade.watch_linears([]) as watch:
        pass
    assert watch.layers() == []


def test_what_is_wrong_is_named() -> None:
    gram = _saccade.Gram(2)
    with pytest.raises(ShapeError, match=r"x: expected \(rows, width\) = \(1, 2\), got \(1, 3\)"):
        gram.add(np.zeros((1, 3), np.float32), 1)
    with pytest.raises(InputError, match=r"x: expected finite values, got NaN at index \(0, 1\)"):
        gram.add(np.array([[0, np.nan]], np.float32), 1)
    with pytest.raises(ShapeError, match="scales: expected one for each of 3 rows, got 1"):
        _saccade.gptq(np.zeros((3, 2), np.float32), np.ones(1, np.float32), gram, 1)
    with pytest.raises(InputError, match="width: expected at least 1, got 0"):
        _saccade.Gram(0)
