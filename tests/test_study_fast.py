"""The study of fast modes: what a mode computes, when a task counts, what is said, and features of a file."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
import torch
from reference_cases import small_config

import saccade
from saccade import InputError
from saccade.bench import heads
from saccade.cli import main
from saccade.observation import Observation
from saccade.reference import ActionHead as Reference
from saccade.reference import random_weights
from saccade.sim import graphics
from saccade.sim.policy import DEMO_CHECKPOINT, Policy
from saccade.sim.rollout import environment_for, run_episode
from saccade.study.questions import fast, fast_results, fast_times
from saccade.study.questions.fast_engine import ModeHead
from saccade.study.questions.fast_modes import (
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
from saccade.study.questions.fast_results import BASELINE, ONE_STEP
from saccade.study.questions.fast_section import section
from saccade.study.section import Section
from saccade.study.statistics import holm, p_of_loss, paired_difference, tango, verdict
from saccade.study.table import Provenance, read_provenance, read_table

Float64Array = npt.NDArray[np.float64]
PLAIN = Calibration()


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random head in the released layout."""
    folder = tmp_path_factory.mktemp("checkpoint")
    random_weights.write_checkpoint(folder, small_config(), seed=1)
    return folder


def observation(head: saccade.ActionHead, seed: int = 0) -> Observation:
    """A single one with six vision-language tokens."""
    inputs = random_weights.random_inputs(head.config, seed, batch=1, num_vl_tokens=6)
    names = ("backbone_features", "state", "embodiment_id", "noise")
    return Observation(*(inputs[name].numpy() for name in names))


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
    head = saccade.ActionHead.load(checkpoint)
    one = observation(head)
    context = one.encode(head)
    for steps in (1, 3, 7):
        whole = sample(head, Mode("float32", "euler", steps), PLAIN, context, one)
        grid = Calibration(times=(even_times(steps),))
        by_hand = sample(head, Mode("float32", "times", steps), grid, context, one)
        np.testing.assert_allclose(by_hand, whole, rtol=0, atol=3e-6)


@pytest.mark.parametrize("integrator", ["heun", "midpoint", "adams"])
def test_integrators_against_the_reference_in_float64(checkpoint: Path, integrator: str) -> None:
    head, reference = saccade.ActionHead.load(checkpoint), Reference.load(checkpoint, dtype=torch.float64)
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


@pytest.mark.parametrize("precision", ["bfloat16", "int8"])
def test_a_mode_loads_its_precision(checkpoint: Path, precision: str) -> None:
    exact, lower = (saccade.ActionHead.load(checkpoint, precision=one) for one in ("float32", precision))
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
    head, reference = saccade.ActionHead.load(checkpoint), Reference.load(checkpoint, dtype=torch.float64)
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
    head = saccade.ActionHead.load(DEMO_CHECKPOINT)
    one = replace(
        Observation.random(head.config, 57, np.random.default_rng(0)), state=np.zeros((1, 4), np.float32)
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
    head = saccade.ActionHead.load(checkpoint)
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


def outcomes(
    rate_by_mode: Mapping[str, Callable[[int], bool]], task: str = "fork", count: int = 300
) -> pd.DataFrame:
    """A table of episodes, each mode by a rule of the seed."""
    return pd.DataFrame(
        [
            {"part": "episodes", "task": task, "seed": seed, "mode": mode, "success": rule(seed), "steps": 30}
            for mode, rule in rate_by_mode.items()
            for seed in range(count)
        ]
    )


def section_of(table: pd.DataFrame) -> Section:
    """The report's section on a table of the simulator."""
    checkpoint = {"name": "policy", "sha256": "ab" * 32, "num_future_tokens": 8, "num_layers": 4}
    return section(table, Provenance("fast", {"checkpoint": checkpoint}, done=1, total=1))


def test_a_task_counts_only_if_one_step_measurably_fails() -> None:
    table = pd.concat(
        [
            outcomes({BASELINE: lambda seed: seed % 10 > 0, ONE_STEP: lambda seed: seed % 10 > 4}),
            outcomes({BASELINE: lambda seed: True, ONE_STEP: lambda seed: seed % 50 > 0}, task="reach"),
            # 8 points are lost, but 30 episodes cannot show that it is more than 5.
            outcomes(
                {BASELINE: lambda seed: True, ONE_STEP: lambda seed: seed % 12 > 0}, task="push", count=30
            ),
            outcomes({BASELINE: lambda seed: True}, task="two-goals"),
        ]
    )
    found = {task: fast_results.counts(one) for task, one in fast_results.separations(table).items()}
    assert found == {"fork": True, "reach": False, "push": False}
    lines = section_of(table).concluded
    assert lines[0].startswith("fork counts: one Euler step against four: 50 against 90 %, -40.0 (")
    assert all("judges no mode" in line for line in lines[1:])
    assert len(lines) == 3


def test_no_mode_is_judged_where_no_task_counts() -> None:
    table = outcomes(
        {BASELINE: lambda seed: True, ONE_STEP: lambda seed: True, "int8-euler-4": lambda seed: False}
    )
    assert all(one.verdict is None for one in fast_results.results_of(table).values())
    lines = section_of(table).concluded
    assert lines[1:] == [
        "No mode is judged: no task was shown to distinguish one step from four (float32-euler-1)."
    ]


def timed(mode: str, milliseconds: float) -> dict[str, Any]:
    return {
        "part": "time", "task": "n1.5", "seed": 0, "mode": mode, "encode_ms": 1.0,
        "sample_ms": milliseconds - 1.0, "chunk_ms": milliseconds, "chunk_ms_low": milliseconds,
        "chunk_ms_high": milliseconds, "rounds": 5, "num_threads": 2, "isa": "avx2", "num_vl_tokens": 296,
    }  # fmt: skip


def test_verdicts_and_the_recommendation() -> None:
    rules: dict[str, Callable[[int], bool]] = {
        BASELINE: lambda seed: seed % 10 > 0,
        ONE_STEP: lambda seed: seed % 10 > 5,
        "int8-euler-4": lambda seed: seed % 10 > 0,  # the same episodes
        "bfloat16-euler-4": lambda seed: seed % 10 > 0 and seed != 11,  # as good, but slower than int8
        "float32-euler-2": lambda seed: seed % 10 > 1,  # 10 points less
        # 7 won and 18 lost: worse by its own interval, but not after Holm's correction.
        "int8-euler-2": lambda seed: (seed % 10 > 0 or seed < 70) and not 101 <= seed < 120,
    }
    spent = {
        BASELINE: 100.0,
        ONE_STEP: 40.0,
        "int8-euler-4": 20.0,
        "int8-euler-2": 10.0,
        "bfloat16-euler-4": 50.0,
        "float32-euler-2": 60.0,
    }
    table = pd.concat([outcomes(rules), pd.DataFrame([timed(*item) for item in spent.items()])])
    results = fast_results.results_of(table)
    assert list(results) == [
        ONE_STEP, "float32-euler-2", BASELINE, "bfloat16-euler-4", "int8-euler-2", "int8-euler-4"
    ]  # fmt: skip
    pairs = results["int8-euler-2"].pairs
    assert pairs is not None
    assert (pairs.only_first, pairs.only_second) == (7, 18)
    assert {name: (one.verdict, one.significant) for name, one in results.items()} == {
        BASELINE: (None, False),
        ONE_STEP: (None, False),
        "int8-euler-4": ("no worse", True),
        "bfloat16-euler-4": ("no worse", True),
        "float32-euler-2": ("worse", True),
        "int8-euler-2": ("worse", False),
    }
    assert fast_results.recommended(results) == ["int8-euler-4", "bfloat16-euler-4", BASELINE]
    # Holm: four modes are judged, and the control that decides which tasks count is not one of them.
    p_values = [one.pairs.p_value for name, one in results.items() if one.pairs and name != ONE_STEP]
    assert [one.p_value for one in results.values() if one.p_value is not None] == holm(p_values)
    found = section_of(table)
    assert any(
        line.startswith("int8-euler-4: success: no worse, 0.0 points (")
        and "0.20 of the baseline's time" in line
        for line in found.concluded
    )
    assert any(line.startswith("float32-euler-2: success: worse, -10.0 points (") for line in found.concluded)
    assert "Not significant after Holm's correction for 4 modes: int8-euler-2 (worse)." in found.concluded
    assert found.concluded[-1] == (
        "The fastest mode of each precision that is no worse, also after Holm's correction: "
        f"int8-euler-4, bfloat16-euler-4, {BASELINE}."
    )
    # What is said of a mode and what the table of the report says agree with the interval.
    grid = found.grids[0]
    for row in grid.rows:
        cells = dict(zip(grid.columns, row, strict=True))
        difference = results[cells["mode"]].pairs
        if cells["verdict"]:
            assert difference is not None
            assert cells["verdict"] == verdict(difference.difference)


def test_no_loss_is_the_interval_that_excludes_it() -> None:
    for pairs in (20, 100, 400):
        for only_first in (0, 1, 5, 12):
            for only_second in (0, 2, 7, 8):
                first = (
                    [True] * only_first + [False] * only_second + [True] * (pairs - only_first - only_second)
                )
                second = [False] * only_first + [True] * (pairs - only_first)
                one = paired_difference(first, second)
                assert (one.only_first, one.only_second) == (only_first, only_second)
                assert (p_of_loss(one, 0.05) < 0.025) == (tango(only_first, only_second, pairs).low > -0.05)


def test_one_episode_in_every_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sized = heads.sized
    monkeypatch.setattr(heads, "sized", lambda size: sized("small"))
    monkeypatch.setattr(fast_times, "FULL_TOKENS", 7)
    monkeypatch.setattr(fast_times, "MOST_ROUNDS", 3)
    monkeypatch.setattr(fast, "CALIBRATION_EPISODES", 1)
    modes = f"{ONE_STEP},float32-times-2,float32-euler-4-drop-50"
    arguments = ["--tasks", "reach", "--episodes", "1", "--modes", modes, "--out", str(tmp_path)]
    assert main(["study", "fast", *arguments]) == 0
    assert "No mode is judged" in capsys.readouterr().out
    table = read_table(tmp_path / "fast.csv")
    names = {*modes.split(","), BASELINE}
    for part, task in (("chunks", "reach"), ("episodes", "reach"), ("time", "own"), ("time", "n1.5")):
        assert set(table[(table["part"] == part) & (table["task"] == task)]["mode"]) == names
    chunks: Any = table[table["part"] == "chunks"].set_index("mode")
    assert chunks.loc[BASELINE, "chunk_change"] == 0.0
    assert chunks.loc[ONE_STEP, "chunk_change"] > 0.0
    assert chunks.loc[BASELINE, "chunk_error"] < chunks.loc[ONE_STEP, "chunk_error"]
    assert chunks.loc["float32-times-2", "chunk_error"] < chunks.loc[ONE_STEP, "chunk_error"]
    assert (chunks["noise_change"] > 0).all()

    # The baseline is what `saccade rollout` does.
    policy = Policy.load(num_threads=1)
    environment = environment_for(policy, "reach")
    episode = run_episode(environment, policy, 0)
    environment.close()
    row: Any = table[table["part"] == "episodes"].set_index("mode").loc[BASELINE]
    assert (row["success"], row["steps"], row["chunks"]) == (episode.success, episode.steps, episode.chunks)
    assert len(table[(table["part"] == "calibrate") & (table["task"] == "mass")]) <= policy.num_vl_tokens()

    provenance = read_provenance(tmp_path / "fast.json")
    assert provenance.complete
    assert str(DEMO_CHECKPOINT) not in (tmp_path / "fast.json").read_text()  # tables are committed
    done = {path: path.stat().st_mtime_ns for path in (tmp_path / "fast" / "cells").iterdir()}
    more = [*arguments, "--parts", "chunks,episodes"]
    more[more.index(modes)] = f"{modes},float32-euler-2"
    assert main(["study", "fast", *more]) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in done.items())
    assert len(list((tmp_path / "fast" / "cells").iterdir())) == len(done) + 2

    assert main(["study", "report", str(tmp_path)]) == 0
    report = (tmp_path / "report.md").read_text()
    assert report.startswith("# What do faster modes cost, and what do they save?")
    assert "n-runtime" not in report
    assert (tmp_path / "figures" / "fast-errors.png").exists()


def features_file(folder: Path, **changes: Any) -> Path:
    config = saccade.HeadConfig.from_dict(small_config())
    inputs = random_weights.random_inputs(config, 2, batch=5, num_vl_tokens=6)
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in inputs.items() if name != "noise"}
    arrays |= {"embodiment_id": np.array([0, 2, 2, 2, 0]), "episode": np.array([7, 7, 3, 3, 7])} | changes
    np.savez(folder / "looks.npz", **{name: array for name, array in arrays.items() if array is not None})
    return folder / "looks.npz"


def on_features(checkpoint: Path, file: Path, out: Path, *more: str) -> int:
    return main(
        ["study", "fast", "--checkpoint", str(checkpoint), "--features", str(file), "--out", str(out), *more]
    )


def test_features_of_a_file_against_the_reference(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fast_times, "MOST_ROUNDS", 3)
    file = features_file(tmp_path)
    modes = "float32-euler-2,float32-times-2,float32-euler-4-drop-50"
    assert on_features(checkpoint, file, tmp_path / "out", "--modes", modes, "--seed", "4") == 0
    printed = capsys.readouterr().out
    assert "float32-euler-2: actions change by" in printed
    assert "times as much as with another noise" in printed
    assert "of the baseline's time (this checkpoint)" in printed
    assert "Success: not measured, a file of features has no closed loop." in printed

    table = read_table(tmp_path / "out" / "fast.csv")
    chunks: Any = table[table["part"] == "chunks"].set_index(["mode", "seed"])
    # Rows 2 and 3 are episode 3, the first in order, and calibrate; the rest measures calibrated modes.
    assert sorted(chunks.loc["float32-euler-2"].index) == [0, 1, 2, 3, 4]
    assert sorted(chunks.loc["float32-times-2"].index) == [0, 1, 4]
    assert set(table[table["part"] == "time"]["mode"]) == {BASELINE, *modes.split(",")}
    assert set(table[table["part"] == "time"]["task"]) == {"own"}

    arrays, reference = np.load(file), Reference.load(checkpoint, dtype=torch.float64)
    for row in range(5):
        noise = np.random.default_rng([4, row]).standard_normal((1, 4, 5, 3), dtype=np.float32)

        def chunk(steps: int, draw: int, row: int = row, noise: Any = noise) -> Any:
            with torch.no_grad():
                vl_embs = reference.encode(arrays["backbone_features"][row : row + 1])
                embodiment, start = int(arrays["embodiment_id"][row]), noise[:, draw]
                state = arrays["state"][row : row + 1]
                return reference.sample(vl_embs, state, embodiment, noise=start, num_steps=steps).numpy()

        found: Any = chunks.loc[("float32-euler-2", row)]
        assert found["chunk_change"] == pytest.approx(np.abs(chunk(2, 0) - chunk(4, 0)).mean(), rel=1e-3)
        assert found["noise_change"] == pytest.approx(np.abs(chunk(4, 1) - chunk(4, 0)).mean(), rel=1e-3)
    assert "episode 3" not in printed
    assert json.loads((tmp_path / "out" / "fast.json").read_text())["settings"]["features"]["episodes"] == 2
    assert main(["study", "report", str(tmp_path / "out")]) == 0
    assert "on recorded observations" in (tmp_path / "out" / "report.md").read_text()


def test_one_episode_calibrates_nothing_and_removed_positions_stay_so(
    checkpoint: Path, tmp_path: Path
) -> None:
    dropped = np.zeros((5, 6), bool)
    dropped[:, :2] = True
    file = features_file(tmp_path, episode=np.zeros(5, np.int64), drop_vl=dropped)
    arguments = ("--parts", "chunks", "--modes", "float32-euler-2,float32-times-2")
    assert on_features(checkpoint, file, tmp_path / "out", *arguments) == 0
    table = read_table(tmp_path / "out" / "fast.csv")
    assert set(table["mode"]) == {BASELINE, "float32-euler-2"}
    shorter = np.load(file)["backbone_features"][:, 2:]
    file = features_file(tmp_path, episode=np.zeros(5, np.int64), backbone_features=shorter)
    assert on_features(checkpoint, file, tmp_path / "shorter", *arguments) == 0
    columns = ["chunk_change", "chunk_error"]
    np.testing.assert_allclose(
        table[columns], read_table(tmp_path / "shorter" / "fast.csv")[columns], atol=1e-5
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--modes", "float32-rk4-2"), "mode: given 'float32-rk4-2'"),
        (("--parts", "episodes"), "not with --features"),
        (("--parts", "loops"), "parts: unknown name 'loops', expected one of chunks, episodes, time"),
        (("--tasks", "reach"), "--tasks: not with --features"),
        (("--seed", "-1"), "--seed: given -1"),
    ],
)
def test_bad_input_is_one_line(
    checkpoint: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    assert on_features(checkpoint, features_file(tmp_path), tmp_path / "out", *arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1
    assert not (tmp_path / "out" / "fast.csv").exists()


def test_a_missing_file_is_named(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert on_features(checkpoint, tmp_path / "none.npz", tmp_path / "out") == 2
    assert "none.npz" in capsys.readouterr().err
    file = features_file(tmp_path, backbone_features=np.zeros((5, 6, 3), np.float32))
    assert on_features(checkpoint, file, tmp_path / "out") == 2
    assert "backbone_features" in capsys.readouterr().err
