"""`saccade inspect` shows what a whole checkpoint needs to act."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade import cli
from saccade.checkpoints.inspection import inspect
from tests.helpers import layouts, whole_checkpoints
from tests.helpers.whole_checkpoints import CAMERAS, EMBODIMENT, whole


@pytest.mark.parametrize("layout", whole_checkpoints.LAYOUTS)
def test_the_backbone_and_the_robots_are_described(layout: str, capsys: pytest.CaptureFixture[str]) -> None:
    source = whole(layout)
    report = inspect(source)
    about = whole_checkpoints.about_backbone(layout)
    assert report.backbone is not None
    assert report.backbone.config is not None
    assert report.backbone.config.width == about["text_config"]["hidden_size"]
    assert report.backbone.config.num_layers == about["select_layer"]
    for precision, nbytes in report.backbone.memory.items():
        assert nbytes == saccade.Backbone.from_pretrained(source, precision=precision).nbytes
    assert report.backbone.processor is not None
    assert f"preprocessing={'lerobot' if 'lerobot' in layout else 'isaac'}" in report.backbone.processor
    (robot,) = (robot for robot in report.robots if robot.embodiment in (EMBODIMENT, None))
    assert robot.needs is not None
    assert robot.needs.cameras is not None
    assert sorted(camera.name for camera in robot.needs.cameras) == sorted(CAMERAS)
    needs = saccade.Policy.from_pretrained(source, embodiment=EMBODIMENT).requirements
    assert robot.needs == needs
    assert cli.main(["inspect", str(source)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "Backbone version GR00T" in printed
    assert all(str(camera) in printed for camera in robot.needs.cameras)
    assert cli.main(["inspect", str(source), "--json"]) == 0
    values: Any = json.loads(capsys.readouterr().out)
    assert values["backbone"]["config"]["version"] == report.backbone.config.version
    assert values["robots"][-1]["needs"]["cameras"][0]["name"] in CAMERAS


def test_what_is_missing_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))
    source = whole_checkpoints.write(tmp_path / "bare", "isaac", tokenizer=False)
    report = inspect(source)
    assert report.backbone is not None
    assert report.backbone.processor is None
    assert "tokenizer" in str(report.backbone.processor_problem)
    assert cli.main(["inspect", str(source)]) == 0
    assert "hf download" in capsys.readouterr().out
    metadata = source / "experiment_cfg" / "metadata.json"
    values = json.loads(metadata.read_text())
    values[EMBODIMENT]["modalities"]["state"]["arm"]["rotation_type"] = "quaternion"
    metadata.write_text(json.dumps(values))
    (robot,) = inspect(source).robots
    assert robot.needs is None
    assert "rotation" in str(robot.problem)
    assert cli.main(["inspect", str(source)]) == 0
    assert "is a rotation" in " ".join(capsys.readouterr().out.split())
    shutil.rmtree(source / "experiment_cfg")
    assert inspect(source).robots == []
    stub = layouts.write(tmp_path / "stub", "isaac")
    found = inspect(stub).backbone
    assert found is not None
    assert found.config is None
    assert "is missing" in str(found.problem)
    alone = layouts.write(tmp_path / "alone", "saccade")
    assert inspect(alone).backbone is None
