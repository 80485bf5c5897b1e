"""Published ids without a connection: found in a cache, refused where files are missing, and paths."""

from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saccade
from saccade import cli
from saccade._internal import hub_cache
from saccade._internal.hub import resolve
from saccade._internal.hub_files import BACKBONE
from saccade.errors import InputError
from tests.helpers import layouts

COMMIT = "4af2b622892f7dcb5aae5a3fb70bcb02dc217b96"
NAME = "nvidia/GR00T-N1.5-3B"


def cached(cache: Path, source: Path, name: str = NAME, commit: str = COMMIT, leave_out: str = "") -> Path:
    """Puts a checkpoint into a cache as `hf download` does: blobs, and a snapshot of links to them."""
    repository = cache / f"models--{name.replace('/', '--')}"
    snapshot = repository / "snapshots" / commit
    for file in sorted(source.rglob("*")):
        if file.is_dir() or file.name == leave_out:
            continue
        blob = repository / "blobs" / hashlib.sha256(file.read_bytes()).hexdigest()
        blob.parent.mkdir(parents=True, exist_ok=True)
        blob.write_bytes(file.read_bytes())
        link = snapshot / file.relative_to(source)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(blob, link.parent))
    (repository / "refs").mkdir(exist_ok=True)
    (repository / "refs" / "main").write_text(commit)
    return snapshot


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache in place of the user's; huggingface_hub reads its place when it is imported."""
    from huggingface_hub import constants

    folder = tmp_path / "hub"
    folder.mkdir()
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(folder))
    return folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return layouts.write(tmp_path_factory.mktemp("published") / "source", "nvidia-sharded")


def test_an_id_is_the_folder_of_its_snapshot(cache: Path, checkpoint: Path) -> None:
    snapshot = cached(cache, checkpoint)
    assert resolve(NAME) == snapshot
    assert resolve(Path(NAME)) == snapshot
    assert resolve(f"{NAME}@{COMMIT}") == snapshot
    head = saccade.ActionHead.from_pretrained(NAME, embodiment_ids=[24])
    assert head.config == saccade.ActionHead.from_pretrained(checkpoint, embodiment_ids=[24]).config
    again = pickle.loads(pickle.dumps(head))
    features = np.ones((1, 3, head.config.context_dim), np.float32)
    state = np.zeros((1, head.config.state_dim), np.float32)
    assert np.array_equal(head(features, state, 24, seed=0), again(features, state, 24, seed=0))


def test_revisions_are_told_apart(cache: Path, checkpoint: Path) -> None:
    older = cached(cache, checkpoint, commit="0" * 40)
    newer = cached(cache, checkpoint)
    assert resolve(NAME) == newer
    assert resolve(f"{NAME}@{'0' * 40}") == older
    with pytest.raises(FileNotFoundError, match=f"hf download {NAME} --revision v2"):
        resolve(f"{NAME}@v2")


def test_a_path_comes_before_an_id(
    cache: Path, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached(cache, checkpoint)
    monkeypatch.chdir(tmp_path)
    Path(NAME).mkdir(parents=True)
    assert resolve(NAME) == Path(NAME)


def test_what_is_not_there_names_the_command_that_downloads_it(cache: Path) -> None:
    with pytest.raises(FileNotFoundError, match=f"no such path.*{cache}.*hf download {NAME}"):
        saccade.ActionHead.from_pretrained(NAME)


@pytest.mark.parametrize(
    ("leave_out", "message"),
    [
        ("model-00002-of-00003.safetensors", r"lacks model-00002-of-00003\.safetensors"),
        ("config.json", r"lacks config\.json"),
    ],
)
def test_a_download_that_was_cut_short(cache: Path, checkpoint: Path, leave_out: str, message: str) -> None:
    cached(cache, checkpoint, leave_out=leave_out)
    with pytest.raises(FileNotFoundError, match=f"only a part.*{message}.*hf download {NAME}"):
        resolve(NAME)


def test_without_huggingface_hub_both_commands_are_named(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['huggingface_hub'] = None\n"
        "from saccade._internal.hub import resolve\n"
        f"try: resolve({NAME!r})\n"
        "except FileNotFoundError as error: print(error)"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "huggingface_hub, which downloads published checkpoints, is not installed" in result.stdout
    assert "[hub]" in result.stdout
    assert f"hf download {NAME}" in result.stdout


@pytest.mark.parametrize("path", ["nothing", "a/b/c", "./nvidia/x", "a/b.safetensors", "/tmp/nothing", "a/"])
def test_other_paths_stay_as_they_are(path: str) -> None:
    assert resolve(path) == Path(path)
    with pytest.raises(FileNotFoundError, match="no such file or directory"):
        saccade.ActionHead.from_pretrained(path)


def test_what_is_no_path() -> None:
    for source in (3, None, b"bytes", "null\0character"):
        with pytest.raises(InputError, match="id_or_path: expected a path"):
            resolve(source)  # type: ignore[arg-type]


@pytest.mark.parametrize("path", [".", "nothing", "./nvidia/x", "/x/y", "a/b/c", "a--b/c", "a/b..c"])
def test_a_revision_of_a_path(path: str) -> None:
    with pytest.raises(InputError, match="revision: expected None with a path, got 'main'"):
        resolve(path, "main")


@pytest.mark.parametrize("revision", ["", "a b", "../main", "a//b", "/main", 7, "a..b"])
def test_revisions_that_are_none(revision: Any) -> None:
    with pytest.raises(InputError, match="revision: expected a branch, tag or commit"):
        resolve(NAME, revision)


def test_two_revisions() -> None:
    with pytest.raises(InputError, match=r"revision: expected None with .*@v1, which names one, got 'v2'"):
        resolve(f"{NAME}@v1", "v2")


def test_a_folder_with_the_name_of_the_owner_is_mentioned(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nvidia").mkdir()
    with pytest.raises(FileNotFoundError, match=r"there is a folder nvidia, without GR00T-N1\.5-3B in it"):
        resolve(NAME)


def test_what_another_program_downloaded_is_used_with_a_warning(cache: Path, checkpoint: Path) -> None:
    """Nothing says which files its repository has: a missing one would change results silently."""
    snapshot = cached(cache, checkpoint)
    with pytest.warns(UserWarning, match="it is not known whether all files of the repository are there"):
        assert resolve(NAME) == snapshot


def test_a_recorded_list_of_files_is_compared(cache: Path, checkpoint: Path) -> None:
    snapshot = cached(cache, checkpoint)
    there = [file.relative_to(snapshot).as_posix() for file in snapshot.rglob("*") if file.is_file()]
    hub_cache.write_listing(snapshot, [*there, "pictures/front.png"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve(NAME) == snapshot  # pictures are not read
        assert resolve(snapshot) == snapshot
    hub_cache.write_listing(snapshot, [*there, "processor/statistics.json"])
    for source in (NAME, snapshot):
        with pytest.raises(FileNotFoundError, match=r"lacks processor/statistics\.json"):
            resolve(source)
    assert resolve(NAME, files=BACKBONE) == snapshot


def test_commands_take_ids(cache: Path, checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cached(cache, checkpoint)
    assert cli.main(["inspect", NAME, "--json"]) == 0
    assert '"version": "n1.5"' in capsys.readouterr().out
    for command in (
        ["bench", "--checkpoint", "nvidia/absent"],
        ["parity", "--checkpoint", "nvidia/absent"],
        ["inspect", "nvidia/absent"],
    ):
        assert cli.main(command) == 2
        assert "hf download nvidia/absent" in capsys.readouterr().err
