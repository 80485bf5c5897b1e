"""Statistics that are missing, broken or do not fit: what the normalizer says of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade import Normalizer
from tests.helpers.normalizer_cases import edit, metadata
from tests.helpers.published import sidecars


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Normalizer.from_pretrained(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="hf download nobody/nothing"):
        Normalizer.from_pretrained("nobody/nothing")
    with pytest.raises(saccade.CheckpointError, match="too long"):
        Normalizer.from_pretrained(tmp_path / ("x" * 300))
    with pytest.raises(saccade.InputError, match="expected a path"):
        Normalizer.from_pretrained(5)  # type: ignore[arg-type]
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(saccade.CheckpointError, match="not a regular file"):
        Normalizer.from_pretrained(tmp_path / "pipe.json")
    with pytest.raises(
        saccade.CheckpointError, match=r"no statistics.*policy_preprocessor\.json.*metadata\.json"
    ):
        Normalizer.from_pretrained(tmp_path)
    sidecars(tmp_path / "lerobot", "lerobot")
    next((tmp_path / "lerobot").glob("policy_postprocessor_step*")).unlink()
    with pytest.raises(FileNotFoundError, match="policy_postprocessor_step"):
        Normalizer.from_pretrained(tmp_path / "lerobot")
    (tmp_path / "lerobot" / "policy_postprocessor.json").unlink()
    with pytest.raises(saccade.CheckpointError, match="turns actions into"):
        Normalizer.from_pretrained(tmp_path / "lerobot")


@pytest.mark.parametrize("text", ["", "[]", "{", "null", '{"state": 1}', "[" * 100_000, '"\xff'])
def test_broken_json(text: str, tmp_path: Path) -> None:
    path = tmp_path / "experiment_cfg" / "metadata.json"
    path.parent.mkdir()
    path.write_bytes(text.encode("latin-1"))
    for source in (tmp_path, path):
        with pytest.raises(saccade.CheckpointError, match="metadata"):
            Normalizer.from_pretrained(source)


@pytest.mark.parametrize(
    "name",
    ["processor_config.json", "statistics.json", "policy_preprocessor.json", "policy_postprocessor.json"],
)
@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{"steps": 3, "processor_kwargs": 4}',
        '{"steps": [5], "processor_kwargs": {"modality_configs": {"a": 6}}, "a": 7}',
    ],
)
def test_json_of_another_form(name: str, text: str, tmp_path: Path) -> None:
    sidecars(tmp_path, "n17" if name in ("processor_config.json", "statistics.json") else "lerobot")
    (tmp_path / name).write_text(text)
    with pytest.raises(saccade.CheckpointError):
        Normalizer.from_pretrained(tmp_path, "new_embodiment")


def test_all_that_is_wrong_with_statistics_is_listed() -> None:
    values = metadata()
    stats = values["new_embodiment"]["statistics"]
    del stats["state"]["arm"]["max"]
    stats["state"]["gripper"]["min"] = [5.0, 5.0]
    stats["action"]["arm"]["min"] = [0.0]
    stats["action"]["gripper"]["max"] = [float("nan")]
    with pytest.raises(saccade.CheckpointError) as found:
        Normalizer.from_pretrained(values)
    for problem in (
        "arm: min_max needs max",
        "gripper: max is below min",
        "arm: expected min and max of one shape, got (1,) and (3,)",
        "gripper: expected max to be a row of finite numbers",
    ):
        assert problem in str(found.value)


def test_options_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(saccade.InputError, match=r"embodiment: expected one of those in .*, got 'gr1'"):
        Normalizer.from_pretrained(metadata(), "gr1")
    with pytest.raises(saccade.InputError, match="state_dim"):
        Normalizer.from_pretrained(metadata(), state_dim=0)
    with pytest.raises(saccade.CheckpointError, match=r"4 numbers, the head's only 3 \(action_dim\)"):
        Normalizer.from_pretrained(metadata(), action_dim=3)
    sidecars(tmp_path, "lerobot")
    with pytest.raises(saccade.InputError, match=r"data_config: expected None, because .* contains keys"):
        Normalizer.from_pretrained(tmp_path, data_config="so100")
    with pytest.raises(saccade.InputError, match=r"state_dim: expected at least 12, the head's in .*, got 8"):
        Normalizer.from_pretrained(tmp_path, state_dim=8)
    assert Normalizer.from_pretrained(tmp_path, state_dim=64).state_dim == 64
    with pytest.raises(saccade.InputError, match=r"embodiment: expected 'new_embodiment' .*, got 5"):
        Normalizer.from_pretrained(tmp_path, 5)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00" * 7,
        b"\xff" * 8,
        (5).to_bytes(8, "little") + b"hello",
        (2).to_bytes(8, "little") + b"[]",
        b'\x3c\x00\x00\x00\x00\x00\x00\x00{"action.min":{"dtype":"F32","shape":[6],"data_offsets":[0,24]}}',
        b'\x41\x00\x00\x00\x00\x00\x00\x00{"action.min":{"dtype":"F32","shape":[6],"data_offsets":[-24,0]}}'
        + b"\0" * 24,
        b'\x40\x00\x00\x00\x00\x00\x00\x00{"action.min":{"dtype":"F99","shape":[6],"data_offsets":[0,24]}}'
        + b"\0" * 24,
    ],
)
def test_broken_files_of_statistics(content: bytes, tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")
    next(tmp_path.glob("policy_preprocessor_step*")).write_bytes(content)
    with pytest.raises(saccade.CheckpointError, match="policy_preprocessor_step"):
        Normalizer.from_pretrained(tmp_path)


@pytest.mark.parametrize("name", ["../elsewhere.safetensors", "a/b.safetensors", "", 7])
def test_a_step_may_only_name_a_file_beside_it(name: Any, tmp_path: Path) -> None:
    sidecars(tmp_path, "lerobot")

    def rename(values: dict[str, Any]) -> None:
        next(step for step in values["steps"] if "state_file" in step)["state_file"] = name

    edit(tmp_path / "policy_preprocessor.json", rename)
    with pytest.raises(saccade.CheckpointError, match="state_file"):
        Normalizer.from_pretrained(tmp_path)
