"""Git LFS pointers in place of files of a checkpoint: messages name the file and the command to download it.

Weights, indexes and configs are among the files of test_hostile_files.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import saccade
from saccade.errors import CheckpointError
from tests.helpers import layouts
from tests.helpers.lfs_pointer import POINTER

SAYS = (
    "it is a Git LFS pointer, not the file itself: run `git lfs pull` in {folder}, or download the repository"
)


@pytest.mark.parametrize(
    ("layout", "name"),
    [
        ("isaac", "experiment_cfg/metadata.json"),
        ("n17", "processor_config.json"),
        ("n17", "statistics.json"),
        ("n17", "embodiment_id.json"),
        ("lerobot", "policy_preprocessor.json"),
        ("lerobot", "policy_preprocessor*.safetensors"),
    ],
)
def test_statistics(layout: str, name: str, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "source", layout)
    (path,) = source.glob(name)
    path.write_text(POINTER)
    with pytest.raises(CheckpointError) as caught:
        saccade.Normalizer.from_pretrained(source)
    assert str(path) in str(caught.value)
    assert SAYS.format(folder=path.parent) in str(caught.value)


@pytest.mark.parametrize("name", ["tokenizer.json", "vocab.json", "merges.txt", "added_tokens.json"])
def test_tokenizers(name: str, tmp_path: Path) -> None:
    if name != "tokenizer.json":
        (tmp_path / "vocab.json").write_text("{}")
        (tmp_path / "merges.txt").write_text("")
    (tmp_path / name).write_text(POINTER)
    with pytest.raises(CheckpointError) as caught:
        saccade.Processor("n1.5", tmp_path)
    assert str(tmp_path / name) in str(caught.value)
    assert SAYS.format(folder=tmp_path) in str(caught.value)


def test_a_tokenizer_that_is_not_json_is_named(tmp_path: Path) -> None:
    path = tmp_path / "tokenizer.json"
    path.write_text("{")
    with pytest.raises(CheckpointError, match=r"tokenizer: .*tokenizer.json: not valid JSON"):
        saccade.Processor("n1.5", path)
