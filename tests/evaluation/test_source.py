"""What decides a run's actions: which files are hashed, when they are read again, what they are called."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import saccade
from saccade._internal import files
from saccade._internal.files import remembered_sha256, sha256_of
from saccade._internal.hub import Location
from saccade._internal.hub_files import TOKENIZER
from saccade.evaluation import source
from saccade.evaluation.source import Source, contents_hash, named, weights_hash

DEMO = str(saccade.demo_checkpoint())
COMMIT = "0123456789" * 4


def test_the_hash_of_a_checkpoint_is_that_of_the_files_that_are_read(tmp_path: Path) -> None:
    shutil.copytree(DEMO, tmp_path / "policy")
    folder = tmp_path / "policy"
    before = weights_hash(folder)
    (folder / "results.json").write_text("{}")
    (folder / "evaluation").mkdir()
    (folder / "evaluation" / "results.json").write_text("{}")
    shutil.copytree(DEMO, folder / "checkpoint-500")
    assert weights_hash(folder) == before
    for name in (
        "config.json",
        "tokenizer.json",
        "experiment_cfg/data_config.json",
        "experiment_cfg/metadata.json",
    ):
        text = (folder / name).read_text()
        (folder / name).write_text(text + "\n")
        assert weights_hash(folder) != before, name
        (folder / name).write_text(text)
    (folder / "processor").mkdir()
    (folder / "processor" / "statistics.json").write_text("{}")
    assert weights_hash(folder) != before


def test_the_hash_of_a_checkpoint_tells_where_its_files_are(tmp_path: Path) -> None:
    for folder, name in (("one", "tokenizer"), ("two", "processor")):
        (tmp_path / folder / name).mkdir(parents=True)
        (tmp_path / folder / name / "merges.txt").write_text("x")
    first, second = (weights_hash(tmp_path / name) for name in ("one", "two"))
    assert first != second
    (tmp_path / "one" / "tokenizer" / "merges.txt").write_text("yz")
    assert weights_hash(tmp_path / "one") != first


def test_the_hash_of_a_single_file_does_not_depend_on_its_name(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{}")
    assert contents_hash(tmp_path / "a.json", TOKENIZER) == sha256_of(tmp_path / "a.json")


def test_a_file_is_read_again_only_if_it_may_have_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []

    def counted(path: Path) -> str:
        read.append(path)
        return sha256_of(path)

    monkeypatch.setattr(files, "sha256_of", counted)
    path = tmp_path / "weights"
    path.write_bytes(b"one")
    # It has just been written: another change might leave it the same times.
    assert [remembered_sha256(path) for _ in range(2)] == [sha256_of(path)] * 2
    assert len(read) == 2
    monkeypatch.setattr(files, "UNSETTLED", -1e9)
    assert [remembered_sha256(path) for _ in range(3)] == [sha256_of(path)] * 3
    assert len(read) == 3
    path.write_bytes(b"other")
    assert remembered_sha256(path) == sha256_of(path)
    assert len(read) == 4


def test_what_is_published_has_its_id_and_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(source, "locate", lambda given: Location(Path(DEMO), "owner/policy", COMMIT))
    found = Source.of("owner/policy", ".", {"tokenizer": Path("owner/words"), "num_threads": 1})
    found = Source(found.checkpoint, f"owner/data@{COMMIT}", found.options, found.published)
    assert found.checkpoint == DEMO  # other processes load it from there
    assert found.names() == {"checkpoint": "owner/policy", "recordings": "owner/data"}
    anywhere = found.from_anywhere()
    assert anywhere.checkpoint == f"owner/policy@{COMMIT}"
    assert anywhere.recordings == f"owner/data@{COMMIT}"
    assert anywhere.options == {"tokenizer": "owner/words", "num_threads": 1}


def test_a_path_is_absolute_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(DEMO, "policy")
    Path("keys.json").write_text("{}")
    options = {"tokenizer": "policy/tokenizer.json", "data_config": "keys.json", "precision": "int8"}
    found = Source.of("policy", "data", options)
    assert found.names() == {"checkpoint": "policy", "recordings": "data"}
    anywhere = found.from_anywhere()
    assert (anywhere.checkpoint, anywhere.recordings) == (str(tmp_path / "policy"), str(tmp_path / "data"))
    assert anywhere.options == {
        "tokenizer": str(tmp_path / "policy" / "tokenizer.json"),
        "data_config": str(tmp_path / "keys.json"),
        "precision": "int8",
    }
    about = found.checkpoint_identity()
    assert about["options"] == {"precision": "int8"}
    assert about["option_files"] == {
        "tokenizer": sha256_of(Path("policy/tokenizer.json")),
        "data_config": sha256_of(Path("keys.json")),
    }
    released = Source.of("policy", "data", {"data_config": "so100_dualcam"})
    assert released.from_anywhere().options == released.options
    assert released.checkpoint_identity()["options"] == {"data_config": "so100_dualcam"}
    assert released.option_files() == {}


def test_without_a_name_the_hash_is_shown() -> None:
    settings = {"checkpoint": {"sha256": "0" * 64}, "recordings": {"sha256": "1" * 64}, "seed": 3}
    assert named(settings, {"recordings": "tiny"}) == {
        "checkpoint": {"name": f"checkpoint {'0' * 12}", "sha256": "0" * 64},
        "recordings": {"name": "tiny", "sha256": "1" * 64},
        "seed": 3,
    }
