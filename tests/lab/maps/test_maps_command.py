"""`saccade attention`: end to end, on features of a file, and on bad input."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from saccade.checkpoints import read_tensors
from saccade.cli import main
from saccade_lab.cli.attention import show
from saccade_lab.maps import record
from saccade_lab.maps.layout import parse_layout
from saccade_lab.maps.notes import NO_FUTURE, NO_IMAGES
from saccade_lab.sim import graphics
from saccade_lab.sim.policy import DEMO_CHECKPOINT, Policy
from tests.helpers.maps_cases import feature_arrays, one_hot_maps, written
from tests.helpers.released import load_released


def test_without_image_tokens_there_is_no_occlusion_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = load_released("n15_tiny")
    (tmp_path / "config.json").write_text(json.dumps(given.config))
    names = ("backbone_features", "state", "embodiment_id")
    features = written(tmp_path / "f.npz", {name: getattr(given, name) for name in names})
    arguments = [
        "--checkpoint",
        str(given.path),
        "--config",
        str(tmp_path / "config.json"),
        "--features",
        str(features),
    ]
    chosen = ["--layout", "text:*", "--row", "1", "--steps", "0", "--num-threads", "1"]
    assert main(["attention", *arguments, *chosen, "--out", str(tmp_path / "out")]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert NO_IMAGES in shown
    assert record.CAVEAT in shown
    assert "occlusion" not in shown
    found = json.loads((tmp_path / "out/attention.json").read_text())
    assert found["occlusion"] is None
    assert found["caveat"] == record.CAVEAT
    assert {entry["rank_correlation"] for entry in found["agreement"]} == {None}
    page = (tmp_path / "out/page.html").read_text()
    assert NO_IMAGES in page
    assert record.OCCLUSION not in page


@pytest.fixture
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)


@pytest.mark.usefixtures("no_probe")
def test_the_command_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--task", "reach", "--seed", "1", "--after", "8", "--blocks", "1,2", "--steps", "0,3"]
    assert main(["attention", *arguments, "--num-threads", "1", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((tmp_path / "attention.json").read_text())
    assert {path.name for path in tmp_path.iterdir()} == {"attention.json", "page.html", "sheet.png"}
    assert found["source"] == {
        "kind": "simulator",
        "task": "reach",
        "seed": 1,
        "control_steps": 8,
        "instruction": "move the hand to the green ball",
        "views": ["left", "right", "top"],
    }
    assert found["checkpoint"]["sha256"] == Policy.from_pretrained().checkpoint_sha256()
    assert found["selection"]["blocks"] == [1, 2]
    assert found["caveat"] == f"{record.CAVEAT} {record.OCCLUSION}"
    assert {(entry["step"], entry["block"]) for entry in found["summaries"]} == {
        (0, 1),
        (0, 2),
        (3, 1),
        (3, 2),
    }
    for entry in found["summaries"]:
        assert sum(entry["mass"].values()) == pytest.approx(1.0, abs=1e-5)
    assert np.shape(found["occlusion"]["change"]["top"]) == (4, 4)
    assert found["occlusion"]["other_noise"] > 0


@pytest.mark.usefixtures("no_probe")
def test_a_checkpoint_without_future_tokens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = Path(shutil.copytree(DEMO_CHECKPOINT, tmp_path / "policy"))
    config = json.loads((checkpoint / "config.json").read_text())
    config["action_head_cfg"]["num_target_vision_tokens"] = 0
    (checkpoint / "config.json").write_text(json.dumps(config))
    tensors = read_tensors(DEMO_CHECKPOINT)
    del tensors["action_head.future_tokens.weight"]
    save_file(tensors, checkpoint / "model.safetensors")
    arguments = ["attention", "--checkpoint", str(checkpoint), "--blocks", "0", "--steps", "0", "--cell", "4"]
    assert main([*arguments, "--num-threads", "1", "--out", str(tmp_path / "out")]) == 0
    assert NO_FUTURE in " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "out/attention.json").read_text())
    assert found["num_future_tokens"] == 0
    assert {entry["group"] for entry in found["summaries"]} == {"state", "action"}
    assert "has no future tokens" in (tmp_path / "out/page.html").read_text()


def test_a_file_of_another_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = load_released("n15_single_view")
    (tmp_path / "config.json").write_text(json.dumps(given.config))
    features = written(tmp_path / "f.npz", feature_arrays())
    arguments = [
        "--checkpoint",
        str(given.path),
        "--config",
        str(tmp_path / "config.json"),
        "--features",
        str(features),
    ]
    chosen = ["--blocks", "2", "--steps", "3", "--heads", "1", "--cell", "8", "--num-threads", "1", "--json"]
    assert main(["attention", *arguments, *chosen, "--out", str(tmp_path / "out")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["head"] for entry in found["summaries"]] == ["mean", 1] * 3
    change = np.array(found["occlusion"]["change"]["camera 1"])
    assert change.shape == (16, 16)
    assert (change == np.kron(change[::8, ::8], np.ones((8, 8)))).all()
    assert "drop_vl" in found["occlusion"]["method"]


def test_the_table_keeps_the_names_of_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("the camera at the left wrist [bold]", "the camera that looks down from above the table")
    layout = parse_layout(f"text:1,image:2x2={names[0]},image:1x3={names[1]},special:1", 9)
    maps = one_hot_maps()
    maps = dataclasses.replace(maps, view=dataclasses.replace(maps.view, layout=layout))
    show(maps, {"summaries": maps.summaries}, tmp_path)
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)  # more than 80 letters, and no markup
    assert "…" not in shown


CASES: list[tuple[list[str], str]] = [
    (["--blocks", "4"], "--blocks: given 4, expected 0 to 3"),
    (["--blocks", "-1"], "--blocks: given -1"),
    (["--steps", "0,4"], "--steps: given 0, 4, expected 0 to 3"),
    (["--heads", "7"], "--heads: given 7, expected 0 to 3"),
    (["--heads", "one"], "--heads: given 'one', expected numbers"),
    (["--heads", "mean", "1"], "--heads: given mean and numbers"),
    (["--task", "fly"], "unknown name 'fly'"),
    (["--seed", "1000000"], "evaluation seeds"),
    (["--after", "-1"], "--after: given -1"),
    (["--num-threads", "0"], "--num-threads: given 0"),
    (["--cell", "0"], "--cell: given 0"),
    (["--out", "f.npz"], "--out: f.npz is not a directory"),
    (["--layout", "text:*"], "--layout: only with --features"),
    (["--grid", "2x2", "--row", "1"], "--grid, --row: only with --features"),
    (["--features", "f.npz", "--task", "push"], "expected one observation"),
    (["--features", "missing.npz"], "missing.npz: no such file"),
    (["--features", "f.npz"], "f.npz: backbone_features: shape (1, 296, 64), the checkpoint expects"),
    (["--features", "fits.npz", "--layout", "image:4x4"], "the features have T_vl 20"),
    (["--features", "fits.npz", "--grid", "3x"], "grid: given '3x'"),
    (["--checkpoint", "nowhere"], "nowhere"),
    (["--checkpoint", "head.safetensors", "--config", "config.json"], "--features FILE"),
]


@pytest.mark.usefixtures("no_probe")
@pytest.mark.parametrize(("arguments", "message"), CASES)
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    others: dict[str, Any] = {"state": np.zeros((1, 4), np.float32), "embodiment_id": np.array([0])}
    np.savez("f.npz", backbone_features=np.zeros((1, 296, 64), np.float32), **others)
    np.savez("fits.npz", backbone_features=np.zeros((1, 20, 128), np.float32), **others)
    shutil.copy(load_released("n15_tiny").path, "head.safetensors")
    Path("config.json").write_text(json.dumps(load_released("n15_tiny").config))
    assert main(["attention", "--out", "out", *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    assert not Path("out").exists()
