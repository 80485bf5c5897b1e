"""Weights rounded to four bits for observations: whole checkpoints, interrupted runs, bad input."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

import saccade
from saccade import InputError, Policy, cli
from saccade.checkpoints import Calibration, QuantizeReport, calibration, inspect, quantize
from saccade.errors import SaccadeError
from saccade.observations import ParsedObservation
from tests.helpers import whole_checkpoints
from tests.helpers.recorded_cases import by_the_policy, demo_policy
from tests.helpers.recorded_folder import written
from tests.helpers.whole_checkpoints import EMBODIMENT, whole

DEMO = saccade.demo_checkpoint()
IMAGES = ("--to", "int4", "--instruction", "push", "--calibrate")


def examples(policy: Policy, count: int) -> list[dict[str, Any]]:
    return [policy.example_observation(seed=seed) for seed in range(count)]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def features_error(exact: Policy, given: Policy, observations: Sequence[Mapping[str, Any]]) -> float:
    """Of the backbone's features, relative to them."""
    squares = np.zeros(2)
    for observation in observations:
        expected, found = (
            np.asarray(policy.encode(observation).features[0].backbone_features, np.float64)
            for policy in (exact, given)
        )
        squares += np.sum((found - expected) ** 2), np.sum(expected**2)
    return float(np.sqrt(squares[0] / squares[1]))


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_all_weights_are_rounded_for_the_observations(layout: str, tmp_path: Path) -> None:
    source, out, plain = whole(layout), tmp_path / "calibrated", tmp_path / "plain"
    policy = Policy.from_pretrained(source, embodiment=EMBODIMENT, num_threads=1)
    observations = examples(policy, 4)
    done: list[tuple[int, int]] = []
    given = Calibration(policy, observations, progress=lambda *steps: done.append(steps))
    report = quantize(source, out, to="int4", calibration=given)
    assert report.num_calibrated == report.num_quantized - 1  # all but the token embeddings
    assert report.num_quantized > report.num_quantized_backbone > 0
    assert report.rounding is not None
    assert all(one["rounded"] <= one["plain"] for one in report.rounding.values())
    before, after = (sum(one[kind] for one in report.rounding.values()) for kind in ("plain", "rounded"))
    assert after < 0.8 * before
    assert done == [(step, done[-1][1]) for step in range(len(done))]
    assert done[-1][0] == done[-1][1] == 2 * len(observations) + len(report.rounding)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibrated"]
    assert inspect(out).rounding == "for what the layers are given on 4 observations (GPTQ)"

    assert quantize(source, plain, to="int4").rounding is None
    assert inspect(plain).rounding == "each weight to the nearest, without calibration"
    assert inspect(source).rounding is None
    loaded = (
        Policy.from_pretrained(folder, embodiment=EMBODIMENT, precision="int4", num_threads=1)
        for folder in (out, plain)
    )
    calibrated, rounded = (features_error(policy, one, observations) for one in loaded)
    assert calibrated < rounded


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, QuantizeReport]:
    """The demo policy, calibrated without an interruption."""
    out = tmp_path_factory.mktemp("whole") / "out"
    policy = demo_policy()
    return out, quantize(DEMO, out, to="int4", calibration=Calibration(policy, examples(policy, 3)))


def test_an_interrupted_run_goes_on(
    whole_run: tuple[Path, QuantizeReport], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Several groups of layers, each with a pass of its own.
    monkeypatch.setattr(calibration, "GROUP_BYTES", 300_000)
    policy, out = demo_policy(), tmp_path / "out"
    kept = tmp_path / "out.calibrating"
    steps: list[tuple[int, int]] = []

    def progress(done: int, total: int) -> None:
        steps.append((done, total))
        if len(steps) == 40:
            raise ZeroDivisionError

    given = Calibration(policy, examples(policy, 3), progress=progress)
    with pytest.raises(ZeroDivisionError):
        quantize(DEMO, out, to="int4", calibration=given)
    assert not out.exists()
    finished = {path: path.stat().st_mtime_ns for path in kept.glob("*/model.safetensors")}
    assert 0 < len(finished) < len(whole_run[1].rounding or ())
    with pytest.raises(
        InputError, match=r"out.calibrating: has results with other settings \(seed changed\)"
    ):
        quantize(DEMO, out, to="int4", calibration=Calibration(policy, examples(policy, 3), seed=1))
    with pytest.raises(InputError, match=r"\(observations, inputs_sha256 changed\)"):
        quantize(DEMO, out, to="int4", calibration=Calibration(policy, examples(policy, 2)))
    given = Calibration(policy, examples(policy, 3))
    with pytest.raises(InputError, match=r"\(parts changed\)"):
        quantize(DEMO, out, to="int4", calibration=given, keep_backbone=True)

    seen: dict[Path, int] = {}

    def look(done: int, total: int) -> None:
        assert total < steps[0][1]
        seen.update({path: path.stat().st_mtime_ns for path in finished})

    given = Calibration(policy, examples(policy, 3), progress=look)
    report = quantize(DEMO, out, to="int4", calibration=given)
    assert seen == finished
    assert contents(out) == contents(whole_run[0])
    assert report.rounding == whole_run[1].rounding
    assert not kept.exists()


def test_the_head_alone(whole_run: tuple[Path, QuantizeReport], tmp_path: Path) -> None:
    policy, out = demo_policy(), tmp_path / "out"
    given = Calibration(policy, examples(policy, 3))
    report = quantize(DEMO, out, to="int4", keep_backbone=True, calibration=given)
    assert report.num_calibrated == report.num_quantized > report.num_quantized_backbone == 0
    assert report.rounding is not None
    # The backbone that runs meanwhile is the exact one in both.
    of_whole = whole_run[1].rounding or {}
    assert report.rounding == {name: of_whole[name] for name in report.rounding}


class Unread(Sequence[Any]):
    """Observations that nobody may ask for."""

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: Any) -> Any:
        raise AssertionError("read before the arguments were checked")


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    policy, out = demo_policy(), tmp_path / "out"
    one = examples(policy, 1)

    def refused(kind: type[SaccadeError], match: str, given: Calibration, **options: Any) -> None:
        with pytest.raises(kind, match=match):
            quantize(DEMO, options.pop("out", out), **{"to": "int4", **options}, calibration=given)
        assert not out.exists()

    plain = Calibration(policy, one)
    refused(InputError, "calibration: expected None unless to is 'int4', got to='int8'", plain, to="int8")
    refused(InputError, "observations: expected at least one, got none", Calibration(policy, []))
    coarse = Policy.from_pretrained(DEMO, precision="bfloat16", num_threads=1)
    refused(InputError, "policy: expected one in float32, got bfloat16", Calibration(coarse, one))
    refused(InputError, "policy: expected saccade's own processor", Calibration(Policy(policy.head), one))
    refused(InputError, "policy: expected a saccade.Policy, got str", Calibration("demo", one))  # type: ignore[arg-type]
    other = Policy.from_pretrained(whole("isaac"), embodiment=EMBODIMENT, num_threads=1)
    refused(InputError, "policy: expected the policy of", Calibration(other, one))
    refused(InputError, "expected a saccade.checkpoints.Calibration, got list", one)  # type: ignore[arg-type]
    some = (observation for observation in one)
    refused(InputError, "expected a sequence, got generator", Calibration(policy, some))  # type: ignore[arg-type]
    refused(InputError, "seed: expected at least 0, got -1", Calibration(policy, one, seed=-1))
    refused(InputError, "config: expected None with calibration", plain, config=DEMO / "config.json")
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "thesis.txt").write_text("all of it")
    for force in (False, True):
        refused(InputError, "taken", Calibration(policy, Unread()), out=taken, force=force)
    assert (taken / "thesis.txt").read_text() == "all of it"
    bad = dict(one[0], video={})
    refused(SaccadeError, "video", Calibration(policy, [bad]))


def test_a_folder_of_somebody_else_is_not_touched(tmp_path: Path) -> None:
    policy, kept = demo_policy(), tmp_path / "out.calibrating"
    kept.mkdir()
    (kept / "thesis.txt").write_text("all of it")
    given = Calibration(policy, examples(policy, 1))
    with pytest.raises(InputError, match=r"got one with thesis.txt and without settings.json"):
        quantize(DEMO, tmp_path / "out", to="int4", calibration=given)
    assert [path.name for path in kept.iterdir()] == ["thesis.txt"]
    # Nor is it a calibration because somebody has such settings.
    (kept / "settings.json").write_text("{}")
    with pytest.raises(InputError, match="has results with other settings"):
        quantize(DEMO, tmp_path / "out", to="int4", calibration=given)
    assert (kept / "thesis.txt").read_text() == "all of it"


def test_what_an_earlier_run_left(
    whole_run: tuple[Path, QuantizeReport], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run without a layer is nobody's, a damaged layer is rounded again, and a slash at the end is none."""
    policy = demo_policy()
    kept = tmp_path / "out.calibrating"

    def stop(done: int, total: int) -> None:
        raise ZeroDivisionError

    given = Calibration(policy, examples(policy, 1), seed=5, progress=stop)
    with pytest.raises(ZeroDivisionError):
        quantize(DEMO, tmp_path / "out", to="int4", calibration=given)
    assert [path.name for path in kept.iterdir()] == ["settings.json"]

    monkeypatch.setattr(calibration, "GROUP_BYTES", 300_000)
    count = iter(range(40))

    def later(done: int, total: int) -> None:
        if next(count, None) is None:
            raise ZeroDivisionError

    observations = examples(policy, 3)
    given = Calibration(policy, observations, progress=later)
    with pytest.raises(ZeroDivisionError):
        quantize(DEMO, f"{tmp_path}/out/", to="int4", calibration=given)
    first, second, *_ = sorted(path for path in kept.iterdir() if path.is_dir())
    (first / "model.safetensors").write_bytes(b"half")
    (second / "model.safetensors").unlink()
    quantize(DEMO, f"{tmp_path}/out/", to="int4", calibration=Calibration(policy, observations))
    assert contents(tmp_path / "out") == contents(whole_run[0])
    assert not kept.exists()


def run(*arguments: Any) -> int:
    return cli.main([str(argument) for argument in arguments])


def test_the_command_on_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = demo_policy()
    data = by_the_policy(policy, (9, 5, 8), stride=4, seed=0)
    folder, out = written(data, tmp_path / "recordings"), tmp_path / "out"
    options = ("--to", "int4", "--calibrate", folder, "--observations", 4, "--num-threads", 1)
    assert run("quantize", DEMO, "--out", out, *options) == 0
    shown = capsys.readouterr().out
    assert "weights were rounded for 4 observations; on these the outputs of their layers differ" in shown
    assert run("inspect", out) == 0
    assert "rounded for what the layers are given on 4 observations (GPTQ)" in capsys.readouterr().out
    # 22 steps in all: the middles of four equal parts.
    steps = [(0, 2), (0, 8), (1, 4), (2, 5)]
    seen = [data.observation(episode, step) for episode, step in steps]
    quantize(DEMO, tmp_path / "same", to="int4", calibration=Calibration(policy, seen))
    assert contents(out) == contents(tmp_path / "same")
    assert run("quantize", DEMO, "--out", out, *options) == 2
    assert "out" in capsys.readouterr().err


def test_the_command_on_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy = demo_policy()
    frames = tmp_path / "frames"
    seen = examples(policy, 2)
    for index, observation in enumerate(seen):
        (frames / str(index)).mkdir(parents=True)
        for name, video in observation["video"].items():
            Image.fromarray(video[0, -1]).save(frames / str(index) / f"{name}.png")
        observation["language"] = {key: [["push the cube"]] for key in observation["language"]}
        state = {key: values[0, -1].tolist() for key, values in observation["state"].items()}
        (frames / str(index) / "state.json").write_text(json.dumps(state))
    options = ("--to", "int4", "--calibrate", frames, "--instruction", "push the cube", "--json")
    assert run("quantize", DEMO, "--out", tmp_path / "out", *options, "--seed", 3) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["num_calibrated"] == report["num_quantized"] - 1 > len(report["rounding"])
    quantize(DEMO, tmp_path / "same", to="int4", calibration=Calibration(policy, seen, seed=3))
    assert contents(tmp_path / "out") == contents(tmp_path / "same")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--instruction", "push"], "--instruction: only with --calibrate"),
        (["--observations", "3", "--seed", "1"], "--observations, --seed: only with --calibrate"),
        (["--calibrate", "frames"], "--calibrate: only with --to int4, given int8"),
        (["--to", "int4", "--calibrate", "{data}", "--state", "s.json"], "--state: not with --calibrate"),
        (["--to", "int4", "--calibrate", "{images}", "--observations", "3"], "--observations: not with"),
        (["--to", "int4", "--calibrate", "{images}"], "--instruction: expected what the robot is told"),
        ([*IMAGES, "{images}"], "expected pictures named after the cameras"),
        ([*IMAGES, "{stateless}"], "--state: expected the robot's state, since"),
        ([*IMAGES, "no/such/folder"], "no such directory"),
        ([*IMAGES, "{images}", "--config", "config.json"], "--config: not with --calibrate"),
    ],
)
def test_bad_arguments_of_the_command(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "data" / "meta").mkdir(parents=True)
    (tmp_path / "images").mkdir()
    stateless = tmp_path / "stateless"
    stateless.mkdir()
    for name, video in demo_policy().example_observation()["video"].items():
        Image.fromarray(video[0, -1]).save(stateless / f"{name}.png")
    places = {"data": tmp_path / "data", "images": tmp_path / "images", "stateless": stateless}
    given = [argument.format(**places) for argument in arguments]
    assert run("quantize", DEMO, "--out", tmp_path / "out", *given) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_observations_of_a_data_set_are_spaced_evenly() -> None:
    from saccade.evaluation.recordings import SpacedObservations

    policy = demo_policy()
    data = by_the_policy(policy, (9, 5, 8), stride=4, seed=0)
    spaced = SpacedObservations(policy, data, 4)
    assert spaced.places == [(0, 2), (0, 8), (1, 4), (2, 5)]
    assert len(SpacedObservations(policy, data, 100)) == 22
    assert SpacedObservations(policy, data, 100).places == [
        (episode, step) for episode, length in enumerate((9, 5, 8)) for step in range(length)
    ]
    first = spaced[0]
    assert isinstance(first, ParsedObservation)
    state: npt.NDArray[Any] = spaced[1:2][0].state
    np.testing.assert_array_equal(state, spaced[1].state)
