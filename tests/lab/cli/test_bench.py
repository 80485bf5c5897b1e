"""`saccade bench`: what is counted, what is printed, what is refused. No test looks at a time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import _saccade
from saccade._internal.arrays import PRECISIONS
from saccade.cli import main
from saccade_lab.random_checkpoint.head import config_of_size, write_head
from saccade_lab.timing import Call, Machine, by_turns, quartiles, works_of

MACHINE = Machine("avx512", 1, {"float32": 1e9, "bfloat16": 2e9, "int8": 4e9, "int4": 4e9}, 1e9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A head of the small size."""
    path = tmp_path_factory.mktemp("small")
    write_head(path, config_of_size("small"))
    return path


@pytest.fixture(scope="module")
def head(folder: Path) -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(folder)


def test_the_floor_is_the_longer_of_two() -> None:
    assert MACHINE.floor("int8", 8e9, 1e9) == 2.0
    assert MACHINE.floor("int8", 8e9, 3e9) == 3.0
    assert MACHINE.limit("int8", 8e9, 1e9) == "arithmetic"
    assert MACHINE.limit("int8", 8e9, 3e9) == "memory"


def test_peaks_of_this_machine() -> None:
    peaks = _saccade.measure_peaks(1)
    assert list(peaks["macs_per_second"]) == _saccade.available_isas()
    assert all(set(rates) == set(PRECISIONS) for rates in peaks["macs_per_second"].values())
    assert peaks["kernels"]["portable"] == {
        "float32": "portable-f32",
        "bfloat16": "portable-bf16-as-f32",
        "int8": "portable-int8",
        "int4": "portable-int4",
    }
    assert list(peaks["read_bytes_per_second_by_streams"]) == [1, 16]
    assert peaks["read_bytes_per_second"] == max(peaks["read_bytes_per_second_by_streams"].values()) > 0
    with pytest.raises(saccade.InputError, match="num_threads: expected at least 1, got 0"):
        _saccade.measure_peaks(0)


def test_nothing_is_counted_unasked(head: saccade.ActionHead) -> None:
    work = works_of(head, Call.of(head.config, 4))["both"]
    with _saccade.profile() as first:
        work()
    work()
    with _saccade.profile() as second:
        pass
    assert sum(counter[0] for counter in first.counters().values()) > 0
    assert all(counter == (0, 0.0, 0, 0) for counter in second.counters().values())


def test_random_heads_compute_something(head: saccade.ActionHead) -> None:
    actions = np.asarray(works_of(head, Call.of(head.config, 4))["both"]())
    assert np.isfinite(actions).all()
    assert actions.std() > 0.01


def test_names_and_shapes_are_those_that_load_expects(folder: Path) -> None:
    text = (folder / "config.json").read_text()
    shapes = dict(_saccade.tensor_shapes(text))
    read = _saccade.read_tensors(str(folder), "action_head.")
    assert {name: list(array.shape) for name, array in read.items()} == shapes


def test_every_call_has_its_turn_in_each_round() -> None:
    order: list[str] = []
    done: list[int] = []
    works = {name: lambda name=name: order.append(name) for name in "abc"}
    seconds = by_turns(works, 4, done.append)
    assert "".join(order) == "abcbcacababc"
    assert done == [1, 2, 3, 4]
    assert {name: len(values) for name, values in seconds.items()} == dict.fromkeys("abc", 4)
    assert quartiles([3.0]) == (3.0, 3.0, 3.0)
    assert quartiles([4.0, 1.0, 2.0, 3.0, 5.0]) == (2.0, 3.0, 4.0)


# The command


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(["bench", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_json_has_times_and_profile(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    report = printed(
        capsys,
        *(
            "--checkpoint",
            str(folder),
            "--precisions",
            "float32",
            "--num-threads",
            "1",
            "--num-vl-tokens",
            "5",
        ),
        *("--num-steps", "2", "--num-samples", "2", "--future-refresh", "2", "--rounds", "2"),
        "--profile",
    )
    assert report["saccade"] == saccade.__version__
    assert report["call"] == {
        "num_vl_tokens": 5,
        "num_steps": 2,
        "batch": 1,
        "num_samples": 2,
        "future_refresh": 2,
        "num_future_tokens": 32,
        "num_image_tokens": None,
    }
    assert report["machine"]["num_threads"] == 1
    assert set(report["machine"]["kernels"]) == set(PRECISIONS)
    kernels = {part["part"]: part["kernel"] for one in report["profile"] for part in one["parts"]}
    # The weights are bfloat16, and widened in registers.
    assert kernels["to_q"] == report["machine"]["kernels"]["float32"] + "-bf16"
    assert kernels["attention"] == ""
    assert set(report["machine"]["macs_per_second"]) == set(PRECISIONS)
    works = {one["call"]: sum(part["multiply_adds"] for part in one["parts"]) for one in report["profile"]}
    assert list(works) == ["encode", "sample"]
    results = {record["call"]: record for record in report["results"]}
    assert list(results) == ["encode", "sample", "both"]
    for name, record in results.items():
        assert record["precision"] == "float32"
        assert len(record["seconds"]) == 2
        assert len(record["quartiles"]) == 3
        assert record["multiply_adds"] == works.get(name, sum(works.values()))
        assert record["floor_seconds"] > 0
    for one in report["profile"]:
        whole = sum(part["seconds"] for part in one["parts"]) + one["other_seconds"]
        assert whole == pytest.approx(one["seconds"])


def test_software_tiles_can_be_measured(
    capsys: pytest.CaptureFixture[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SACCADE_ISA", "software_tiles")
    sizes = ("--num-vl-tokens", "3", "--num-steps", "1", "--rounds", "1", "--num-threads", "1")
    machine = printed(capsys, "--checkpoint", str(folder), *sizes)["machine"]
    assert machine["isa"] == "software_tiles"
    assert machine["kernels"]["int8"] == "software-tiles-int8"
    assert min(machine["macs_per_second"][precision] for precision in PRECISIONS) > 0


def test_the_shipped_policy_is_the_default(capsys: pytest.CaptureFixture[str]) -> None:
    """Its T_vl is that of a prompt with its three cameras, 23 tokens each."""
    assert main(["bench", "--precisions", "float32", "--rounds", "1", "--profile"]) == 0
    text = capsys.readouterr().out
    assert "the bundled policy" in text
    assert "T_vl 93, N 32, 4 steps, 1 samples, future_refresh 1" in text
    assert "float32 sample, by part" in text
    assert "feed_forward_out" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--precisions", "float16"],
            "--precisions: unknown name 'float16', expected one of float32, bfloat16, int8, int4",
        ),
        (["--precisions", ""], "--precisions: expected at least one name"),
        (["--num-threads", "0"], "--num-threads: given 0, expected at least 1"),
        (["--rounds", "-1"], "--rounds: given -1, expected at least 1"),
        (["--future-refresh", "0"], "--future-refresh: given 0, expected at least 1"),
        (["--checkpoint", "no/such/place"], "no/such/place: no such checkpoint"),
        (["--checkpoint", ".", "--version", "n1.5"], "leave out --checkpoint"),
    ],
)
def test_bad_input_is_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["bench", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
