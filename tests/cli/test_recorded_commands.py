"""`saccade evaluate`, `certify` and `diagnose` on recordings in a folder."""

from __future__ import annotations

import csv
import gc
import json
import shutil
import weakref
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade import cli
from saccade.cli import recorded
from saccade.evaluation.source import forget_policy, weights_hash
from tests.helpers.recorded_cases import Recorded, by_the_policy, demo_policy
from tests.helpers.recorded_folder import written

LENGTHS = (9, 5, 8)
DEMO = str(saccade.demo_checkpoint())


@pytest.fixture(scope="module")
def data() -> Recorded:
    return by_the_policy(demo_policy(), LENGTHS, stride=4, seed=0)


@pytest.fixture(scope="module")
def folder(data: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(data, tmp_path_factory.mktemp("recordings") / "tiny")


@pytest.fixture(autouse=True)
def without_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lab has tests of its own."""
    monkeypatch.setattr(recorded, "extension", lambda name: None)


def run(*arguments: Any) -> int:
    return cli.main([str(argument) for argument in arguments])


def test_the_results_are_those_of_the_function(
    folder: Path, data: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run("evaluate", DEMO, folder, "--out", out, "--stride", 4, "--seed", 1, "--num-threads", 1) == 0
    shown = capsys.readouterr()
    assert "policy" in shown.out
    assert "need saccade-vla-lab" in shown.err
    found = json.loads((out / "results.json").read_text())
    expected = saccade.evaluate(demo_policy(), data, stride=4, seed=1)
    assert found["mse"] == expected.mse
    assert {key: one["mae"] for key, one in found["by_key"].items()} == {
        key: one.mae for key, one in expected.by_key.items()
    }
    assert found["table"] == [dict(row) for row in expected.table]
    assert set(found) >= {"mse", "mae", "by_key", "by_step", "table", "baselines", "intervals"}
    with (out / "errors.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["mse"]) for row in rows] == [row["mse"] for row in expected.table]
    # The recorded seed gives the recorded actions, bit for bit.
    assert (
        run("evaluate", DEMO, folder, "--out", tmp_path / "same", "--stride", 4, "--num-threads", 1, "--json")
        == 0
    )
    assert json.loads(capsys.readouterr().out)["mse"] == 0


def test_an_interrupted_run_goes_on(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, whole = tmp_path / "out", tmp_path / "whole"
    options = ("--stride", 8, "--num-threads", 1)
    assert run("evaluate", DEMO, folder, "--out", out, *options, "--episodes", "0,2") == 0
    files = {path: path.stat().st_mtime_ns for path in (out / "episodes").glob("*.npz")}
    assert sorted(path.name for path in files) == ["000000.npz", "000002.npz"]
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in files.items())
    assert run("evaluate", DEMO, folder, "--out", whole, *options) == 0
    first, second = (json.loads((one / "results.json").read_text()) for one in (out, whole))
    assert {**first, "seconds": 0} == {**second, "seconds": 0}
    capsys.readouterr()
    assert run("evaluate", DEMO, folder, "--out", out, "--stride", 4, "--seed", 5) == 2
    assert "other settings (stride, seed changed)" in capsys.readouterr().err
    (out / "episodes" / "000001.npz").write_bytes(b"half")
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 2
    assert "000001.npz: cannot be read" in capsys.readouterr().err


def test_a_comparison_with_an_earlier_run(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exact, coarse = tmp_path / "exact", tmp_path / "coarse"
    options = ("--stride", 4, "--num-threads", 1)
    assert run("evaluate", DEMO, folder, "--out", exact, *options) == 0
    assert run("evaluate", DEMO, folder, "--out", coarse, *options, "--num-steps", 1, "--against", exact) == 0
    first, second = (json.loads((one / "results.json").read_text()) for one in (exact, coarse))
    assert first["against"] is None
    assert second["against"]["mse"]["value"] == pytest.approx(second["mse"] - first["mse"], rel=1e-4)
    assert not second["against"]["equal"]
    capsys.readouterr()
    assert (
        run("evaluate", DEMO, folder, "--out", coarse, *options, "--num-steps", 1, "--against", tmp_path) == 2
    )
    assert "expected the directory of an earlier run" in capsys.readouterr().err
    # The same actions beside other frames are other recordings; and nothing is computed before it is said.
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    (other / "meta" / "note.json").write_text("{}")
    for recordings, changed, message in (
        (other, (), "expected the recordings of this run"),
        (folder, ("--seed", 1), "expected the seed of this run, 1, got 0"),
        (folder, ("--stride", 8), "expected the stride of this run, 8, got 4"),
    ):
        out = tmp_path / "none"
        assert run("evaluate", DEMO, recordings, "--out", out, *options, *changed, "--against", exact) == 2
        assert message in capsys.readouterr().err
        assert not out.exists()
    (exact / "episodes" / "000001.npz").unlink()
    assert run("evaluate", DEMO, folder, "--out", coarse, *options, "--num-steps", 1, "--against", exact) == 2
    assert "expected the episodes of this run, 1 is missing" in capsys.readouterr().err


def test_results_are_not_mixed(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, episodes = tmp_path / "out", tmp_path / "out" / "episodes"
    tokenizer = tmp_path / "tokenizer.json"
    shutil.copyfile(Path(DEMO) / "tokenizer.json", tokenizer)
    options: tuple[Any, ...] = ("--stride", 16, "--num-threads", 1, "--tokenizer", tokenizer)
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 0
    capsys.readouterr()
    # A file that an option names, with other contents.
    tokenizer.write_text(tokenizer.read_text() + "\n")
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 2
    assert "other settings (option_files changed)" in capsys.readouterr().err
    options = options[:-2]
    shutil.rmtree(out)
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 0
    # An episode's file under another name.
    shutil.copyfile(episodes / "000000.npz", episodes / "000001.npz")
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 2
    assert "000001.npz: cannot be read: it is of episode 0" in capsys.readouterr().err
    # Results of which nobody knows the settings.
    (episodes / "settings.json").unlink()
    assert run("evaluate", DEMO, folder, "--out", out, *options) == 2
    assert "settings.json: no such file, but results of episodes beside it" in capsys.readouterr().err


def test_the_hash_of_a_checkpoint_tells_where_its_files_are(tmp_path: Path) -> None:
    for folder, name in (("one", "a"), ("two", "b")):
        (tmp_path / folder / name).mkdir(parents=True)
        (tmp_path / folder / name / "merges.txt").write_text("x")
    first, second = (weights_hash(tmp_path / name) for name in ("one", "two"))
    assert first != second
    (tmp_path / "one" / "a" / "merges.txt").write_text("y")
    assert weights_hash(tmp_path / "one") != first


def test_a_certificate_holds_here_and_notices_changes(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "certificate.json"
    options = ("--stride", 8, "--num-threads", 1, "--precision", "int8")
    assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *options, "--certify", file) == 0
    values = json.loads(file.read_text())
    assert values["equal_over_batches"] is values["equal_over_threads"] is True
    assert values["threads"] == [1, 2]
    assert 0 < values["from_float32"]["normalized"] < 1
    assert values["observations"] == [[0, 0], [0, 8], [1, 0], [2, 0]]
    assert file.stat().st_size < 20_000
    capsys.readouterr()
    assert run("certify", file, "--json", "--num-threads", 2) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["holds"] is True
    assert [one["name"] for one in found["findings"]] == [
        "checkpoint, sha256",
        "recordings, sha256",
        "actions, bits",
        "the same bits over batches",
        "the same bits over threads",
        "largest difference from float32",
    ]
    # Other bits of the same machine; other machines may round otherwise, but not compute something else.
    forged = {**values, "actions": values["actions"][:-8] + "AAAAAAA="}
    file.write_text(json.dumps(forged))
    assert run("certify", file) == 1
    assert "NO" in capsys.readouterr().out
    elsewhere = {**values, "made_with": {**values["made_with"], "instruction_set": "elsewhere"}}
    file.write_text(json.dumps(elsewhere))
    assert run("certify", file) == 0
    wrong = {**elsewhere, "actions": "AAAA" * (len(values["actions"]) // 4)}
    file.write_text(json.dumps(wrong))
    assert run("certify", file) == 1
    capsys.readouterr()
    for wrong in (
        {"sampling": {"speed": 2}},
        {"observations": [[0]]},
        {"observations": []},
        {"observations": [[0, 0]] * 17},
        {"observations": [[0, -1]]},
        {"seed": -1},
        {"stride": 1.5},
        {"checkpoint": {}},
        {"equal_over_batches": "yes"},
        {"from_float32": {"normalized": 1e999}},
        {"from_float32": {"normalized": -1}},
        {"from_float32": {"normalized": None}},
    ):
        file.write_text(json.dumps({**values, **wrong}))
        assert run("certify", file) == 2
    other = {**values, "recordings": {**values["recordings"], "sha256": "0" * 64}}
    file.write_text(json.dumps(other))
    assert run("certify", file, "--json") == 1
    assert [one["holds"] for one in json.loads(capsys.readouterr().out)["findings"]] == [True, False]


def test_a_certificate_has_one_policy_in_memory(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, most = saccade.Policy.from_pretrained, []
    loaded: list[weakref.ref[saccade.Policy]] = []

    def counted(*arguments: Any, **options: Any) -> saccade.Policy:
        gc.collect()
        most.append(sum(one() is not None for one in loaded))
        policy = load(*arguments, **options)
        loaded.append(weakref.ref(policy))
        return policy

    forget_policy()
    monkeypatch.setattr(saccade.Policy, "from_pretrained", counted)
    options = ("--stride", 8, "--num-threads", 1, "--precision", "int8")
    file = tmp_path / "certificate.json"
    assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *options, "--certify", file) == 0
    assert most == [0, 0, 0]  # with these options, with other threads, in float32


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": 2}', '{"format": 1, "mse": 3}', "null", "3"])
def test_no_certificate_is_named(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "certificate.json"
    file.write_text(text)
    assert run("certify", file) == 2
    assert "expected a certificate" in capsys.readouterr().err
    assert run("certify", tmp_path / "none.json") == 2


def test_a_diagnosis_is_that_of_the_function(
    folder: Path, data: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    options = ("--num-threads", 1, "--episodes", "0,1")
    assert run("diagnose", DEMO, folder, "--out", out, *options) == 0
    assert "camera.left" in capsys.readouterr().out
    found = json.loads((out / "results.json").read_text())
    expected = saccade.diagnose(demo_policy(), data, episodes=[0, 1])
    assert set(found["inputs"]) == set(expected.inputs)
    for name, one in expected.inputs.items():
        assert (found["inputs"][name]["name"], found["inputs"][name]["effect"]) == (one.name, one.effect)
    assert len(list((out / "episodes").glob("*.npz"))) == 2
    assert run("diagnose", DEMO, folder, "--out", out, *options, "--json") == 0  # computes nothing
    assert json.loads(capsys.readouterr().out) == found


@pytest.mark.parametrize("text", ["", "[]", "{", "7"])
def test_damaged_settings_of_a_run_are_named(
    text: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "episodes").mkdir()
    (tmp_path / "episodes" / "settings.json").write_text(text)
    assert run("evaluate", DEMO, folder, "--out", tmp_path, "--num-threads", 1) == 2
    assert "settings.json: " in capsys.readouterr().err


def test_processes_need_the_lab(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in (("--jobs", 2), ("--backend", "ray")):
        assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *option) == 2
        assert "need saccade-vla-lab, which is not installed. Install with:" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_does_not_fit_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments, message in (
        (("--episodes", 7), "episodes: expected at least one of 0 to 2, got 7"),
        (("--stride", 99), "stride: expected at most 16"),
        (("--jobs", 0), "--jobs: given 0, expected at least 1, or -1 for one per core"),
        (("--address", "first:6379"), "--address: only with --backend ray, given loky"),
        (("--certify", tmp_path), f"--certify: expected the name of a file, got the directory {tmp_path}"),
    ):
        assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *arguments) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
    assert run("evaluate", DEMO, tmp_path / "nowhere", "--out", tmp_path / "out") == 2
    assert "nowhere" in capsys.readouterr().err
