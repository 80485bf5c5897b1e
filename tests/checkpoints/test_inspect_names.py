"""`saccade inspect` names embodiments by the files from which the loader takes their ids."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import saccade
from saccade.checkpoints.inspection import inspect
from saccade.errors import CheckpointError
from tests.helpers import layouts
from tests.helpers.lfs_pointer import POINTER


def names_of(folder: Path) -> list[list[str]]:
    return [entry.names for entry in inspect(folder).embodiments]


@pytest.mark.parametrize("given", [None, {}, {"new_embodiment": 3}])
@pytest.mark.parametrize("layout", ["lerobot", "lerobot-n17"])
def test_names_of_a_pipeline_are_those_that_its_policy_has(
    layout: str, given: dict[str, int] | None, tmp_path: Path
) -> None:
    source = layouts.write(tmp_path / "it", layout)
    path = source / "policy_preprocessor.json"
    values = json.loads(path.read_text())
    (pack,) = (step["config"] for step in values["steps"] if "embodiment_mapping" in step["config"])
    pack["embodiment_mapping"] = given
    names = {}
    for tag in ("new_embodiment", "gr1", "unitree_g1", "genie1_gripper", "never_heard_of"):
        pack["embodiment_tag"] = tag
        path.write_text(json.dumps(values))
        names[tag] = saccade.Normalizer.from_pretrained(source).embodiment_id
    shown = {name: place for place, listed in enumerate(names_of(source)) for name in listed}
    # lerobot takes 0 for a tag that it does not know.
    assert names == {tag: shown.get(tag, 0) for tag in names}


def moved(folder: Path) -> Path:
    """The folder, with the processor's files where a trainer leaves them."""
    (folder / "processor").mkdir()
    for name in ("processor_config.json", "statistics.json", "embodiment_id.json"):
        (folder / name).rename(folder / "processor" / name)
    return folder


def test_names_are_by_the_ids_that_the_loader_takes(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "n17", "n17")
    names = names_of(folder)
    assert names[2] == ["libero_sim"]
    assert "new_embodiment" in names[10]
    assert names[31] == []
    (folder / "embodiment_id.json").write_text('{"x": 7, "new_embodiment": 11}')
    assert "x" in names_of(folder)[7]
    names = names_of(moved(folder))
    assert "x" in names[7]
    assert saccade.Normalizer.from_pretrained(folder, "new_embodiment").embodiment_id == 11
    assert "new_embodiment" in names[11]
    assert "new_embodiment" not in names[10]
    assert names[2] == ["libero_sim"]  # the loader takes what the file lacks from the released table
    (folder / "processor" / "embodiment_id.json").unlink()
    assert names_of(folder)[10][0] == "new_embodiment"  # the released ones


@pytest.mark.parametrize("text", ["[]", '{"a": "b", "c": [1]}', "{", POINTER])
@pytest.mark.parametrize("folder", [".", "processor"])
def test_damaged_ids_are_not_replaced_by_the_released_ones(folder: str, text: str, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "n17", "n17")
    if folder == "processor":
        moved(source)
    path = source / folder / "embodiment_id.json"
    path.write_text(text)
    for read in (inspect, saccade.Normalizer.from_pretrained):
        with pytest.raises(CheckpointError, match=re.escape(str(path))):
            read(source)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{",
        POINTER,
        '{"steps": [{"registry_name": "groot_pack_inputs_v3", "config": {"embodiment_mapping": [1]}}]}',
    ],
)
def test_nor_are_those_of_a_damaged_pipeline(text: str, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "lerobot", "lerobot")
    assert "unitree_g1" in names_of(source)[3]
    path = source / "policy_preprocessor.json"
    path.write_text(text)
    for read in (inspect, saccade.Normalizer.from_pretrained):
        with pytest.raises(CheckpointError, match=re.escape(str(path))):
            read(source)
