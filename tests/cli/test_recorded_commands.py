"""`saccade evaluate`, `certify` and `diagnose` on recordings in a folder."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade._internal.environment import arithmetic
from saccade.cli import recorded
from saccade.evaluation import Evaluation, source
from saccade.evaluation.source import weights_hash
from tests.helpers.recorded_cases import Recorded, demo_policy
from tests.helpers.recorded_commands import DEMO, results, run

pytestmark = pytest.mark.usefixtures("without_pages")


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
    assert results(out) == results(whole)
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


def test_other_files_are_the_same_by_any_name(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, old, new = tmp_path / "out", tmp_path / "old", tmp_path / "new"
    for name, origin in (("policy", DEMO), ("recordings", folder)):
        shutil.copytree(origin, old / name)
    shutil.copyfile(Path(DEMO) / "tokenizer.json", old / "words.json")

    def command(root: Path, suffix: str = "") -> tuple[Any, ...]:
        given = (
            root / f"policy{suffix}",
            root / f"recordings{suffix}",
            "--tokenizer",
            root / f"words{suffix}.json",
        )
        return ("evaluate", *given, "--out", out, "--stride", 16, "--num-threads", 1)

    assert run(*command(old)) == 0
    before = results(out)
    assert (before["checkpoint"]["name"], before["recordings"]["name"]) == ("policy", "recordings")
    files = {path: path.stat().st_mtime_ns for path in (out / "episodes").glob("*.npz")}
    new.mkdir()
    for name, suffix in (("policy", ""), ("recordings", ""), ("words", ".json")):
        (old / f"{name}{suffix}").rename(new / f"{name}-2{suffix}")
    assert run(*command(new, "-2")) == 0
    assert all(path.stat().st_mtime_ns == time for path, time in files.items())
    after = results(out)
    assert (after.pop("checkpoint")["name"], after.pop("recordings")["name"]) == ("policy-2", "recordings-2")
    assert after == {name: value for name, value in before.items() if name in after}
    capsys.readouterr()
    (new / "words-2.json").write_text((new / "words-2.json").read_text() + "\n")
    assert run(*command(new, "-2")) == 2
    assert "other settings (option_files changed)" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["saccade", "library", "instruction_set", "dot_products"])
def test_what_computes_does_not_change_within_a_run(
    name: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ("evaluate", DEMO, folder, "--out", tmp_path, "--stride", 16, "--num-threads", 1)
    assert run(*command, "--episodes", 1) == 0
    here = arithmetic()
    assert results(tmp_path)[name] == here[name]
    monkeypatch.setattr(source, "arithmetic", lambda: {**here, name: "other"})
    assert run(*command) == 2
    assert f"other settings ({name} changed)" in capsys.readouterr().err


def test_results_may_be_in_the_checkpoints_folder(folder: Path, tmp_path: Path) -> None:
    checkpoint = tmp_path / "policy"
    shutil.copytree(DEMO, checkpoint)
    before = weights_hash(checkpoint)
    for out in (checkpoint, checkpoint / "evaluation"):
        command = ("evaluate", checkpoint, folder, "--out", out, "--stride", 16, "--num-threads", 1)
        assert run(*command, "--episodes", 1) == 0
        assert run(*command) == 0
    shutil.copytree(DEMO, checkpoint / "checkpoint-500")  # what a trainer leaves
    assert weights_hash(checkpoint) == before


def test_an_older_page_does_not_stay(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ("evaluate", DEMO, folder, "--out", tmp_path, "--stride", 16, "--num-threads", 1)
    curves = tmp_path / "curves"
    curves.mkdir()
    page, old, note = tmp_path / "index.html", curves / "000002.png", curves / "note.txt"
    for path in (page, old, note):
        path.write_text("old")
    assert run(*command, "--episodes", 1) == 0
    assert [path.exists() for path in (page, old, note)] == [False, False, True]
    drawn = []

    def draw(report: Evaluation, about: dict[str, Any], out: Path) -> None:
        drawn.append([one.episode for one in report.predictions])
        assert not page.exists()
        page.write_text(about["checkpoint"]["name"])

    monkeypatch.setattr(recorded, "extension", lambda name: draw)
    for episodes in ("0,1", "1"):
        assert run(*command, "--episodes", episodes) == 0
    assert drawn == [[0, 1], [1]]
    assert page.read_text() == "demo"


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
        (
            ("--certify", tmp_path / "none" / "c.json"),
            f"--certify: expected a file in a directory that exists, got {tmp_path / 'none' / 'c.json'}",
        ),
    ):
        assert run("evaluate", DEMO, folder, "--out", tmp_path / "out", *arguments) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "out").exists()
    assert run("evaluate", DEMO, tmp_path / "nowhere", "--out", tmp_path / "out") == 2
    assert "nowhere" in capsys.readouterr().err
