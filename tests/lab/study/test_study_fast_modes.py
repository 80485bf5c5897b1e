"""Fast modes: their names, and what they compute, against the reference."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

import saccade
from saccade import InputError
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.reference import ActionHead as Reference
from saccade_lab.reference import random_weights
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.study.questions import fast
from saccade_lab.study.questions.fast_engine import ModeHead
from saccade_lab.study.questions.fast_modes import (
    INTEGRATORS,
    Calibration,
    Mode,
    best_times,
    cross_mass,
    even_times,
    integrate,
    many_steps,
    sample,
)
from tests.helpers.reference_cases import small_config

Float64Array = npt.NDArray[np.float64]
PLAIN = Calibration()


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random head in the released layout."""
    folder = tmp_path_factory.mktemp("checkpoint")
    random_weights.write_checkpoint(folder, small_config(), seed=1)
    return folder


def observation(head: saccade.ActionHead, seed: int = 0) -> HeadInputs:
    """A single one with six vision-language tokens."""
    inputs = random_weights.random_inputs(head.config, seed, batch=1, num_vl_tokens=6)
    names = ("backbone_features", "state", "embodiment_id", "noise")
    return HeadInputs(*(inputs[name].numpy() for name in names))


@pytest.mark.parametrize("name", [*fast.SCREENED, *fast.JUDGED, "bfloat16-euler-8-refresh-3-drop-10"])
def test_a_mode_has_the_name_that_it_was_read_from(name: str) -> None:
    assert Mode.parse(name).name == name


@pytest.mark.parametrize(
    "name",
    [
        "",
        "euler-4",
        "float16-euler-4",
        "float32-rk4-4",
        "float32-euler",
        "float32-euler-0",
        "float32-euler-1001",
        "float32-euler--4",
        "float32-euler-4.0",
        "float32-euler-four",
        "float32-euler-4-refresh",
        "float32-euler-4-refresh-0",
        "float32-heun-4-refresh-2",
        "float32-times-4-refresh-2",
        "float32-euler-4-drop-100",
        "float32-euler-4-drop-1-drop-2",
        "float32-euler-4-skip-2",
        "float32-adams-1",
        "float32-times-1",
        "float32-euler-٤",
    ],
)
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="mode: given"):
        Mode.parse(name)


def test_modes_ask_as_often_as_they_say() -> None:
    for integrator in set(INTEGRATORS) - {"midpoint"}:  # which the head does itself
        calls: list[float] = []

        def velocity(x: npt.NDArray[np.float32], time: float, calls: list[float] = calls) -> Any:
            calls.append(time)
            return np.zeros_like(x)

        integrate(velocity, np.zeros((1, 2, 3), np.float32), integrator, even_times(3))
        assert len(calls) == Mode("float32", integrator, 3).evaluations
        assert calls[0] == 0
        assert max(calls) <= 1


def test_integrators_have_the_order_that_their_names_promise() -> None:
    """dx/dt = 2 t x has the solution x(0) exp(t^2)."""
    start = np.array([[[0.5, -2.0, 7.0]]], np.float32)
    exact = start[..., :2].astype(np.float64) * math.e

    def velocity(x: npt.NDArray[np.float32], time: float) -> Float64Array:
        return x[..., :2].astype(np.float64) * 2.0 * time  # the third has no velocity

    def error(integrator: str, steps: int) -> float:
        found = integrate(velocity, start, integrator, even_times(steps))
        assert found[0, 0, 2] == 7.0
        return float(np.abs(found[..., :2] - exact).max())

    for integrator, order in (("euler", 1), ("heun", 2), ("adams", 2)):
        measured = math.log2(error(integrator, 16) / error(integrator, 32))
        assert measured == pytest.approx(order, abs=0.3), integrator
        assert start[0, 0, 0] == 0.5  # what was given stays


def test_uneven_times_are_followed() -> None:
    """v = 2t from times 0, a: the sum of length times slope is (1 - a) * 2a."""
    found = integrate(
        lambda x, time: np.full_like(x, 2 * time), np.zeros((1, 1, 1), np.float32), "times", (0.0, 0.7, 1.0)
    )
    assert found[0, 0, 0] == pytest.approx(0.3 * 1.4, abs=1e-6)


def test_times_are_moved_to_where_the_error_is_least() -> None:
    for aim in ((0.62,), (0.2, 0.9), (0.05, 0.1, 0.15)):

        def error(times: tuple[float, ...], aim: tuple[float, ...] = aim) -> float:
            return sum(abs(one - other) for one, other in zip(times[1:-1], aim, strict=True))

        found = best_times(error, len(aim) + 1)
        assert found == pytest.approx((0.0, *aim, 1.0), abs=0.0101)
        assert list(found) == sorted(set(found))


def test_euler_by_hand_is_what_the_head_does(checkpoint: Path) -> None:
    head = saccade.ActionHead.from_pretrained(checkpoint)
    one = observation(head)
    context = one.encode(head)
    for steps in (1, 3, 7):
        whole = sample(head, Mode("float32", "euler", steps), PLAIN, context, one)
        grid = Calibration(times=(even_times(steps),))
        by_hand = sample(head, Mode("float32", "times", steps), grid, context, one)
        np.testing.assert_allclose(by_hand, whole, rtol=0, atol=3e-6)


@pytest.mark.parametrize("integrator", ["heun", "midpoint", "adams"])
def test_integrators_against_the_reference_in_float64(checkpoint: Path, integrator: str) -> None:
    head, reference = (
        saccade.ActionHead.from_pretrained(checkpoint),
        Reference.from_pretrained(checkpoint, dtype=torch.float64),
    )
    one = observation(head)
    found = sample(head, Mode("float32", integrator, 2), PLAIN, one.encode(head), one)
    with torch.no_grad():
        vl_embs = reference.encode(one.backbone_features)

        def velocity(x: Float64Array, bucket: int) -> Float64Array:
            tensor: Float64Array = reference.velocity(
                vl_embs, one.state, int(one.embodiment_id[0]), torch.from_numpy(x), bucket
            ).numpy()
            return tensor

        assert one.noise is not None
        x = one.noise.astype(np.float64)
        first = velocity(x, 0)
        if integrator == "heun":
            x = x + 0.25 * (first + velocity(x + 0.5 * first, 500))
            second = velocity(x, 500)
            x = x + 0.25 * (second + velocity(x + 0.5 * second, 999))
        elif integrator == "midpoint":
            x = x + 0.5 * velocity(x + 0.25 * first, 250)
            x = x + 0.5 * velocity(x + 0.25 * velocity(x, 500), 750)
        else:
            x = x + 0.5 * first
            x = x + 0.5 * (1.5 * velocity(x, 500) - 0.5 * first)
    np.testing.assert_allclose(found, x, rtol=0, atol=2e-5)


@pytest.mark.parametrize("precision", ["bfloat16", "int8", "int4"])
def test_a_mode_loads_its_precision(checkpoint: Path, precision: str) -> None:
    exact, lower = (
        saccade.ActionHead.from_pretrained(checkpoint, precision=one) for one in ("float32", precision)
    )
    one = observation(exact)
    features, state, noise = one.backbone_features, one.state, one.noise
    assert noise is not None
    engine = ModeHead(str(checkpoint), Mode.parse(f"{precision}-euler-4"), PLAIN)
    found = engine.sample(engine.encode(features), state, 0, noise=noise)
    np.testing.assert_array_equal(
        found, lower.sample(lower.encode(features), state, 0, noise=noise, num_steps=4)
    )
    change = np.abs(
        found - np.asarray(exact.sample(exact.encode(features), state, 0, noise=noise, num_steps=4))
    )
    assert 0 < change.max() < 0.2


@pytest.mark.parametrize("refresh", [2, 3])
def test_refresh_against_the_reference_in_float64(checkpoint: Path, refresh: int) -> None:
    head, reference = (
        saccade.ActionHead.from_pretrained(checkpoint),
        Reference.from_pretrained(checkpoint, dtype=torch.float64),
    )
    one = observation(head)
    assert one.noise is not None
    mode = Mode.parse(f"float32-euler-4-refresh-{refresh}")
    found = sample(head, mode, PLAIN, one.encode(head), one)
    with torch.no_grad():
        vl_embs, embodiment = reference.encode(one.backbone_features), int(one.embodiment_id[0])
        expected, exact = (
            reference.sample(
                vl_embs, one.state, embodiment, noise=one.noise, num_steps=4, future_refresh=every
            ).numpy()
            for every in (refresh, None)
        )
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)
    assert np.abs(found - exact).max() > 1e-3


def test_many_steps_come_closer_than_any_mode() -> None:
    """On the shipped policy: a random head's velocity jumps between buckets of time."""
    head = saccade.ActionHead.from_pretrained(DEMO_CHECKPOINT)
    one = replace(
        HeadInputs.random(head.config, 57, np.random.default_rng(0)), state=np.zeros((1, 4), np.float32)
    )
    context = one.encode(head)
    limit = one.sample(head, context, num_steps=1000)

    def error(found: Any) -> float:
        return float(np.abs(found - limit).mean())

    by_mode = [
        error(sample(head, Mode("float32", integrator, 4), PLAIN, context, one))
        for integrator in ("euler", "midpoint", "adams")
    ]
    assert error(many_steps(head, context, one)) < 0.35 * min(by_mode)


def test_tokens_with_the_least_attention_go_and_removed_ones_do_not_count() -> None:
    calibration = Calibration(mass=(0.3, 0.0, 0.1, 0.2, 0.4))
    nothing = np.zeros((1, 5), np.bool_)
    assert np.flatnonzero(calibration.least(40, nothing)[0]).tolist() == [1, 2]
    assert np.flatnonzero(calibration.least(19, nothing)[0]).tolist() == []
    removed = np.array([[False, True, False, False, False]])
    assert np.flatnonzero(calibration.least(50, removed)[0]).tolist() == [1, 2, 3]
    assert removed.sum() == 1
    # A longer instruction than any of the calibration, and a shorter one.
    assert np.flatnonzero(calibration.least(85, np.zeros((1, 7), np.bool_))[0]).tolist() == [0, 1, 2, 3, 4]
    assert np.flatnonzero(calibration.least(50, np.zeros((1, 2), np.bool_))[0]).tolist() == [1]


def test_a_dropping_mode_encodes_without_those_tokens(checkpoint: Path) -> None:
    head = saccade.ActionHead.from_pretrained(checkpoint)
    one = observation(head)
    features, state, noise = one.backbone_features, one.state, one.noise
    assert noise is not None
    mass = cross_mass(head, one.encode(head), one)
    assert mass.shape == (6,)
    assert mass.sum() == pytest.approx(1.0, abs=1e-5)
    engine = ModeHead(
        str(checkpoint), Mode.parse("float32-euler-4-drop-50"), Calibration(mass=tuple(mass.tolist()))
    )
    kept = np.sort(np.argsort(mass)[3:])
    fewer = engine.encode(features)
    np.testing.assert_allclose(
        engine.sample(fewer, state, 0, noise=noise),
        head.sample(head.encode(features[:, kept]), state, 0, noise=noise, num_steps=4),
        atol=1e-5,
    )
    with pytest.raises(InputError, match="intervention: given one"):
        engine.sample(fewer, state, 0, noise=noise, intervention=saccade.Intervention())
