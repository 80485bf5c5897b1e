"""`saccade parity`: what it prints, what it returns, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import saccade
from saccade import cli
from saccade_lab.cli import parity
from saccade_lab.reference.random_weights import CONFIGS
from tests.helpers.released import NAMES, load_released

SMALL = ["parity", "--num-vl-tokens", "5"]


def test_a_small_random_head_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(SMALL) == 0
    printed = capsys.readouterr()
    for isa in saccade.show_config("dicts")["available_isas"]:
        assert f"rust {isa}" in printed.out
    assert "torch float32" in printed.out
    assert "within the tolerance" in printed.out
    assert "reference in float64" in printed.err  # progress


@pytest.mark.parametrize("version", CONFIGS)
def test_every_version(version: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, "--version", version, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["head"] == f"random {version} small"


def test_versions_are_those_of_the_random_weights() -> None:
    assert tuple(CONFIGS) == parity.VERSIONS


def test_json_has_every_engine(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        cli.main(
            [
                *SMALL,
                "--json",
                "--batch",
                "2",
                "--num-steps",
                "2",
                "--dtype",
                "bfloat16",
                "--embodiment-id",
                "1",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    isas = saccade.show_config("dicts")["available_isas"]
    assert [result["engine"] for result in report["results"]] == [
        *(f"rust {isa}" for isa in isas),
        "torch float32",
    ]
    assert report["passed"] is True
    assert report["inputs"].startswith("batch 2, 5 vision-language tokens")
    assert all(0 < result["actions"]["max_rel"] < 1e-5 for result in report["results"])


@pytest.mark.parametrize("name", [*NAMES, "n17_tiny", "fork_two_decoders"])
def test_a_checkpoint_with_recorded_inputs(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    released = load_released(name)
    # The recorded files carry weights, config and inputs in one.
    path = str(released.path)
    assert cli.main(["parity", "--checkpoint", path, "--features", path, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["largest_action"] == pytest.approx(np.abs(released.actions_f64).max(), rel=1e-6)


def test_a_difference_above_the_tolerance_is_status_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*SMALL, "--tolerance", "1e-12"]) == parity.EXIT_DIFFERENT
    assert "ABOVE" in capsys.readouterr().out


def test_nan_is_a_difference() -> None:
    given = np.array([np.nan, 1.0])
    assert not parity.Deviation.between(given, np.ones(2)).max_rel <= 1e9


def test_isa_of_the_environment_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SACCADE_ISA", "portable")
    assert cli.main(SMALL) == 0
    assert saccade.show_config("dicts")["isa"] == "portable"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--checkpoint", "nowhere"], "nowhere"),
        (["--features", "nowhere"], "nowhere"),
        (["--checkpoint", ".", "--full"], "leave out --checkpoint"),
        (["--checkpoint", ".", "--dtype", "bfloat16"], "leave out --checkpoint"),
        (["--checkpoint", ".", "--version", "n1"], "leave out --checkpoint"),
        (["--version", "n1.7", "--num-vl-tokens", "1"], "--num-vl-tokens: given 1, expected at least 2"),
        (["--full", "--dtype", "bfloat16", "--batch", "0"], "--batch: given 0, expected at least 1"),
        (["--num-vl-tokens", "-3"], "--num-vl-tokens: given -3, expected at least 1"),
        (["--num-steps", "0"], "--num-steps: given 0, expected at least 1"),
        (["--num-steps", "1001"], "1000"),
        (["--num-threads", "0"], "--num-threads: given 0, expected at least 1"),
        (["--tolerance", "nan"], "--tolerance: given nan"),
        (["--embodiment-id", "99"], "embodiment_id"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_arguments_are_one_line(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["parity", *arguments]) == cli.EXIT_BAD_INPUT
    printed = capsys.readouterr()
    last = printed.err.splitlines()[-1]
    assert said in last
    assert last.startswith("saccade: ")
    assert printed.out == ""


def test_inputs_that_do_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "inputs.safetensors"
    path.write_bytes(b"no safetensors")
    assert cli.main(["parity", "--features", str(path)]) == cli.EXIT_BAD_INPUT
    good = {
        "backbone_features": torch.zeros(1, 5, 128),
        "state": torch.zeros(1, 64),
        "embodiment_id": torch.zeros(1, dtype=torch.long),
        "noise": torch.zeros(1, 16, 32),
    }
    save_file(good, path)
    assert cli.main(["parity", "--features", str(path)]) == 0
    for name in good:
        save_file({other: tensor for other, tensor in good.items() if other != name}, path)
        if name == "noise":  # is drawn
            assert cli.main(["parity", "--features", str(path)]) == 0
        else:
            assert cli.main(["parity", "--features", str(path)]) == cli.EXIT_BAD_INPUT
            assert name in capsys.readouterr().err.splitlines()[-1]
        save_file(good | {name: torch.zeros(*good[name].shape, 2, dtype=good[name].dtype)}, path)
        assert cli.main(["parity", "--features", str(path)]) == cli.EXIT_BAD_INPUT
        assert name in capsys.readouterr().err.splitlines()[-1]
