"""How a whole checkpoint is loaded for a study on pictures: its data config and what else it does not say."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saccade import Policy
from saccade._internal.files import sha256_of
from saccade.cli import main
from saccade.observations.pictures import read_frames
from saccade_lab.files import checkpoint_identity, data_config_text
from saccade_lab.inside import head_inputs
from saccade_lab.study.pictures import PictureSource, encode
from saccade_lab.study.questions.gradients import reference_of
from saccade_lab.study.table import read_provenance
from tests.helpers.frames_cases import write_pictures_of
from tests.helpers.whole_checkpoints import EMBODIMENT, data_config, whole

TOLD = "open the drawer"
CONFIG = data_config("wrist", "front")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pictures_of(tmp_path_factory.mktemp("frames") / "table", "pour/1", "wipe/1")


def source_of(frames: Path, **options: Any) -> PictureSource:
    """Pictures for a checkpoint of N1.7."""
    return PictureSource(
        str(whole("n17")), str(frames), TOLD, embodiment=EMBODIMENT, num_threads=1, **options
    )


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "keys.json"
    path.write_text(json.dumps(CONFIG))
    return path


def test_a_data_config_decides_inputs_and_horizon(frames: Path, config: Path) -> None:
    source = PictureSource(
        str(whole("isaac")), str(frames), TOLD, embodiment=EMBODIMENT, data_config=str(config), num_threads=1
    )
    policy = Policy.from_pretrained(
        whole("isaac"), embodiment=EMBODIMENT, data_config=CONFIG, num_threads=1, precision="float32"
    )
    for row, picture in enumerate(read_frames(frames, policy, instruction=TOLD)):
        (features,) = policy.encode(picture.observation).features
        expected, found = head_inputs(policy, picture.observation, features), source.all.row(row)
        np.testing.assert_array_equal(found.backbone_features, expected.backbone_features)
        np.testing.assert_array_equal(found.state, expected.state)
    assert source.config == policy.head.config
    assert (source.config.action_horizon, source.head().config.action_horizon) == (3, 3)
    assert reference_of(source).config == source.config
    assert source.observed("frames", 0).sample(source.head()).shape[-2] == 3
    assert encode(source).layouts[0].cameras[0].name == "wrist"


def test_commands_take_and_record_it(frames: Path, config: Path, tmp_path: Path) -> None:
    words = ["--checkpoint", str(whole("isaac")), "--frames", str(frames), "--instruction", TOLD]
    words += ["--embodiment", EMBODIMENT, "--data-config", str(config)]
    out = str(tmp_path / "study")
    assert main(["study", "gradients", *words, "--projections", "1", "--out", out]) == 0
    assert main(["study", "cuts", *words, "--arms", "future-unread", "--out", out]) == 0
    recorded = {"sha256": sha256_of(config)}
    settings = read_provenance(tmp_path / "study" / "cuts.json").settings["frames"]
    assert settings["data_config"] == recorded
    few = ["--blocks", "0", "--steps", "0", "--cell", "4", "--out", str(tmp_path / "maps")]
    assert main(["attention", *words, *few]) == 0
    found = json.loads((tmp_path / "maps" / "attention.json").read_text())
    assert found["source"]["data_config"] == recorded
    assert [camera["name"] for camera in found["layout"]["cameras"]] == ["wrist", "front"]


def test_another_horizon_and_processor(frames: Path, tmp_path: Path) -> None:
    words = ["--checkpoint", str(whole("n17")), "--frames", str(frames), "--instruction", TOLD]
    words += ["--embodiment", EMBODIMENT, "--action-horizon", "20"]
    words += ["--processor-options", '{"letter_box_transform": true}']
    out = str(tmp_path / "study")
    assert main(["study", "gradients", *words, "--projections", "1", "--out", out]) == 0
    settings = read_provenance(tmp_path / "study" / "gradients.json").settings["frames"]
    assert settings["action_horizon"] == 20
    assert settings["processor_options"] == {"letter_box_transform": True}
    plain = source_of(frames)
    pad = source_of(frames, action_horizon=20, processor_options='{"letter_box_transform": true}')
    assert pad.config.action_horizon == pad.head().config.action_horizon == 20
    assert plain.config.action_horizon != 20
    assert pad.all.backbone_features.tobytes() != plain.all.backbone_features.tobytes()


def test_another_tokenizer_is_recorded(frames: Path, tmp_path: Path) -> None:
    other = tmp_path / "tokenizer.json"
    shutil.copy(whole("n17") / "tokenizer.json", other)
    source = source_of(frames, tokenizer=str(other))
    assert source.describe()["frames"]["tokenizer"] == {"sha256": sha256_of(other)}
    assert "tokenizer" not in source_of(frames).describe()["frames"]


def test_a_data_config_beside_the_command_is_a_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Workers of a cluster have it elsewhere: what has no separator could not be told from a word."""
    monkeypatch.chdir(tmp_path)
    assert data_config_text("keys.json") == "./keys.json"
    (tmp_path / "so100").mkdir()
    source = PictureSource("policy", "frames", data_config=data_config_text("so100"))
    assert source.data_config == "so100"
    assert "so100" not in source.files


@pytest.mark.parametrize("command", ["study cuts", "attention"])
def test_they_need_pictures(command: str, config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command.split(), "--data-config", str(config), "--action-horizon", "3"]) == 2
    assert "--data-config, --action-horizon: only with --frames" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["statistics.json", "processor_config.json", "embodiment_id.json"])
def test_the_hash_of_a_checkpoint_covers_its_statistics(name: str, tmp_path: Path) -> None:
    folder = shutil.copytree(whole("n17"), tmp_path / "n17")
    before = checkpoint_identity(folder)
    (folder / name).write_text((folder / name).read_text() + "\n")
    after = checkpoint_identity(folder)
    assert (before["name"], before["sha256"]) == (after["name"], after["sha256"])
    assert before["robot_sha256"] != after["robot_sha256"]


@pytest.mark.parametrize("name", ["n15", "n17"])
def test_committed_studies_are_of_the_committed_policies(name: str) -> None:
    folder = Path(__file__).parents[3] / "studies" / "libero"
    recorded = read_provenance(folder / f"cuts-{name}" / "cuts.json").settings["checkpoint"]
    assert recorded["sha256"] == checkpoint_identity(folder / name)["sha256"]
